"""CPCM, cross-domain mixing: of a source and a target cloud mixed the net says the mixture.

Zou et al., "Bridging Simulation-to-Reality Domain Gap via Topology-Aware Representation Learning",
arXiv 2506.21165, one of its losses. Points are exchanged for those that match them.
"""

import math
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from qs3.kernels.norms import use_domain
from qs3.methods.base import Batch, Method, Terms, Weight, class_loss
from qs3.utils.settings import checked


class Cpcm(Method):
    r"""L = CE(net(x_s), y_s) + w angle(net(x_m), λ net(x_s) + (1 - λ) net(x_t)) / π.

    x_m: round(λN) points of a source cloud, and in the places of the others those of a target cloud
    that match them (`exchanged`); λ ~ Beta(1, 1), one a batch; angle: between vectors of logits, in
    [0, π], mean over the pairs. No gradient is stopped.

    Args:
        mix_weight: w; 0 trains on the source alone.

    Not taken over from the released code: it writes the target's points into the source's clouds
    themselves, so that the net is shown the mixture as x_s, too.
    """

    uses_target: ClassVar[bool] = True

    @checked
    def __init__(self, mix_weight: Weight = 1.0) -> None:
        super().__init__()
        self.mix_weight = mix_weight

    def loss(self, net: Any, batch: Batch, generator: torch.Generator) -> Terms:
        """Terms "ce", >= 0, and "mixed", in [0, w]."""
        source, target = batch["source"]["points"], batch["target"]["points"]
        lam = torch.rand((), generator=generator, device=generator.device).to(source.device)
        mixed = exchanged(source, target, lam, generator)
        of_source = net(source)  # [B, C]
        with use_domain(net, "target"):
            of_target = net(target)
        between = angle(net(mixed), lam * of_source + (1 - lam) * of_target)
        ce = class_loss(of_source, batch["source"]["y_source"], self.smoothing)
        return {"ce": ce, "mixed": self.mix_weight / math.pi * between.mean()}


def angle(u: Float[Tensor, "b c"], v: Float[Tensor, "b c"]) -> Float[Tensor, " b"]:
    """Between rows, in [0, π]: 2 atan2(|û - v̂|, |û + v̂|).

    The arc cosine has no gradient where they are parallel or opposite, and few digits near there.
    """
    u, v = (F.normalize(x.float() if x.dtype != torch.float64 else x, dim=1) for x in (u, v))
    return 2 * torch.atan2((u - v).norm(dim=1), (u + v).norm(dim=1))


def exchanged(
    first: Float[Tensor, "b n 3"],
    second: Float[Tensor, "b n 3"],
    lam: Float[Tensor, ""],
    generator: torch.Generator,
) -> Float[Tensor, "b n 3"]:
    """round(λN) points of one cloud, and the matches of the others in the other, in random order.

    Which places are exchanged is drawn once a batch. Points match that have the same place in
    `tree_order`: a stand-in for the assignment of least total distance, which takes cubic time.
    """
    n = first.shape[1]
    places = torch.randperm(n, generator=generator, device=generator.device).to(first.device)
    stays = torch.arange(n, device=first.device) < (lam.double() * n).round()
    return torch.where(stays[:, None], tree_order(first)[:, places], tree_order(second)[:, places])


def tree_order(points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n 3"]:
    """Each cloud in the order of the leaves of a balanced k-d tree: halves along x, y, z, x, ...

    Equally many points have the same place in it in all clouds. Parts of an odd number are sorted
    along the next axis and not divided.
    """
    b, n, _ = points.shape
    part, axis = n, 0
    while part > 1:
        parts = points.reshape(b, n // part, part, 3)
        order = parts[..., axis].argsort(dim=2, stable=True)  # [b, n / part, part]
        points = parts.take_along_dim(order[..., None], dim=2).reshape(b, n, 3)
        if part % 2:
            break
        part, axis = part // 2, (axis + 1) % 3
    return points
