"""DefRec: reconstruct a deformed region of target clouds; with or without PCM.

Achituve, Maron, Chechik, "Self-Supervised Learning for Domain Adaptation on Point Clouds", WACV
2021. A region is a "volume-based voxel" (section 3.1): its points are replaced by a small blob at
its centre. Points are compared by the Chamfer distance of Fan, Su, Guibas, "A Point Set Generation
Network for 3D Object Reconstruction from a Single Image", CVPR 2017, eq. 1, with means in place of
sums.
"""

from typing import Annotated, Any, ClassVar, NamedTuple

import torch
from annotated_types import Ge
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from qs3.errors import ConfigError
from qs3.geometry.neighbours import gather
from qs3.kernels.device import exact_products
from qs3.kernels.norms import use_domain
from qs3.methods.base import Batch, Method, Terms, Weight, feature_dims
from qs3.methods.pcm import source_loss
from qs3.models.base import Features
from qs3.utils.settings import Share, checked

GRID = 3
VOXELS = GRID**3
_STD = 0.001**0.5  # of the blob: the covariance is 0.001 I
_OF = 1024  # points of the clouds for which `min_points` are stated


class Deformed(NamedTuple):
    """Clouds with one voxel deformed."""

    points: Float[Tensor, "b n 3"]
    mask: Bool[Tensor, "b n"]  # points that were replaced; none where no voxel had enough points
    voxel: Int[Tensor, " b"]  # 0 to 26; meaningless where the mask is empty


def voxel_of(points: Float[Tensor, "b n 3"]) -> Int[Tensor, "b n"]:
    """Voxel 9 i + 3 j + k of each point, in a grid of 3 x 3 x 3 on [-1, 1]^3.

    Half-open voxels [low, high); points outside belong to the nearest one. (The released code
    has open ones: a point on a border falls into voxel 0, wherever it is.)
    """
    cell = ((points.float() + 1) * (GRID / 2)).floor().long().clamp(0, GRID - 1)  # [b, n, 3]
    return (cell[..., 0] * GRID + cell[..., 1]) * GRID + cell[..., 2]


def voxel_centre(voxel: Int[Tensor, " b"]) -> Float[Tensor, "b 3"]:
    """Centre of a voxel: -2/3, 0 or 2/3 in each coordinate."""
    cell = torch.stack([voxel // GRID**2, voxel // GRID % GRID, voxel % GRID], dim=1)
    return (cell + 0.5) * (2 / GRID) - 1


def cloud_size(points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b 1 1"]:
    """Largest distance of a point from the origin; 1 where all points lie there."""
    size = points.norm(dim=2).amax(dim=1)[:, None, None]
    return torch.where(size > 0, size, 1)


def deform(points: Float[Tensor, "b n 3"], generator: torch.Generator, min_points: int) -> Deformed:
    """Deform one voxel of each cloud.

    The voxel is the first, in a random order that the batch shares, which holds at least
    `min_points` points in 1,024 of the cloud's: papers and codes say how many for clouds of that
    size, and a cloud of a quarter of the points has a quarter of them in each voxel. Its points
    become draws from N(centre, 0.001 I). The input is left alone.
    """
    b, n, _ = points.shape
    device = points.device
    order = torch.randperm(VOXELS, generator=generator, device=generator.device).to(device)
    noise = torch.randn(b, n, 3, generator=generator, device=generator.device).to(points)
    of = voxel_of(points)  # [b, n]
    counts = torch.zeros(b, VOXELS, dtype=torch.int64, device=device)
    counts.scatter_add_(1, of, torch.ones_like(of))
    enough = _OF * counts[:, order] >= n * min_points  # [b, 27], in the random order
    voxel = order[enough.int().argmax(1)]  # the first True
    mask = (of == voxel[:, None]) & enough.any(1, keepdim=True)
    blob = voxel_centre(voxel).to(points.dtype)[:, None] + _STD * noise  # [b, n, 3]
    return Deformed(torch.where(mask[:, :, None], blob, points), mask, voxel)


def masked_chamfer(
    a: Float[Tensor, "b n 3"],
    b: Float[Tensor, "b m 3"],
    mask_a: Bool[Tensor, "b n"],
    mask_b: Bool[Tensor, "b m"],
) -> Float[Tensor, " b"]:
    """mean_i min_j |a_i - b_j|^2 + mean_j min_i |a_i - b_j|^2, over marked i and j only.

    In squared units of the clouds, >= 0; 0 for a cloud in which nothing is marked (in a or b).
    float32 at least, also under autocast. Nearest points are found without gradient; the
    gradient is that of the distances to them, as that of the minimum.
    """
    with torch.autocast(a.device.type, enabled=False):
        a, b = (x.float() if x.dtype in (torch.float16, torch.bfloat16) else x for x in (a, b))
        to_b, to_a = nearest(a.detach(), b.detach(), mask_a, mask_b)
        forth = (a - gather(b, to_b)).square().sum(2)  # [b, n]
        back = (b - gather(a, to_a)).square().sum(2)  # [b, m]
        both = mask_a.any(1, keepdim=True) & mask_b.any(1, keepdim=True)
        return masked_mean(forth, mask_a & both) + masked_mean(back, mask_b & both)


def nearest(a: Tensor, b: Tensor, mask_a: Tensor, mask_b: Tensor) -> tuple[Tensor, Tensor]:
    """For each a the nearest marked b [b, n], for each b the nearest marked a [b, m].

    By distances in the dtype of a and b, also under autocast.
    """
    with torch.autocast(a.device.type, enabled=False), exact_products():
        squares = -2 * a @ b.transpose(1, 2)  # [b, n, m]
    squares += a.square().sum(2)[:, :, None]
    squares += b.square().sum(2)[:, None]
    squares.masked_fill_(~(mask_a[:, :, None] & mask_b[:, None]), torch.inf)
    return squares.argmin(2), squares.argmin(1)


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of the marked values of each row, 0 without any: [b, n] -> [b]."""
    return torch.where(mask, values, 0.0).sum(1) / mask.sum(1).clamp_min(1)


class DefRec(Method):
    r"""L = (1 - w) L_s + w 20 Chamfer(h(deformed x_t), x_t), between the deformed points only.

    L_s is the cross-entropy of source clouds, or PCM's of mixed ones. One voxel of each cloud is
    deformed (`deform`); h, a map of each point with features of point and cloud,
    shows where its points had been. The mean is over the clouds that have a voxel to deform (the
    released code divides zero by zero for one without).

    Args:
        defrec_weight: w in [0, 1]. 0.5 is the released code's default, 0.2 that of its scripts;
            the paper chose it for each pair of domains.
        scale: 20 in the released code; QS3's code has 8.
        min_points: of a voxel that may be deformed: 40 in the released code, 20 in QS3's; of
            clouds of 1024 points, in proportion of others (see `deform`).
        pcm: mix source clouds: DefRec+PCM.
        dropout: of the reconstruction head, after its first two layers.
    """

    uses_target: ClassVar[bool] = True

    @checked
    def __init__(
        self,
        defrec_weight: Share = 0.5,
        scale: Weight = 20.0,
        min_points: Annotated[int, Ge(1)] = 40,
        pcm: bool = False,
        dropout: Share = 0.5,
    ) -> None:
        super().__init__()
        self.defrec_weight, self.scale, self.min_points = defrec_weight, scale, min_points
        self.pcm, self.dropout = pcm, dropout
        self.head: ReconstructionHead | None = None

    def prepare(self, net: nn.Module) -> None:
        """The reconstruction head."""
        self.head = ReconstructionHead(net, self.dropout)

    def loss(self, net: Any, batch: Batch, generator: torch.Generator) -> Terms:
        """Terms "ce" or "pcm", and "defrec", each >= 0."""
        name, supervised = source_loss(net, batch["source"], generator, self.smoothing, self.pcm)
        terms = {name: (1 - self.defrec_weight) * supervised}
        with use_domain(net, "target"):
            terms["defrec"] = self._reconstruction(net, batch["target"]["points"], generator)
        return terms

    def _reconstruction(self, net: Any, points: Tensor, generator: torch.Generator) -> Tensor:
        assert self.head is not None, "prepare() comes first"
        size = cloud_size(points) if self.metres else 1.0
        unit = points / size
        deformed = deform(unit, generator, self.min_points)
        predicted = self.head(net.features(deformed.points * size))  # [B, N, 3] in the unit ball
        mask = deformed.mask
        per_cloud = masked_chamfer(predicted, unit, mask, mask)  # [B], 0 without a voxel
        return self.defrec_weight * self.scale * per_cloud.sum() / mask.any(1).sum().clamp_min(1)


class ReconstructionHead(nn.Module):
    """A place for each point: C + D to 256, 256, 128, out, batch norm and ReLU between, no biases.

    The first layer is split in two: what it makes of the cloud's vector is the same for all of
    its points and computed once.

    Args:
        net: has features [B, D] of clouds and [B, N, C] of points.
        dropout: after the first two layers.
        out: 3, or more where more is predicted of a point.

    Raises:
        ConfigError: the net has no features of points.
    """

    def __init__(self, net: nn.Module, dropout: float, out: int = 3) -> None:
        super().__init__()
        cloud_dim, point_dim = feature_dims(net)
        if point_dim is None:
            raise ConfigError("this method needs features of points: choose e.g. model=dgcnn")
        both = nn.Linear(point_dim + cloud_dim, 256, bias=False)  # drawn for both at once
        self.of_point = nn.Parameter(both.weight.detach()[:, :point_dim].clone())
        self.of_cloud = nn.Parameter(both.weight.detach()[:, point_dim:].clone())
        self.rest = nn.Sequential(
            *(nn.BatchNorm1d(256), nn.ReLU(), nn.Dropout(dropout), nn.Linear(256, 256, bias=False)),
            *(nn.BatchNorm1d(256), nn.ReLU(), nn.Dropout(dropout), nn.Linear(256, 128, bias=False)),
            *(nn.BatchNorm1d(128), nn.ReLU(), nn.Linear(128, out, bias=False)),
        )

    def forward(self, features: Features) -> Float[Tensor, "b n out"]:
        """[B, N, C] and [B, D] to [B, N, out]."""
        assert features.per_point is not None
        of_cloud = nn.functional.linear(features.global_, self.of_cloud)[:, None]  # [b, 1, 256]
        x = nn.functional.linear(features.per_point, self.of_point) + of_cloud  # [b, n, 256]
        return self.rest(x.flatten(0, 1)).unflatten(0, x.shape[:2])
