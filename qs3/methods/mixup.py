"""PCM, Point Cloud Mixup: a training cloud is made of parts of two.

Achituve, Maron, Chechik, "Self-Supervised Learning for Domain Adaptation on Point Clouds", WACV
2021. The loss on mixed clouds takes the place of the plain one.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from qs3.geometry.neighbours import farthest_point_sampling, gather


def mix(
    points: Float[Tensor, "b n 3"], labels: Int[Tensor, " b"], generator: torch.Generator
) -> tuple[Float[Tensor, "b n 3"], Int[Tensor, " b"], Int[Tensor, " b"], float]:
    """Each cloud with its partner, another cloud of the batch (or itself, by chance).

    λ ~ Beta(1, 1), one a batch; round(λN) farthest points of the cloud and N - round(λN) of its
    partner, in random order. As the order of farthest point sampling does not depend on how
    many points are taken, each cloud is sampled once, from a random point, for both roles.

    Returns:
        Mixed clouds, labels of the clouds, labels of their partners, λ.
    """
    b, n, _ = points.shape
    lam = float(torch.rand((), generator=generator, device=generator.device))
    partner = torch.randperm(b, generator=generator, device=generator.device).to(points.device)
    start = torch.randint(n, (b,), generator=generator, device=generator.device).to(points.device)
    shuffle = torch.randperm(n, generator=generator, device=generator.device).to(points.device)
    own = round(lam * n)
    order = farthest_point_sampling(points, max(own, n - own), start)  # [b, m]
    first = gather(points, order[:, :own])
    second = gather(points, order[:, : n - own])[partner]
    mixed = torch.cat([first, second], dim=1)[:, shuffle]
    return mixed, labels, labels[partner], lam


def pcm_loss(
    logits: Float[Tensor, "b c"],
    labels_a: Int[Tensor, " b"],
    labels_b: Int[Tensor, " b"],
    lam: float,
) -> Float[Tensor, ""]:
    """λ CE(logits, a) + (1 - λ) CE(logits, b)."""
    return lam * F.cross_entropy(logits, labels_a) + (1 - lam) * F.cross_entropy(logits, labels_b)
