"""What every net of conf/model must do; a new file there is tested without another word."""

from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torch import nn
from torch.nn import functional as F

from qs3.errors import DataError
from qs3.models.base import PointClassifier, check_points

CONF = Path(__file__).parents[2] / "conf" / "model"
NETS = sorted(path.stem for path in CONF.glob("*.yaml"))
UNDROPPED = {"pointdan", "committee"}  # no setting of theirs
LARGE = {"pointnet2", "rscnn", "simpleview"}
EACH = [pytest.param(n, marks=pytest.mark.slow if n in LARGE else ()) for n in NETS]
each_net = pytest.mark.parametrize("name", EACH)
# Farthest point sampling starts at point 0, and a full ball keeps the first points by index.
ORDER_MATTERS = {"pointdan", "pointnet2", "rscnn"}


def build(name: str, **settings: Any) -> PointClassifier:
    """The net of conf/model/`name`.yaml for 5 classes, float64."""
    torch.manual_seed(0)
    config = OmegaConf.load(CONF / f"{name}.yaml")
    config.num_classes = 5
    return instantiate(config, **settings).double().eval()


def clouds(b: int, n: int) -> torch.Tensor:
    """Normal clouds in the unit ball: [b, n, 3] float64."""
    generator = torch.Generator().manual_seed(n)
    points = torch.randn(b, n, 3, generator=generator, dtype=torch.float64)
    return points / points.norm(dim=2).amax(1)[:, None, None]


@each_net
def test_interface(name: str) -> None:
    net, points = build(name), clouds(3, 70)
    features = net.features(points)
    assert features.global_.shape == (3, net.backbone.feature_dim)
    assert features.per_point is None or features.per_point.shape[:2] == (3, 70)
    torch.testing.assert_close(net.head(features.global_), net(points))
    alone = torch.cat([net(cloud[None]) for cloud in points])
    assert alone.shape == (3, 5)
    torch.testing.assert_close(net(points), alone, rtol=1e-6, atol=1e-8)


@each_net
def test_any_number_of_points_and_copies(name: str) -> None:
    net = build(name)
    for n in (1, 7, 130):
        assert net(clouds(1, n)).isfinite().all()
    points = torch.full((2, 60, 3), 0.3, dtype=torch.float64)
    assert net(points).isfinite().all()
    F.cross_entropy(net.train()(points), torch.tensor([0, 1])).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in net.parameters())


@pytest.mark.parametrize("name", sorted(set(NETS) - ORDER_MATTERS))
def test_order_of_points(name: str) -> None:
    settings: dict[str, Any] = {"image_size": 24} if name == "simpleview" else {}
    net, points = build(name, **settings), clouds(2, 90)
    shuffled = points[:, torch.randperm(90, generator=torch.Generator().manual_seed(1))]
    torch.testing.assert_close(net(shuffled), net(points), rtol=1e-6, atol=1e-8)


def test_bad_points() -> None:
    for value in (torch.nan, torch.inf):
        points = clouds(3, 40)
        points[1, 3, 2] = value
        with pytest.raises(DataError, match="item 1"):
            build("pointnet")(points)
    for shape in ((8, 3), (2, 8, 2), (2, 0, 3), (0, 8, 3)):
        with pytest.raises(DataError):
            check_points(torch.zeros(shape))


@each_net
def test_autocast(name: str) -> None:
    """bfloat16 moves logits by much less than they differ from cloud to cloud.

    Neighbours and coordinates in bfloat16 would move them by half of that and more.
    """
    net, points = build(name).float(), clouds(8, 200).float()
    for module in net.modules():
        if isinstance(module, nn.Dropout):
            module.p = 0.0
        if isinstance(module, nn.modules.batchnorm._BatchNorm):
            module.momentum = 1.0
    net.train()(points)  # statistics of these clouds
    expected = net.eval()(points)
    with torch.autocast("cpu", torch.bfloat16):
        found = net(points)
        loss = F.cross_entropy(net.train()(points), torch.arange(8) % 5)
    error = (found.float() - expected).square().mean().sqrt()
    assert error < 0.25 * expected.std(0).mean()
    loss.backward()
    for parameter in net.parameters():
        assert parameter.grad.dtype == torch.float32
        assert parameter.grad.isfinite().all()
