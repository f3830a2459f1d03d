import copy
from collections.abc import Iterator

import pytest
import torch
from torch.nn import functional as F

from qs3.geometry.neighbours import knn
from qs3.models.base import ClassHead, PointClassifier
from qs3.models.dgcnn import DGCNN, dgcnn
from tests.models.reference import NaiveDGCNN


def _small(k: int = 5, variant: str = "uda", norm: str = "batch") -> PointClassifier:
    torch.manual_seed(0)
    return dgcnn(4, k=k, variant=variant, norm=norm, dropout=0.0)


@pytest.mark.parametrize("variant", ["uda", "simpleview"])
@pytest.mark.parametrize("norm", ["batch", "instance"])
@pytest.mark.parametrize("training", [True, False])
def test_equals_naive_network(variant: str, norm: str, training: bool) -> None:
    torch.manual_seed(0)
    backbone = DGCNN(k=5, variant=variant, norm=norm, widths=(8, 8, 16, 24), embedding=32)
    model = PointClassifier(backbone, ClassHead(64, 4, hidden=(16, 8), dropout=0.0)).double()
    twin = NaiveDGCNN(copy.deepcopy(model)).double()
    model.train(training)
    twin.train(training)
    points = torch.randn(3, 24, 3, dtype=torch.float64)
    labels = torch.tensor([0, 1, 3])
    a, b = model(points), twin(points)
    torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)
    F.cross_entropy(a, labels).backward()
    F.cross_entropy(b, labels).backward()
    for mine, theirs in zip(model.backbone.edge_convs, twin.edge_convs, strict=True):
        torch.testing.assert_close(
            mine.linear.weight.grad, theirs.weight.grad, rtol=1e-8, atol=1e-9
        )
    torch.testing.assert_close(
        model.backbone.conv5.weight.grad, twin.conv5.weight.grad, rtol=1e-8, atol=1e-9
    )


def _error(value: list[torch.Tensor], truth: list[torch.Tensor]) -> float:
    pairs = zip(value, truth, strict=True)
    errors = torch.stack([(a.double() - b).norm() / b.norm() for a, b in pairs])
    return float(errors.square().mean().sqrt())


def test_float32_errs_no_more_than_twice_the_straight_one() -> None:
    """Logits and the gradients of the EdgeConvs' weights, against float64, as a mean of seeds.

    With k = n neighbours never change, so no choice of a neighbour outweighs all rounding.
    """
    totals = torch.zeros(2, 2)
    for seed in range(4):
        torch.manual_seed(seed)
        exact = dgcnn(4, k=24, dropout=0.0).double()
        straight = NaiveDGCNN(copy.deepcopy(exact).float())
        nets = [exact, copy.deepcopy(exact).float(), straight]
        points = torch.randn(6, 24, 3) / 2
        found = []
        for net in nets:
            logits = net(points.double() if net is exact else points)
            F.cross_entropy(logits, torch.tensor([0, 1, 2, 3, 0, 1])).backward()
            convs = net.edge_convs if net is straight else net.backbone.edge_convs
            weights = [e.weight if net is straight else e.linear.weight for e in convs]
            found.append(([logits.detach()], [w.grad for w in weights]))
        for i in (0, 1):  # ours, straight
            totals[i, 0] += _error(found[i + 1][0], found[0][0])
            totals[i, 1] += _error(found[i + 1][1], found[0][1])
    assert (totals[0] <= 2 * totals[1]).all(), totals


def test_autocast_keeps_neighbours_in_float32(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    net = _small(k=8).eval()  # a norm over two clouds in the head would magnify the rounding
    points = torch.randn(2, 64, 3)
    found: list[torch.Tensor] = []

    def spy(x: torch.Tensor, k: int) -> torch.Tensor:
        found.append(knn(x, k))
        return found[-1]

    monkeypatch.setattr("qs3.models.dgcnn.knn", spy)
    levels, plain = net.features(points).per_point, net(points)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(net.features(points).per_point, levels)
        half = net(points)
    assert all(torch.equal(a, b) for a, b in zip(found[:8], found[8:], strict=True))
    assert half.dtype == torch.bfloat16
    torch.testing.assert_close(half.float(), plain, rtol=0.02, atol=0.02)


@pytest.fixture
def deterministic() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)
    torch.set_num_threads(threads)


@pytest.mark.usefixtures("deterministic")
@pytest.mark.parametrize("threads", [1, 2])
def test_same_bytes_every_time(threads: int) -> None:
    torch.set_num_threads(threads)
    points = torch.randn(4, 200, 3, generator=torch.Generator().manual_seed(0))

    def gradients() -> list[torch.Tensor]:
        model = _small(k=20)
        F.cross_entropy(model(points), torch.tensor([0, 1, 2, 3])).backward()
        return [p.grad for p in model.parameters()]

    first = gradients()
    assert all(torch.equal(a, b) for a, b in zip(first, gradients(), strict=True))
