"""DefRec: reconstruct a deformed region of target clouds; with or without PCM.

Achituve, Maron, Chechik, "Self-Supervised Learning for Domain Adaptation on Point Clouds", WACV
2021.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.config.checks import check_float, check_int
from qs3.errors import ConfigError
from qs3.kernels.norms import use_domain
from qs3.methods.base import Method, feature_dims, weight
from qs3.methods.chamfer import masked_chamfer
from qs3.methods.deform import cloud_size, deform
from qs3.methods.mixup import source_loss
from qs3.models.base import Features


class DefRec(Method):
    r"""L = (1 - w) L_s + w 20 Chamfer(h(deformed x_t), x_t), between the deformed points only.

    L_s is the cross-entropy of source clouds, or PCM's of mixed ones. One voxel of each cloud is
    deformed (`qs3.methods.deform`); h, a map of each point with features of point and cloud,
    tells where its points had been. The mean is over the clouds that have a voxel to deform (the
    released code divides zero by zero for one without).

    Args:
        defrec_weight: w in [0, 1]. 0.5 is the released code's default, 0.2 that of its scripts;
            the paper chose it for each pair of domains.
        scale: 20 in the released code; QS3's code has 8.
        min_points: of a voxel that may be deformed: 40 in the released code, 20 in QS3's; of
            clouds of 1024 points, in proportion of others (see `deform`).
        pcm: mix source clouds: DefRec+PCM.
        on_source: reconstruct source clouds, too (a switch of the released code).
        dropout: of the reconstruction head, after its first two layers.
    """

    uses_target: ClassVar[bool] = True

    def __init__(
        self,
        defrec_weight: float = 0.5,
        scale: float = 20.0,
        min_points: int = 40,
        pcm: bool = False,
        on_source: bool = False,
        dropout: float = 0.5,
    ) -> None:
        super().__init__()
        check_float("method.defrec_weight", defrec_weight, "[0, 1]")
        self.defrec_weight, self.scale = defrec_weight, weight("scale", scale)
        self.min_points = check_int("method.min_points", min_points, 1)
        self.pcm, self.on_source = pcm, on_source
        self.dropout = check_float("method.dropout", dropout, "[0, 1]")
        self.head: ReconstructionHead | None = None

    def prepare(self, net: nn.Module) -> None:
        """The reconstruction head."""
        cloud, point = feature_dims(net)
        if point is None:
            raise ConfigError(
                "method=defrec needs features of every point, and this model has none; choose "
                "e.g. model=dgcnn or model=pointnet"
            )
        self.head = ReconstructionHead(cloud, point, self.dropout)

    def loss(
        self, net: Any, batch: dict[str, Any], generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Terms "ce" or "pcm", and "defrec" (and "defrec_source"), each >= 0."""
        source = batch["source"]
        name, supervised = source_loss(
            net, source, generator, pcm=self.pcm, smoothing=self.smoothing
        )
        terms = {name: (1 - self.defrec_weight) * supervised}
        with use_domain(net, "target"):
            terms["defrec"] = self._reconstruction(net, batch["target"]["points"], generator)
        if self.on_source:
            terms["defrec_source"] = self._reconstruction(net, source["points"], generator)
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
        cloud_dim: D, of the cloud's vector.
        point_dim: C, of a point's.
        dropout: after the first two layers.
        out: 3, or more where more is told of a point.
    """

    def __init__(self, cloud_dim: int, point_dim: int, dropout: float, out: int = 3) -> None:
        super().__init__()
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
