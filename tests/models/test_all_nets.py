"""What every net of conf/model must do; a new file there is tested without another word."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torch import nn
from torch.nn import functional as F

from qs3.errors import ConfigError, DataError
from qs3.models.base import PointClassifier
from tests.unchecked import unchecked

CONF = Path(__file__).parents[2] / "conf" / "model"
FROZEN = {"features"}  # a file's net and a head: see test_features
NETS = sorted({path.stem for path in CONF.glob("*.yaml")} - FROZEN)
ORDER_MATTERS = {
    "pointdan": "its nodes are found by farthest point sampling, which starts at point 0",
    "pointnet2": "sampling starts at point 0, and a full ball keeps the first points by index",
    "pointnet2_ssg": "as pointnet2",
    "rscnn": "as pointnet2",
}


def build(name: str, **settings: Any) -> PointClassifier:
    """The net of conf/model/`name`.yaml for 5 classes, float64."""
    torch.manual_seed(0)
    config = OmegaConf.load(CONF / f"{name}.yaml")
    bases = [b for b in config.pop("defaults", []) if b != "_self_"]
    config = OmegaConf.merge(*(OmegaConf.load(CONF / f"{b}.yaml") for b in bases), config)
    config.num_classes = 5
    return instantiate(config, **settings).double().eval()


def clouds(b: int, n: int) -> torch.Tensor:
    """Normal clouds in the unit ball: [b, n, 3] float64."""
    generator = torch.Generator().manual_seed(n)
    points = torch.randn(b, n, 3, generator=generator, dtype=torch.float64)
    return points / points.norm(dim=2).amax(1)[:, None, None]


@pytest.mark.parametrize(
    ("name", "settings", "expected"),
    [
        ("dgcnn", {}, 1_800_330),
        ("dgcnn", {"num_classes": 40}, 1_808_040),
        ("dgcnn", {"norm": "instance"}, 1_800_330),
        ("dgcnn", {"norm": "domain"}, 1_800_330 + 2 * (64 + 64 + 128 + 256 + 512 + 256)),
        ("dgcnn", {"variant": "simpleview"}, 1_801_866),
        ("dgcnn", {"variant": "defrec"}, 2_079_635),
        ("pointnet", {}, 3_463_763),
        ("pointnet", {"num_classes": 40}, 3_471_473),
        ("pointnet", {"norm": "instance"}, 3_463_763),
        ("pointnet", {"variant": "basic"}, 680_778),
        ("pointnet", {"variant": "uda"}, 3_471_827),
        ("pointnet2", {}, 1_735_146),
        ("pointnet2", {"num_classes": 40}, 1_742_856),
        ("pointnet2_ssg", {}, 1_464_650),
        ("rscnn", {}, 1_281_763),
        ("rscnn", {"num_classes": 40}, 1_289_505 - 32),
        ("rscnn", {"relation": "original"}, 1_281_763),
        ("rscnn", {"relation": "paper"}, 1_281_763),
        ("simpleview", {}, 800_122),
        ("simpleview", {"num_classes": 40}, 803_992),
    ],
)
def test_parameter_count(name: str, settings: dict[str, Any], expected: int) -> None:
    net = build(name, **({"num_classes": 10} | settings))
    assert sum(p.numel() for p in net.parameters()) == expected


@pytest.mark.parametrize(
    ("name", "setting", "reason"),
    [
        ("dgcnn", {"variant": "x"}, "'uda', 'simpleview', 'defrec'"),
        ("dgcnn", {"k": 0}, "model.k must be a whole number >= 1, got 0"),
        ("pointdan", {"nodes": 0}, "model.nodes must be a whole number >= 1"),
        ("pointdan", {"radius": 0.0}, "model.radius must be > 0, got 0"),
        ("pointnet", {"variant": "big"}, "'simpleview', 'uda', 'basic'"),
        ("pointnet2", {"variant": "msgg"}, "'ssg' or 'msg'"),
        ("rscnn", {"relation": "x"}, "relation must be 'released'"),
        ("simpleview", {"image_size": 4}, "norm=batch) must be a whole number >= 8, got 4"),
        (
            "simpleview",
            {"image_size": 8, "norm": "instance"},
            "norm=instance) must be a whole number >= 9",
        ),
        ("simpleview", {"channels": 0}, "model.channels must be a whole number >= 1"),
        ("simpleview", {"views": (6,)}, "views must be some of 0 to 5"),
        ("simpleview", {"views": ()}, "views must be some of 0 to 5"),
        ("simpleview", {"up": "x"}, "up must be"),
        ("simpleview", {"pixel": "mean"}, "pixel must be"),
        *((name, {"norm": "layer"}, "'instance', 'domain', got 'layer'") for name in NETS),
    ],
)
def test_bad_settings(name: str, setting: dict[str, Any], reason: str) -> None:
    with pytest.raises(InstantiationException) as caught:
        build(name, **setting)
    assert isinstance(caught.value.__cause__, ConfigError)
    assert reason in str(caught.value.__cause__)


@unchecked
@pytest.mark.parametrize(
    ("setting", "name", "reason"),
    [
        ({"k": 2.5}, "dgcnn", "model.k must be a whole number >= 1, got 2.5"),
        ({"k": "many"}, "dgcnn", "model.k must be a whole number >= 1, got 'many'"),
        ({"neighbours": 0.5}, "pointdan", "model.neighbours must be a whole number >= 1"),
        ({"image_size": 9.5}, "simpleview", "norm=batch) must be a whole number >= 8, got 9.5"),
    ],
)
def test_settings_of_another_type(setting: dict[str, Any], name: str, reason: str) -> None:
    test_bad_settings(name, setting, reason)


@pytest.mark.parametrize("name", NETS)
def test_interface(name: str) -> None:
    net, points = build(name), clouds(2, 70)
    assert isinstance(net, PointClassifier)
    features = net.features(points)
    assert features.global_.shape == (2, net.backbone.feature_dim)
    assert features.per_point is None or features.per_point.shape[:2] == (2, 70)
    torch.testing.assert_close(net.head(features.global_), net(points))
    assert net(points).shape == (2, 5)


@pytest.mark.parametrize("name", NETS)
def test_a_cloud_alone_gives_what_it_gives_among_others(name: str) -> None:
    net, points = build(name), clouds(3, 70)
    alone = torch.cat([net(cloud[None]) for cloud in points])
    torch.testing.assert_close(net(points), alone, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("n", [1, 7, 130])
@pytest.mark.parametrize("name", NETS)
def test_any_number_of_points(name: str, n: int) -> None:
    assert build(name)(clouds(1, n)).isfinite().all()


@pytest.mark.parametrize("kind", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("name", NETS)
def test_weights_in_half_precision(name: str, kind: torch.dtype) -> None:
    logits = build(name).to(kind)(clouds(2, 40).to(kind))
    assert logits.dtype == kind
    assert logits.isfinite().all()


@pytest.mark.parametrize("name", NETS)
def test_one_point_many_times(name: str) -> None:
    net, points = build(name), torch.full((2, 60, 3), 0.3, dtype=torch.float64)
    assert net(points).isfinite().all()
    F.cross_entropy(net.train()(points), torch.tensor([0, 1])).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in net.parameters())


@pytest.mark.parametrize("name", NETS)
def test_order_of_points(name: str) -> None:
    net, points = build(name), clouds(2, 90)
    if name in ORDER_MATTERS:
        pytest.skip(ORDER_MATTERS[name])
    shuffled = points[:, torch.randperm(90, generator=torch.Generator().manual_seed(1))]
    torch.testing.assert_close(net(shuffled), net(points), rtol=1e-6, atol=1e-8)


COMPILED = """
import copy, sys, torch
from tests.models.test_all_nets import build, clouds
net, points = build(sys.argv[1]), clouds(3, 70)
twin = copy.deepcopy(net)
twin.compile(backend="eager")
assert list(twin.state_dict()) == list(net.state_dict())
torch.testing.assert_close(twin(points), net(points), rtol=1e-9, atol=1e-9)
outs = []
for some in (net, twin):
    torch.manual_seed(0)  # dropout
    outs.append(some.train()(points))
    outs[-1].square().sum().backward()
torch.testing.assert_close(*outs, rtol=1e-9, atol=1e-9)
for mine, theirs in zip(twin.parameters(), net.parameters(), strict=True):
    torch.testing.assert_close(mine.grad, theirs.grad, rtol=1e-7, atol=1e-7)
left_out = sys.argv[1] in ("pointnet2", "pointnet2_ssg", "rscnn")
assert (torch._dynamo.utils.counters["stats"]["unique_graphs"] == 0) == left_out
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", NETS)
def test_compiled(name: str) -> None:
    """As torch's compiler records it: the same numbers, under the same names.

    Without its kernels, which take minutes to make; without jaxtyping, which it cannot follow.
    """
    command = [sys.executable, "-W", "ignore", "-c", COMPILED, name]
    run = subprocess.run(command, cwd=CONF.parents[1], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", NETS)
def test_bad_points_name_the_item(name: str, value: float) -> None:
    points = clouds(3, 40)
    points[1, 3, 2] = value
    with pytest.raises(DataError, match="batch item 1"):
        build(name)(points)


@pytest.mark.parametrize("name", NETS)
def test_autocast(name: str) -> None:
    """bfloat16 moves logits by much less than they differ from cloud to cloud.

    Neighbours and coordinates in bfloat16 would move them by half of that and more. Gradients are
    finite, float32, and there for each parameter.
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
    error = (found.float() - expected).square().mean().sqrt()
    assert error < 0.25 * expected.std(0).mean()
    net.train()
    with torch.autocast("cpu", torch.bfloat16):
        loss = F.cross_entropy(net(points), torch.arange(8) % 5)
    loss.backward()
    for key, parameter in net.named_parameters():
        assert parameter.grad is not None, key
        assert parameter.grad.dtype == torch.float32
        assert parameter.grad.isfinite().all(), key
