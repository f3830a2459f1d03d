"""GAST without its self-training: two questions about geometry, put to clouds of both domains.

Zou et al., "Geometry-Aware Self-Training for Unsupervised Domain Adaptation on Object Point
Clouds", ICCV 2021. The self-training that completes it is `selftraining=spst`.
"""

from typing import Annotated, Any, ClassVar

import torch
from annotated_types import Ge
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from qs3.geometry.neighbours import farthest_point_sampling, gather
from qs3.kernels.device import exact_products
from qs3.kernels.norms import use_domain
from qs3.methods.base import Batch, Method, Terms, Weight, feature_dims
from qs3.methods.defrec import VOXELS, cloud_size, deform
from qs3.methods.pcm import join, source_loss
from qs3.utils.settings import checked

_QUARTERS = 4


class Gast(Method):
    r"""L = w_c L_s + w_d [DefCls(x_s) + DefCls(x_t)] + w_r [RotCls(x_s) + RotCls(x_t)].

    DefCls: one of 27 voxels of a cloud is deformed (`deform`): which? Cross-entropy
    of a linear map of the cloud's vector. RotCls: a cloud is mixed with itself, one part turned
    about x, the other about y, each by a multiple of 90 degrees (`turn_parts`): by which?
    λ CE(h_1, a) + (1 - λ) CE(h_2, b), h_1 and h_2 linear.

    Args:
        class_weight: w_c; the released code's default is 0.5, its logs have 0.5 to 1.
        def_weight: w_d; 0.5, in the logs 0.2 to 1; 0 leaves it out.
        rot_weight: w_r; 0.2, in the logs 0.1 to 1; 0 leaves it out, as the released code does
            unless asked (RotCls_on_src, RotCls_on_trgt), although the paper has it.
        min_points: of a voxel that may be deformed: 20, of clouds of 1024 points, in
            proportion of others (see `deform`).
        pcm: mix source clouds for L_s (a switch of the released code).

    Not taken over from the released code: one tensor for both rotation labels, so that both heads
    learn the turn about y; and label 0 for a cloud without a voxel to deform (here it does not
    count).
    """

    uses_target: ClassVar[bool] = True

    @checked
    def __init__(
        self,
        class_weight: Weight = 0.5,
        def_weight: Weight = 0.5,
        rot_weight: Weight = 0.2,
        min_points: Annotated[int, Ge(1)] = 20,
        pcm: bool = False,
    ) -> None:
        super().__init__()
        self.class_weight, self.def_weight, self.rot_weight = class_weight, def_weight, rot_weight
        self.min_points, self.pcm = min_points, pcm
        self.def_head: nn.Module | None = None
        self.rot_heads: nn.ModuleList | None = None

    def prepare(self, net: nn.Module) -> None:
        """Linear heads: 27 voxels; four turns, twice. Only those of losses in use."""
        width, _ = feature_dims(net)
        if self.def_weight:
            self.def_head = nn.Linear(width, VOXELS)
        if self.rot_weight:
            self.rot_heads = nn.ModuleList(nn.Linear(width, _QUARTERS) for _ in range(2))

    def loss(self, net: Any, batch: Batch, generator: torch.Generator) -> Terms:
        """Terms "ce" or "pcm", "def_source", "def_target", "rot_source", "rot_target"; >= 0.

        Where a head knows nothing, a "def" is w_d ln 27 and a "rot" w_r ln 4.
        """
        name, supervised = source_loss(net, batch["source"], generator, self.smoothing, self.pcm)
        terms = {name: self.class_weight * supervised}
        for domain in ("source", "target"):
            points = batch[domain]["points"]
            with use_domain(net, domain):
                if self.def_head is not None:
                    terms[f"def_{domain}"] = self.def_weight * self._where(net, points, generator)
                if self.rot_heads is not None:
                    terms[f"rot_{domain}"] = self.rot_weight * self._turns(net, points, generator)
        return terms

    def _where(self, net: Any, points: Tensor, generator: torch.Generator) -> Tensor:
        assert self.def_head is not None
        size = cloud_size(points) if self.metres else 1.0
        deformed = deform(points / size, generator, self.min_points)
        logits = self.def_head(net.features(deformed.points * size).global_)  # [B, 27]
        each = F.cross_entropy(logits, deformed.voxel, reduction="none")  # [B]
        counts = deformed.mask.any(1)
        return torch.where(counts, each, 0.0).sum() / counts.sum().clamp_min(1)

    def _turns(self, net: Any, points: Tensor, generator: torch.Generator) -> Tensor:
        assert self.rot_heads is not None
        mixed, about_x, about_y, lam = turn_parts(points, generator)
        features = net.features(mixed).global_  # [B, D]
        first, second = (head(features) for head in self.rot_heads)  # [B, 4] each
        return lam * F.cross_entropy(first, about_x) + (1 - lam) * F.cross_entropy(second, about_y)


def turn_parts(
    points: Float[Tensor, "b n 3"], generator: torch.Generator
) -> tuple[Float[Tensor, "b n 3"], Int[Tensor, " b"], Int[Tensor, " b"], Float[Tensor, ""]]:
    """Each cloud mixed with itself: a part turned about x, a part turned about y.

    λ ~ Beta(1, 1), one a batch. The parts are round(λN) and N - round(λN) farthest points, each
    sampled from a random point of its own (so points may be in both); two independent turns by
    0, 90, 180 or 270 degrees for each cloud; all in random order.

    Returns:
        Mixed clouds in the dtype of `points`, also under autocast; quarter turns about x [B];
        quarter turns about y [B]; λ.
    """
    b, n, _ = points.shape
    own, device = generator.device, points.device
    lam = torch.rand((), generator=generator, device=own).to(device)
    start = torch.randint(n, (2 * b,), generator=generator, device=own).to(device)
    turns = torch.randint(_QUARTERS, (2, b), generator=generator, device=own).to(device)
    shuffle = torch.randperm(n, generator=generator, device=own).to(device)
    twice = torch.cat([points, points])  # both samplings at once
    first, second = gather(twice, farthest_point_sampling(twice, n, start)).chunk(2)
    with torch.autocast(device.type, enabled=False), exact_products():
        first = first @ quarter_turns(turns[0], "x").to(points.dtype)
        second = second @ quarter_turns(turns[1], "y").to(points.dtype)
    mixed = join(first, second, lam)[:, shuffle]
    return mixed, turns[0], turns[1], lam


def quarter_turns(turns: Int[Tensor, " b"], axis: str) -> Int[Tensor, "b 3 3"]:
    """What multiplies row vectors from the right to turn them about "x" or "y", exactly.

    Made of `turns` (0 to 3) alone: a table of constants would have to be carried to the device.
    """
    cos = (turns == 0).long() - (turns == 2).long()
    sin = (turns == 1).long() - (turns == 3).long()
    zero, one = torch.zeros_like(cos), torch.ones_like(cos)
    if axis == "x":
        entries = [one, zero, zero, zero, cos, -sin, zero, sin, cos]
    else:
        entries = [cos, zero, sin, zero, one, zero, -sin, zero, cos]
    return torch.stack(entries, dim=1).view(-1, 3, 3)
