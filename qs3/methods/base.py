"""What a method is: a loss on a batch, and perhaps heads of its own.

A batch is `{"source": {"points": [B, N, 3], "y_source": [B]}, "target": {"points": ...},
"progress": p, "step_begins": first}`, with only the domains that the method asks for. Labels
carry their owner's name, so reading a label that one must not see is a KeyError. `p` in (0, 1] is
the part of the warm-up that is done after this batch: 1 in its last one. `first`, True where it is
not said, is whether it is the first of an optimiser's step, which may take several
(`trainer.accumulate_grad_batches`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from qs3.errors import ConfigError
from qs3.utils.settings import NotNegative

if TYPE_CHECKING:
    from qs3.datamodules.adaptation import AdaptationData
    from qs3.models.base import Features

Weight = NotNegative  # of a loss; 0 switches it off
Batch = dict[str, Any]
Terms = dict[str, Float[Tensor, ""]]  # of a loss, by name


class Method(nn.Module):
    """Loss of the warm-up. Subclasses may own parameters: they are optimised, too.

    Attributes:
        labels: whose labels it trains on: "source", or "target_train" (the upper bound only).
        uses_target: whether its batches hold unlabelled target clouds.
        beside_source: whether those of a method of the target's labels hold the source's, too.
        smoothing: of class labels (`class_loss`); the trainer sets it to `protocol.smoothing`.
        metres: whether clouds keep their size (`data.scale`); the trainer says so. A loss with
            lengths in it divides by each cloud's size then.
    """

    labels: ClassVar[str] = "source"
    uses_target: ClassVar[bool] = False
    beside_source: ClassVar[bool] = False
    smoothing: float = 0.0
    metres: bool = False

    def prepare(self, net: nn.Module) -> None:
        """Make the heads that this method puts on `net`. Called once, before `loss`.

        Their weights come from torch's global generator, which the caller has seeded.
        """

    def start_epoch(self, net: nn.Module, data: AdaptationData, epoch: int, epochs: int) -> None:
        """Prepare an epoch of the warm-up (of `epochs`); what it leaves must lie in buffers."""

    def learning_rates(self, net: nn.Module) -> Sequence[tuple[nn.Module, float]]:
        """Modules that learn at another rate than `protocol.optimizer.lr`, and its factors."""
        return ()

    def loss(self, net: nn.Module, batch: Batch, generator: torch.Generator) -> Terms:
        """Terms of the loss by name; their sum is minimised.

        Args:
            net: [B, N, 3] to logits [B, C].
            batch: augmented, on the device of `net`.
            generator: all randomness of this step comes from it; on the same device.
        """
        raise NotImplementedError


def total_loss(method: nn.Module, terms: dict[str, Tensor]) -> Float[Tensor, ""]:
    """The sum of the terms of a method's loss.

    Raises:
        ConfigError: one is not a scalar: a loss of each cloud would be summed, not averaged.
    """
    for name, term in terms.items():
        if term.ndim:
            raise ConfigError(f"{type(method).__name__}.loss: {name!r} must be a scalar tensor")
    return torch.stack(list(terms.values())).sum()


def class_loss(
    logits: Float[Tensor, "b c"], labels: Tensor, smoothing: float = 0.0
) -> Float[Tensor, ""]:
    """Cross-entropy with a part of each label spread over the other classes.

    The target is 1 - ε at the label and ε / (C - 1) elsewhere, as in DGCNN's released code and
    SimpleView's protocol. (torch spreads `label_smoothing` over all C classes: ε C / (C - 1).)

    Args:
        logits: any real numbers.
        labels: [B] int64, or [B, C] probabilities, which are smoothed alike.
        smoothing: ε in [0, 1 - 1 / C].
    """
    classes = logits.shape[1]
    return F.cross_entropy(logits, labels, label_smoothing=smoothing * classes / (classes - 1))


@torch.no_grad()
def feature_dims(net: Any) -> tuple[int, int | None]:
    """Widths of a net's features: of a cloud, and of a point (None: it has none per point)."""
    features = _of_two_clouds(net)
    per_point = features.per_point
    return features.global_.shape[1], None if per_point is None else per_point.shape[2]


def _of_two_clouds(net: Any) -> Features:
    """Features of two clouds in eval mode; nothing in the net changes."""
    parameter = next(net.parameters())
    points = torch.linspace(-1, 1, 2 * 64 * 3, device=parameter.device, dtype=parameter.dtype)
    points = torch.sin(7919 * points).view(2, 64, 3)  # spread out, without drawing at random
    training = net.training
    net.eval()
    try:
        return net.features(points)
    finally:
        net.train(training)
