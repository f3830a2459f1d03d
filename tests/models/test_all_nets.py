"""What every net of conf/model must do; a new file there is tested without another word."""

from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from qs3.errors import DataError
from qs3.models.base import PointClassifier

CONF = Path(__file__).parents[2] / "conf" / "model"
NETS = sorted(path.stem for path in CONF.glob("*.yaml"))
ORDER_MATTERS = {
    "pointdan": "its nodes are found by farthest point sampling, which starts at point 0",
    "pointnet2": "sampling starts at point 0, and a full ball keeps the first points by index",
    "pointnet2_ssg": "as pointnet2",
    "rscnn": "as pointnet2",
}


def _build(name: str) -> PointClassifier:
    torch.manual_seed(0)
    config = OmegaConf.load(CONF / f"{name}.yaml")
    bases = [b for b in config.pop("defaults", []) if b != "_self_"]
    config = OmegaConf.merge(*(OmegaConf.load(CONF / f"{b}.yaml") for b in bases), config)
    config.num_classes = 5
    return instantiate(config).double().eval()


def _clouds(b: int, n: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(n)
    points = torch.randn(b, n, 3, generator=generator, dtype=torch.float64)
    return points / points.norm(dim=2).amax(1)[:, None, None]


@pytest.mark.parametrize("name", NETS)
def test_interface(name: str) -> None:
    net, points = _build(name), _clouds(2, 70)
    assert isinstance(net, PointClassifier)
    features = net.features(points)
    assert features.global_.shape == (2, net.backbone.feature_dim)
    assert features.per_point is None or features.per_point.shape[:2] == (2, 70)
    torch.testing.assert_close(net.head(features.global_), net(points))
    assert net(points).shape == (2, 5)


@pytest.mark.parametrize("name", NETS)
def test_a_cloud_alone_gives_what_it_gives_among_others(name: str) -> None:
    net, points = _build(name), _clouds(3, 70)
    alone = torch.cat([net(cloud[None]) for cloud in points])
    torch.testing.assert_close(net(points), alone, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("n", [1, 7, 130])
@pytest.mark.parametrize("name", NETS)
def test_any_number_of_points(name: str, n: int) -> None:
    assert _build(name)(_clouds(1, n)).isfinite().all()


@pytest.mark.parametrize("name", NETS)
def test_one_point_many_times(name: str) -> None:
    points = torch.full((2, 60, 3), 0.3, dtype=torch.float64)
    assert _build(name)(points).isfinite().all()


@pytest.mark.parametrize("name", NETS)
def test_order_of_points(name: str) -> None:
    net, points = _build(name), _clouds(2, 90)
    if name in ORDER_MATTERS:
        pytest.skip(ORDER_MATTERS[name])
    shuffled = points[:, torch.randperm(90, generator=torch.Generator().manual_seed(1))]
    torch.testing.assert_close(net(shuffled), net(points), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", NETS)
def test_bad_points_name_the_item(name: str, value: float) -> None:
    points = _clouds(3, 40)
    points[1, 3, 2] = value
    with pytest.raises(DataError, match="batch item 1"):
        _build(name)(points)
