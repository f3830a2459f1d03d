"""Twins: two draws of each source cloud, and what else a simulation knows of it.

A student of one noisy, hidden, cut view can follow a teacher who sees the whole object.

Ours. Learning with information that only the teacher has is of Vapnik, Vashist, "A new learning
paradigm: Learning using privileged information", Neural Networks 22 (2009), as distillation of
Lopez-Paz, Bottou, Schölkopf, Vapnik, "Unifying distillation and privileged information", ICLR 2016.
Here the information is what a simulation knows and a scan does not show.
"""

from __future__ import annotations

import copy
import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from qs3.config.checks import check_choice, check_float, check_of_use
from qs3.datamodules.beside import SOURCE_TWINS
from qs3.datamodules.twins import Wants
from qs3.errors import ConfigError
from qs3.kernels.norms import use_domain
from qs3.methods.base import check_taught, class_loss, weight
from qs3.methods.mean_teacher import MeanTeacher

TEACHERS = ("mean", "shared", "own")


class Twin(MeanTeacher):
    r"""A student of cut views that says what a teacher of whole objects says.

    L = CE(f(x), y) + a CE(f(w), y) + l T² KL(t(w) || f(x); T) + d (1 - cos(φ_t(w), φ_f(x)))
    + b CE(f(x'), y) + v JS(f(x), f(x')) + u e^{-5 (1 - p)²} H(t(z); T_t, f(z')).

    x: a source cloud as the student sees it, noisy, hidden and cut; w: its twin (`sees`), turned
    alike; x': x drawn again, by another cut and, with `data.source.views=random`, another share of
    its sensor's error and number of views; z, z': a target cloud as it was measured, and cut. f:
    class probabilities of the student, φ_f its vector of a cloud before the head; t, φ_t those of
    the teacher, which no gradient reaches. KL(·; T): of softmaxes at temperature T; JS: their
    Jensen-Shannon divergence; H(·; T_t, ·): cross-entropy with the teacher's softmax at T_t, which
    sharpens it; all are means over the clouds, in nats. p: progress of the warm-up.

    The normalised squared distance |û - v̂|² is 2 (1 - cos), so it is no further choice.

    By default b = 1 and the others are 0: none of them helped on real objects
    (docs/results/twin.md).
    A weight of 0 leaves its term out, with its passes, and the clouds that nothing else needs are
    not loaded.

    A teacher of its own is another net of the same kind: with it a CE(f(w), y) becomes
    a CE(t(w), y), so that the student never sees a twin.

    Args:
        twin_weight: a: the student learns twins, too, which is how its means come to know them; a
            teacher of its own learns them instead.
        logit_weight: l.
        feature_weight: d.
        again_weight: b: the student learns the second draw's class, too.
        view_weight: v.
        target_weight: u.
        sees: what the teacher sees of a source cloud: "whole", the object's whole surface; "clean",
            what was seen, without error; "scan", the cloud itself, not cut. The first needs a store
            made with twins=[whole].
        teacher: "mean", running means of the student in eval mode; "shared", the student itself;
            "own", of source clouds a net that learns twins beside it (dropped after training), of
            target clouds the means.
        momentum: m of the means, see `MeanTeacher`.
        temperature: T > 0.
        target_temperature: T_t > 0.

    Raises:
        ConfigError: a value is out of its range, nothing reads it (a temperature of a term that is
            left out, what a teacher sees who teaches nothing), or a teacher of its own learns
            nothing (twin_weight=0) or teaches nothing (logit_weight=0 and feature_weight=0).
    """

    def __init__(
        self,
        twin_weight: float = 0.0,
        logit_weight: float = 0.0,
        feature_weight: float = 0.0,
        again_weight: float = 1.0,
        view_weight: float = 0.0,
        target_weight: float = 0.0,
        sees: str = "whole",
        teacher: str = "mean",
        momentum: float = 0.99,
        temperature: float = 2.0,
        target_temperature: float = 0.5,
    ) -> None:
        super().__init__(momentum)
        self.expert: Any = None  # a teacher of its own
        self.twin_weight = weight("twin_weight", twin_weight)
        self.logit_weight = weight("logit_weight", logit_weight)
        self.feature_weight = weight("feature_weight", feature_weight)
        self.again_weight = weight("again_weight", again_weight)
        self.view_weight = weight("view_weight", view_weight)
        self.target_weight = weight("target_weight", target_weight)
        self.sees = check_choice("method.sees", sees, sorted(SOURCE_TWINS))
        self.taught_by = check_choice("method.teacher", teacher, TEACHERS)
        if self.taught_by == "own" and not (self.twin_weight and self._distils):
            raise ConfigError(
                "method.teacher=own learns by method.twin_weight and teaches by "
                "method.logit_weight or method.feature_weight: set them above 0, or "
                "method.teacher=mean"
            )
        self.temperature = check_float("method.temperature", temperature, "> 0")
        self.target_temperature = check_float(
            "method.target_temperature", target_temperature, "> 0"
        )
        self.uses_target = self.target_weight > 0  # type: ignore[misc]
        logits, target = "set method.logit_weight above 0", "set method.target_weight above 0"
        check_of_use("method.temperature", temperature, 2.0, self.logit_weight, logits)
        key = "method.target_temperature"
        check_of_use(key, target_temperature, 0.5, self.target_weight, target)
        of_twins = self.twin_weight or self._distils
        says = "set method.logit_weight, .feature_weight or .{}_weight above 0"
        check_of_use("method.sees", sees, "whole", of_twins, says.format("twin"))
        taught = self._distils or self.uses_target
        check_of_use("method.teacher", teacher, "mean", taught, says.format("target"))
        asked = f"{says.format('target')} with method.teacher=mean"
        check_of_use("method.momentum", momentum, 0.99, self._asks_means, asked)
        self.wants = Wants(
            twin=self.sees if self.twin_weight or self._distils else None,
            again=self.again_weight > 0 or self.view_weight > 0,
            target_twin=self.uses_target,
        )

    @property
    def _distils(self) -> bool:
        return self.logit_weight > 0 or self.feature_weight > 0

    @property
    def _asks_means(self) -> bool:
        """Whether running means of the student teach."""
        distil = self._distils and self.taught_by == "mean"
        return self.taught_by != "shared" and (self.uses_target or distil)

    def prepare(self, net: Any) -> None:
        """A teacher of its own, unless it is shared or says nothing."""
        super().prepare(net)
        if self.feature_weight:
            check_taught(net, "method.feature_weight", "set method.feature_weight=0")
        if self.taught_by == "own":
            self.expert = copy.deepcopy(net)
        if not self._asks_means:
            self.teacher = None

    def loss(
        self, net: Any, batch: dict[str, Any], generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Terms "ce", "twin", "logits", "features", "again", "views" and "target", each >= 0."""
        if self.teacher is not None and batch.get("step_begins", True):
            self.follow(net)
        source = batch["source"]
        features = net.features(source["points"]).global_  # [B, D]
        logits = net.head(features)
        terms = {"ce": class_loss(logits, source["y_source"], self.smoothing)}
        if self.wants.twin:
            terms |= self._of_the_twin(net, source, features, logits)
        if self.wants.again:
            again = net(source["again"])
        if self.again_weight:
            ce = class_loss(again, source["y_source"], self.smoothing)
            terms["again"] = _weighted(self.again_weight, ce)
        if self.view_weight:
            terms["views"] = _weighted(self.view_weight, jensen_shannon(logits, again))
        if self.target_weight:
            ramp = self.target_weight * math.exp(-5 * (1 - batch["progress"]) ** 2)
            terms["target"] = ramp * self._of_the_target(net, batch["target"])
        return terms

    def _of_the_twin(
        self, net: Any, source: dict[str, Tensor], features: Tensor, logits: Tensor
    ) -> dict[str, Tensor]:
        """What the twins teach: their own classes, and the scans'.

        Teachers do not run in `no_grad`, in which a net looks at its input's values and a GPU would
        wait: nothing of theirs asks for a gradient, and what is detached keeps none.
        """
        terms, twin = {}, source["twin"]
        learner = self.expert if self.taught_by == "own" else net
        if self.twin_weight or self.taught_by == "shared":
            own = learner.features(twin).global_
            classes = learner.head(own)
        if self.twin_weight:
            ce = class_loss(classes, source["y_source"], self.smoothing)
            terms["twin"] = _weighted(self.twin_weight, ce)
        if not self._distils:
            return terms
        if self.taught_by == "mean":
            own = self.teacher.features(twin).global_
            classes = self.teacher.head(own)
        if self.logit_weight:
            distance = distillation(classes.detach(), logits, self.temperature)
            terms["logits"] = _weighted(self.logit_weight, distance)
        if self.feature_weight:
            cosine = F.cosine_similarity(own.detach().float(), features.float(), dim=1)
            terms["features"] = _weighted(self.feature_weight, (1 - cosine).mean())
        return terms

    def _of_the_target(self, net: Any, target: dict[str, Tensor]) -> Float[Tensor, ""]:
        """Cross-entropy of cut target clouds with what the teacher says of them before the cut."""
        teacher = net if self.taught_by == "shared" else self.teacher
        with use_domain(net, "target"), use_domain(teacher, "target"):
            said = teacher(target["twin"]).detach()
            student = net(target["points"])
        return F.cross_entropy(student, (said / self.target_temperature).softmax(dim=1))


def _weighted(factor: float, loss: Tensor) -> Tensor:
    """`factor` times a loss; as it is at 1, which saves a GPU a kernel there and one back."""
    return loss if factor == 1 else factor * loss


def distillation(
    teacher: Float[Tensor, "b c"], student: Float[Tensor, "b c"], temperature: float
) -> Float[Tensor, ""]:
    """T² KL(softmax(teacher / T) || softmax(student / T)) in nats, mean over the clouds, >= 0.

    Hinton, Vinyals, Dean, "Distilling the Knowledge in a Neural Network", 2015: with T² gradients
    keep their size as T grows.
    """
    q = (teacher.float() / temperature).log_softmax(dim=1)
    p = (student.float() / temperature).log_softmax(dim=1)
    return F.kl_div(p, q, log_target=True, reduction="sum") * (temperature**2 / len(p))


def jensen_shannon(first: Float[Tensor, "b c"], second: Float[Tensor, "b c"]) -> Float[Tensor, ""]:
    """Of two softmaxes: mean divergence of both from their mean, in [0, ln 2] nats."""
    p, q = first.float().log_softmax(dim=1), second.float().log_softmax(dim=1)
    mean = torch.logaddexp(p, q) - math.log(2)
    both = [F.kl_div(mean, one, log_target=True, reduction="batchmean") for one in (p, q)]
    return (both[0] + both[1]) / 2
