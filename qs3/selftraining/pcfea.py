"""PCFEA: the classifier learns source features styled like the target's, in growing strength.

Wang, Zhao, Wu, Zhou, Xu, "Progressive Classifier and Feature Extractor Adaptation for Unsupervised
Domain Adaptation on Point Clouds", ECCV 2024; the expected loss of Gaussian features in closed form
is of Wang et al., "Implicit Semantic Data Augmentation for Deep Networks", NeurIPS 2019. A method
of the warm-up that stands among the selectors, as one of them may choose its pools.
"""

from __future__ import annotations

import math
from decimal import Decimal
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
import torch
from annotated_types import Interval
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from qs3.errors import ConfigError
from qs3.evaluation.metrics import outputs_of
from qs3.kernels.norms import begin_target_norms, use_domain
from qs3.methods.base import Method, Weight, class_loss
from qs3.selftraining.selectors import (
    TeacherPredictions,
    chosen_by,
    doubts,
    most_confident,
)
from qs3.utils.settings import checked

if TYPE_CHECKING:
    from qs3.datamodules.adaptation import AdaptationData


Share = Annotated[float, Interval(ge=0, lt=1)]


class Pcfea(Method):
    r"""L = CE(z_j + λ/2 (w_j - w_y)' S_y (w_j - w_y) + λ (w_j - w_y)' (m_y - s_y)) + w [A_s + A_t].

    z: logits of a source cloud of class y; w_j: rows of the head's last, linear layer, f its input
    [B, D]; λ = strength p, p the progress. The first term bounds from above the mean cross-entropy
    of features f + λ (m_y - s_y) + N(0, λ S_y): the source's in the target's style. A:
    cross-entropy of cos(f, m_c) / 2 as logits of class c, A_s against the source's labels and A_t
    against the target's present predictions.

    Means m_c and covariances S_c are of a pool that is chosen anew, in eval mode, every so many
    epochs: of each class the share (E - e) / (E - e_0) of the source's clouds and the share
    (e - e_0) / (E - e_0) of the target's, the most probable ones by label and by prediction, at
    epoch e of E. s_c is the mean of all source clouds. Until e_0 there is the plain cross-entropy.
    A class without clouds in the pool has m_c = s_c and S_c = 0.

    Args:
        strength: 0.25; 0 leaves the styling out.
        align_weight: w; 1; 0 leaves the alignment out.
        plain: e_0 / E, rounded up to whole epochs, in [0, 1): 0.1. An epoch must be left, so E >= 2
            unless it is 0.
        every: epochs between two pools, of E: 0.05.
        selector: which clouds of the target are in the pool: None for the growing share, or a
            selector of `selftraining`, such as QBST; pools count as its rounds.
        theta: of that selector.
    """

    uses_target: ClassVar[bool] = True
    mean: Tensor
    source_mean: Tensor
    covariance: Tensor

    @checked
    def __init__(
        self,
        strength: Weight = 0.25,
        align_weight: Weight = 1.0,
        plain: Share = 0.1,
        every: Annotated[float, Interval(gt=0, le=1)] = 0.05,
        selector: Any = None,
        theta: Share = 0.8,
    ) -> None:
        super().__init__()
        self.strength, self.align_weight = strength, align_weight
        self.plain, self.every, self.theta = plain, every, theta
        self.selector = selector
        self.styled = False  # whether there is a pool

    def prepare(self, net: Any) -> None:
        """Room for the figures of a pool, which a checkpoint holds."""
        classes, width = net.head[-1].weight.shape
        self.register_buffer("mean", torch.zeros(classes, width))
        self.register_buffer("source_mean", torch.zeros(classes, width))
        self.register_buffer("covariance", torch.zeros(classes, width, width))

    def loss(
        self, net: Any, batch: dict[str, Any], generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Terms "ce", and once there is a pool "align_source" and "align_target"; each >= 0."""
        source = batch["source"]
        f, z = penultimate(net, source["points"])
        labels = source["y_source"]
        if not self.styled:
            return {"ce": class_loss(z, labels, self.smoothing)}
        grown = self.strength * batch["progress"]
        with torch.autocast(z.device.type, enabled=False):
            shift = self.mean - self.source_mean
            added = style(net.head[-1].weight, self.covariance, shift, grown)
        terms = {"ce": class_loss(z + added[labels], labels, self.smoothing)}
        if self.align_weight:
            with use_domain(net, "target"):
                f_t, z_t = penultimate(net, batch["target"]["points"])
            for domain, x, y in (("source", f, labels), ("target", f_t, z_t.argmax(dim=1))):
                terms[f"align_{domain}"] = self.align_weight * self._align(x, y)
        return terms

    def _align(self, f: Float[Tensor, "b d"], labels: Int[Tensor, " b"]) -> Float[Tensor, ""]:
        cosines = F.normalize(f, dim=1) @ F.normalize(self.mean, dim=1).T
        return F.cross_entropy(cosines / 2, labels)

    def start_epoch(self, net: nn.Module, data: AdaptationData, epoch: int, epochs: int) -> None:
        """Make a new pool, if one is due."""
        first = plain_epochs(self.plain, epochs)
        self.styled = epoch >= first
        between = max(1, round(self.every * epochs))
        if not self.styled or (epoch - first) % between:
            return
        if epoch == first:
            begin_target_norms(net)
        size, classes = data.eval_batch_size, len(self.mean)
        labels = data.labelled.labels.numpy()
        f, p = _features(net, data.labelled.clouds.points, size, "source", self.mean.device)
        g, q = _features(net, data.target.points, size, "target", self.mean.device)
        teacher = TeacherPredictions.of(q, data.target.ids)
        named = teacher.predicted
        progress = (epoch - first) / (epochs - first)
        own, ids = p[np.arange(len(p)), labels], data.labelled.ids
        of_source = most_confident(own, labels, 1 - progress, ids, doubts(p, labels))
        if self.selector is None:
            of_target = most_confident(
                teacher.confidence, named, progress, data.target.ids, teacher.doubt
            )
        else:
            chosen = chosen_by(self.selector, teacher, self.theta, (epoch - first) // between)
            of_target, named = chosen.selected, named if chosen.labels is None else chosen.labels
        source_mean, _ = moments(f, torch.from_numpy(labels), classes)
        pool = torch.cat([f[torch.from_numpy(of_source)], g[torch.from_numpy(of_target)]])
        pooled = torch.from_numpy(np.concatenate([labels[of_source], named[of_target]]))
        mean, covariance = moments(pool, pooled, classes)
        empty = torch.bincount(pooled, minlength=classes) == 0
        mean[empty] = source_mean[empty]
        self.source_mean.copy_(source_mean)
        self.mean.copy_(mean)
        self.covariance.copy_(covariance)


def plain_epochs(plain: float, epochs: int) -> int:
    """The first epoch with a pool: ceil(plain epochs), in decimal arithmetic.

    So 0.07 of 100 epochs are 7, whose product in binary is just above.

    Raises:
        ConfigError: there is none among the `epochs`: PCFEA would be source only.
    """
    first = math.ceil(Decimal(repr(float(plain))) * epochs)
    if first >= epochs:
        raise ConfigError(f"method.plain={plain} of protocol.epochs={epochs} leaves no epoch")
    return first


def penultimate(net: Any, points: Tensor) -> tuple[Float[Tensor, "b d"], Float[Tensor, "b c"]]:
    """What the head's last layer is given, and the logits it makes of it."""
    x = net.features(points).global_
    *layers, last = net.head
    for layer in layers:
        x = layer(x)
    return x, last(x)


def style(
    weights: Float[Tensor, "c d"],
    covariance: Float[Tensor, "c d d"],
    shift: Float[Tensor, "c d"],
    grown: float,
) -> Float[Tensor, "c c"]:
    """What is added to the logit of class j (column) for a feature of class y (row); 0 for y."""
    apart = weights[None] - weights[:, None]  # [y, j, d]: w_j - w_y
    spread = ((apart @ covariance) * apart).sum(dim=2)  # [y, j]
    moved = (apart @ shift[:, :, None])[:, :, 0]  # [y, j]
    return grown / 2 * spread + grown * moved


def moments(
    features: Float[Tensor, "n d"], labels: Int[Tensor, " n"], classes: int
) -> tuple[Float[Tensor, "c d"], Float[Tensor, "c d d"]]:
    """Mean and biased covariance of each class; 0 of one without features."""
    width = features.shape[1]
    mean = torch.zeros(classes, width, dtype=features.dtype)
    covariance = torch.zeros(classes, width, width, dtype=features.dtype)
    for k in labels.unique().tolist():
        of_class = features[labels == k]
        mean[k] = of_class.mean(dim=0)
        centred = of_class - mean[k]
        covariance[k] = centred.T @ centred / len(of_class)
    return mean, covariance


def _features(
    net: nn.Module, points: Tensor, size: int, domain: str, device: Any
) -> tuple[Float[Tensor, "n d"], Float[np.ndarray, "n c"]]:
    """`penultimate` of all clouds in eval mode, float64 on the CPU, and class probabilities."""
    f, z = outputs_of(net, lambda x: penultimate(net, x), points, size, device, domain=domain)
    return f, z.softmax(dim=1).numpy()
