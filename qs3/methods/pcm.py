"""PCM, Point Cloud Mixup: a training cloud is made of parts of two.

Achituve, Maron, Chechik, "Self-Supervised Learning for Domain Adaptation on Point Clouds", WACV
2021. The cross-entropy of mixed clouds takes the place of that of whole ones.
"""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from qs3.geometry.neighbours import farthest_point_sampling, gather
from qs3.methods.base import Batch, Method, Terms, class_loss

Labels = Int[Tensor, " b"] | Float[Tensor, "b c"]  # classes, or their probabilities


def mix(
    points: Float[Tensor, "b n 3"], labels: Labels, generator: torch.Generator
) -> tuple[Float[Tensor, "b n 3"], Labels, Labels, Float[Tensor, ""]]:
    """Each cloud with its partner, another cloud of the batch; or as it is, if that is itself.

    λ ~ Beta(1, 1), one a batch; round(λN) farthest points of the cloud and N - round(λN) of its
    partner, in random order. As the order of farthest point sampling does not depend on how
    many points are taken, each cloud is sampled once, from a random point, for both roles. On
    average one cloud of a batch is its own partner: both roles would take the same first points,
    and half of the cloud would be gone, so it stays whole.

    Returns:
        Mixed clouds, labels of the clouds, labels of their partners, λ.
    """
    b, n, _ = points.shape
    lam = torch.rand((), generator=generator, device=generator.device).to(points.device)
    partner = torch.randperm(b, generator=generator, device=generator.device).to(points.device)
    start = torch.randint(n, (b,), generator=generator, device=generator.device).to(points.device)
    shuffle = torch.randperm(n, generator=generator, device=generator.device).to(points.device)
    ordered = gather(points, farthest_point_sampling(points, n, start))
    alone = partner == torch.arange(b, device=points.device)
    mixed = torch.where(alone[:, None, None], ordered, join(ordered, ordered[partner], lam))
    mixed = mixed[:, shuffle]
    return mixed, labels, labels[partner], lam


def join(
    first: Float[Tensor, "b n 3"], second: Float[Tensor, "b n 3"], lam: Float[Tensor, ""]
) -> Float[Tensor, "b n 3"]:
    """The first round(λN) points of one, then the first N - round(λN) of the other.

    How many they are is never asked, so a device need not be waited for.
    """
    n = first.shape[1]
    own = (lam.double() * n).round().long()
    place = torch.arange(n, device=first.device)
    of_second = second[:, (place - own).clamp_min(0)]
    return torch.where((place < own)[:, None], first, of_second)


def pcm_loss(
    logits: Float[Tensor, "b c"],
    labels_a: Labels,
    labels_b: Labels,
    lam: float | Float[Tensor, ""],
    smoothing: float = 0.0,
) -> Float[Tensor, ""]:
    """λ CE(logits, a) + (1 - λ) CE(logits, b), each as `class_loss`."""
    of_a, of_b = (class_loss(logits, labels, smoothing) for labels in (labels_a, labels_b))
    return lam * of_a + (1 - lam) * of_b


def source_loss(
    net: nn.Module,
    source: dict[str, Any],
    generator: torch.Generator,
    smoothing: float,
    pcm: bool = True,
) -> tuple[str, Float[Tensor, ""]]:
    """What methods add their own losses to: "ce", or "pcm" in its place; and its value, >= 0."""
    if not pcm:
        return "ce", class_loss(net(source["points"]), source["y_source"], smoothing)
    mixed, labels_a, labels_b, lam = mix(source["points"], source["y_source"], generator)
    return "pcm", pcm_loss(net(mixed), labels_a, labels_b, lam, smoothing)


class Pcm(Method):
    """L = λ CE(net(x), y_a) + (1 - λ) CE(net(x), y_b), x mixed of two source clouds.

    The cross-entropy of unmixed clouds is not added, as in the authors' code. This is the
    warm-up of QS3.
    """

    def loss(self, net: nn.Module, batch: Batch, generator: torch.Generator) -> Terms:
        """Mixed cross-entropy, >= 0."""
        return dict([source_loss(net, batch["source"], generator, self.smoothing)])
