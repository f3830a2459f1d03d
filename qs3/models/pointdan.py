"""PointDAN's generator and its two classifiers.

Qin et al., "PointDAN: A Multi-Scale 3D Domain Adaption Network for Point Cloud Representation",
NeurIPS 2019: PointNet with a module of self-adaptive nodes between its layers.
"""

from typing import Annotated, NamedTuple

import torch
from annotated_types import Ge, Gt
from jaxtyping import Float
from torch import Tensor, nn

from qs3.geometry.ball_query import ball_query
from qs3.geometry.neighbours import farthest_point_sampling, gather
from qs3.kernels.device import exact_products
from qs3.kernels.norms import Norm, head_norm, make_norm
from qs3.models.base import Backbone, Features, PointClassifier
from qs3.models.pointnet import PointMLP, TNet
from qs3.utils.settings import checked


class Nodes(NamedTuple):
    """What the module of nodes makes of a cloud."""

    points: Float[Tensor, "b n 2*c"]  # each one's features and what it gets from its nearest nodes
    features: Float[Tensor, "b m c"]  # of the nodes
    places: Float[Tensor, "b m 3"]  # where they moved to


class NodeModule(nn.Module):
    r"""Self-adaptive nodes (section 3.2 of the paper).

    M nodes by farthest point sampling. Each moves by the mean over its ball's points k of
    tanh(W (f_k - f_node)) * (x_k - x_node), gathers its K nearest points anew, and takes the
    maximum of their mapped features. Each point gets a mean of its three nearest nodes, weighted
    by the inverse of the squared distance.

    Args:
        channels: C of the points' features and of the nodes'.
        nodes: M.
        neighbours: K; also the size of a ball.
        radius: of the balls, in the unit of the points.
    """

    def __init__(
        self,
        channels: int = 64,
        nodes: int = 64,
        neighbours: int = 64,
        radius: float = 0.3,
        norm: Norm = "batch",
    ) -> None:
        super().__init__()
        self.nodes, self.neighbours, self.radius = nodes, neighbours, radius
        self.offset = nn.Linear(channels, 3, bias=False)
        self.residual = PointMLP(channels, channels, norm=norm)

    def forward(self, x: Float[Tensor, "b n 3"], f: Float[Tensor, "b n c"]) -> Nodes:
        """Points [B, N, 3] and their features [B, N, C] to `Nodes`."""
        b, n, _ = x.shape
        k = n if n < self.neighbours else self.neighbours  # as in DGCNN
        # Another start each time in training (torch's generator, as for dropout), none in eval.
        start = torch.randint(n, (b,), device=x.device) if self.training else 0
        index = farthest_point_sampling(x, self.nodes, start)  # [b, m]
        place, feature = gather(x, index), gather(f, index)
        ball = ball_query(x, place, self.radius, k)  # [b, m, k]
        towards = gather(x, ball) - place[:, :, None]  # [b, m, k, 3]
        how_far = torch.tanh(self.offset(gather(f, ball) - feature[:, :, None]))
        place = place + (how_far * towards).mean(2)  # [b, m, 3]
        with torch.no_grad(), torch.autocast(x.device.type, enabled=False), exact_products():
            squares = _squared_distances(place.detach().float(), x.float())  # [b, m, n]
            nearest = squares.topk(k, dim=2, largest=False)[1]
            three = squares.topk(min(3, self.nodes), dim=1, largest=False)[1]  # [b, 3, n]
        nodes = gather(self.residual(f), nearest).amax(2)  # [b, m, c]
        three = three.transpose(1, 2)  # [b, n, 3]
        apart = x[:, :, None] - gather(place, three)  # [b, n, 3, 3]
        apart = apart.to(torch.promote_types(apart.dtype, torch.float32))  # 1e-10 is 0 in float16
        weight = 1 / apart.square().sum(3).clamp_min(1e-10)
        weight = weight / weight.sum(2, keepdim=True)
        back = (weight[..., None] * gather(nodes, three)).sum(2)  # [b, n, c]
        return Nodes(torch.cat([f, back.to(f.dtype)], dim=2), nodes, place)


class PointDanBackbone(Backbone):
    """T-Net 3, 64, 64, T-Net 64, nodes (64 to 128), 128, 1024, maximum, norm.

    Args:
        nodes, neighbours, radius: of `NodeModule`.
        norm: see `qs3.kernels.norms`; the last one is of one vector a cloud, as in a head.
    """

    feature_dim = 1024

    def __init__(
        self, *, nodes: int = 64, neighbours: int = 64, radius: float = 0.3, norm: Norm = "batch"
    ) -> None:
        super().__init__()
        self.input_transform = TNet(3, norm, nn.LeakyReLU)
        self.first = PointMLP(3, 64, 64, norm=norm)
        self.feature_transform = TNet(64, norm, nn.LeakyReLU)
        self.node_module = NodeModule(64, nodes, neighbours, radius, norm)
        self.last = PointMLP(128, 128, 1024, norm=norm)
        self.norm = make_norm(head_norm(norm), 1024)
        self.least_points = max(nodes, neighbours)

    def forward(self, points: Float[Tensor, "b n 3"]) -> Features:
        """One vector a cloud; per point 128 features."""
        return self.with_nodes(points)[0]

    def with_nodes(self, points: Float[Tensor, "b n 3"]) -> tuple[Features, Nodes]:
        """The same, and the nodes, for alignment."""
        with torch.autocast(points.device.type, enabled=False):  # as in PointNet
            transform = self.input_transform(points)
            with exact_products():
                turned = points @ transform
        x = self.first(turned)
        x = x @ self.feature_transform(x)  # [b, n, 64]
        nodes = self.node_module(points, x)
        return Features(self.norm(self.last.maximum(nodes.points)), nodes.points), nodes


class TwoHeads(nn.Module):
    """Two linear classifiers; logits are their mean."""

    def __init__(self, feature_dim: int, num_classes: int) -> None:
        super().__init__()
        self.first = nn.Linear(feature_dim, num_classes)
        self.second = nn.Linear(feature_dim, num_classes)

    def forward(self, features: Float[Tensor, "b d"]) -> Float[Tensor, "b c"]:
        """Mean of both."""
        return (self.first(features) + self.second(features)) / 2


@checked
def pointdan(
    num_classes: int,
    nodes: Annotated[int, Ge(1)] = 64,
    neighbours: Annotated[int, Ge(1)] = 64,
    radius: Annotated[float, Gt(0)] = 0.3,
    norm: Norm = "batch",
) -> PointClassifier:
    """PointDAN's net; any method can train it, `method=pointdan` needs it."""
    backbone = PointDanBackbone(nodes=nodes, neighbours=neighbours, radius=radius, norm=norm)
    return PointClassifier(backbone, TwoHeads(backbone.feature_dim, num_classes))


def _squared_distances(a: Tensor, b: Tensor) -> Tensor:
    """[b, m, 3] and [b, n, 3] to [b, m, n], without gradient."""
    return (
        a.square().sum(2)[:, :, None] + b.square().sum(2)[:, None] - 2 * a @ b.transpose(1, 2)
    ).clamp_min_(0)
