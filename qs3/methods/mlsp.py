"""MLSP: of a masked region of target clouds tell where points were, how many, and the surface.

Liang et al., "Point Cloud Domain Adaptation via Masked Local 3D Structure Prediction", ECCV 2022.
"""

from typing import Annotated, Any, ClassVar

import torch
from annotated_types import Ge
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from qs3.geometry.neighbours import gather, knn
from qs3.kernels.device import exact_products
from qs3.kernels.norms import use_domain
from qs3.methods.base import Batch, Method, Terms, Weight
from qs3.methods.defrec import ReconstructionHead, cloud_size, deform, masked_mean, nearest
from qs3.methods.pcm import source_loss
from qs3.utils.settings import Share, checked

CARDINALITIES = 16
RADIUS = 0.12  # of the ball in which points are counted, in radii of the cloud
NEIGHBOURS = 16  # of a point, by which its normal is found
_SCALE = 20.0  # of the Chamfer distance, as in DefRec


class Mlsp(Method):
    r"""L = (1 - w) L_s + w 20 Chamfer + w_n (1 - |cos|) + w_c CE, the last three of masked points.

    L_s is the cross-entropy of source clouds, or PCM's of mixed ones. One voxel of each target
    cloud is masked as DefRec deforms it (`deform`). One head predicts for each of its
    points a position, a normal and a cardinality (`cardinalities`). The prediction at a position is
    compared with what is true at the nearest original point, and the truth of each original point
    with the prediction at the nearest position; means over the points each way, and over the
    clouds that have a voxel to mask. The sign of a normal does not matter.

    Args:
        position_weight: w in [0, 1].
        normal_weight, cardinality_weight: w_n, w_c; 0 leaves one out.
        min_points: of a voxel that may be masked: 40, of clouds of 1024 points, in proportion of
            others.
        pcm: mix source clouds, as in the paper's figures.
        dropout: of the head.

    Differences to the released code: one head instead of three; normals are those of the cloud as
    the net sees it, not of the mesh; no soft labels between cardinalities; points outside of the
    region do not count (there, a 27th).
    """

    uses_target: ClassVar[bool] = True

    @checked
    def __init__(
        self,
        position_weight: Share = 0.5,
        normal_weight: Weight = 0.5,
        cardinality_weight: Weight = 0.05,
        min_points: Annotated[int, Ge(1)] = 40,
        pcm: bool = True,
        dropout: Share = 0.5,
    ) -> None:
        super().__init__()
        self.position_weight, self.normal_weight = position_weight, normal_weight
        self.cardinality_weight = cardinality_weight
        self.min_points, self.pcm, self.dropout = min_points, pcm, dropout
        self.head: ReconstructionHead | None = None

    def prepare(self, net: nn.Module) -> None:
        """The head."""
        self.head = ReconstructionHead(net, self.dropout, 3 + 3 + CARDINALITIES)

    def loss(self, net: Any, batch: Batch, generator: torch.Generator) -> Terms:
        """Terms "ce" or "pcm", "position", "normal" and "cardinality", each >= 0.

        Where the head knows nothing, "cardinality" is 2 w_c ln 16.
        """
        name, supervised = source_loss(net, batch["source"], generator, self.smoothing, self.pcm)
        terms = {name: (1 - self.position_weight) * supervised}
        with use_domain(net, "target"):
            return terms | self._structure(net, batch["target"]["points"], generator)

    def _structure(self, net: Any, points: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
        assert self.head is not None, "prepare() comes first"
        size = cloud_size(points) if self.metres else 1.0
        unit = points / size
        masked = deform(unit, generator, self.min_points)
        predicted = self.head(net.features(masked.points * size)).float()  # [B, N, 22]
        position, normal, logits = predicted.split([3, 3, CARDINALITIES], dim=2)
        with torch.no_grad():
            there, home = nearest(position, unit.float(), masked.mask, masked.mask)  # [B, N] each
            normals, counts = normals_of(unit), cardinalities(unit)
        at = gather(unit, there)
        pairs = {  # from predicted positions to original points, and back
            "position": (
                (position - at).square().sum(2),
                (gather(position, home) - unit).square().sum(2),
            ),
            "normal": (
                _apart(normal, gather(normals, there)),
                _apart(gather(normal, home), normals),
            ),
            "cardinality": (
                _each(logits, counts.gather(1, there)),
                _each(gather(logits, home), counts),
            ),
        }
        weights = {
            "position": _SCALE * self.position_weight,
            "normal": self.normal_weight,
            "cardinality": self.cardinality_weight,
        }
        clouds = masked.mask.any(1).sum().clamp_min(1)
        return {
            name: weights[name]
            * (masked_mean(forth, masked.mask) + masked_mean(back, masked.mask)).sum()
            / clouds
            for name, (forth, back) in pairs.items()
        }


def _apart(predicted: Float[Tensor, "b n 3"], true: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n"]:
    """1 - |cos|, in [0, 1]."""
    return 1 - F.cosine_similarity(predicted, true, dim=2).abs()


def _each(logits: Float[Tensor, "b n k"], labels: Int[Tensor, "b n"]) -> Float[Tensor, "b n"]:
    """Cross-entropy of each point."""
    return F.cross_entropy(logits.transpose(1, 2), labels, reduction="none")


def normals_of(points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n 3"]:
    """Unit normal of the plane through a point's `NEIGHBOURS` nearest (itself included), ± n.

    float32, also under autocast.
    """
    b, n, _ = points.shape
    around = gather(points, knn(points, NEIGHBOURS))  # [b, n, k, 3]
    around = (around - around.mean(dim=2, keepdim=True)).flatten(0, 1).float()
    with torch.autocast(points.device.type, enabled=False), exact_products():
        return thinnest(around.transpose(1, 2) @ around).view(b, n, 3)


def thinnest(scatter: Float[Tensor, "b 3 3"]) -> Float[Tensor, "b 3"]:
    """Unit eigenvector of the smallest eigenvalue of symmetric, positive semidefinite matrices.

    By powers of the adjugate, whose largest eigenvalue is of that vector: unlike an eigenvalue
    routine it never waits for an accelerator. Where two are equally small, any vector of theirs.
    """
    size = scatter.diagonal(dim1=1, dim2=2).sum(dim=1).clamp_min(1e-12)
    a = scatter / size[:, None, None] + 1e-4 * torch.eye(3, device=scatter.device).to(scatter)
    rows = [torch.linalg.cross(a[:, i], a[:, (i + 1) % 3], dim=1) for i in (1, 2, 0)]
    power = torch.stack(rows, dim=1)  # the adjugate: cross products of rows
    for _ in range(6):
        power = power / power.flatten(1).norm(dim=1)[:, None, None]
        power = power @ power
    longest = power.norm(dim=2).argmax(dim=1)[:, None, None]
    vector = power.take_along_dim(longest, dim=1)[:, 0]
    return vector / vector.norm(dim=1, keepdim=True)


def cardinalities(points: Float[Tensor, "b n 3"]) -> Int[Tensor, "b n"]:
    """Points within `RADIUS` of each (itself included) in twos of 1,024, from 0; 15 and more: 15.

    A cloud of another size is counted as if each point were 1024 / N.
    """
    n = points.shape[1]
    with exact_products():
        within = (torch.cdist(points.float(), points.float()) <= RADIUS).sum(dim=2)
    return (within * 512 // n).clamp_max(CARDINALITIES - 1)
