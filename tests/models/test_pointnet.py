import pytest
import torch
from torch import nn
from torch.nn import functional as F

from qs3.models.pointnet import PointNet, TNet, pointnet, transform_regulariser
from tests.models.reference_pointnet import NaivePointNet


@pytest.mark.parametrize("training", [True, False])
def test_equals_straight_network(training: bool) -> None:
    torch.manual_seed(0)
    model = pointnet(4, dropout=0.0).double()
    for p in model.parameters():  # weights of norms that are negative too
        if p.ndim == 1:
            nn.init.normal_(p, 0.3, 1.0)
    model(torch.randn(6, 30, 3).double())
    twin = NaivePointNet(model.train(training)).train(training)
    points, labels = torch.randn(6, 50, 3).double(), torch.arange(6) % 4
    a, b = model(points), twin(points)
    torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10)
    F.cross_entropy(a, labels).backward()
    F.cross_entropy(b, labels).backward()
    theirs = [*twin.net.parameters(), *twin.head.parameters()]
    for p, q in zip(model.parameters(), theirs, strict=True):
        torch.testing.assert_close(p.grad, q.grad, rtol=1e-9, atol=1e-10)


def test_features_and_gradients() -> None:
    torch.manual_seed(0)
    model = pointnet(4)
    points = torch.randn(3, 25, 3)
    features = model.features(points)
    assert features.global_.shape == (3, PointNet.feature_dim)
    assert features.per_point.shape == (3, 25, 64)
    loss = F.cross_entropy(model.head(features.global_), torch.tensor([0, 1, 2]))
    (loss + 0.001 * features.regulariser).backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in model.parameters())


def test_tnet_starts_near_what_it_is_asked_and_regulariser_is_known() -> None:
    net = TNet(3).eval()
    torch.nn.init.zeros_(net.cloud[-1].weight)
    torch.nn.init.zeros_(net.cloud[-1].bias)
    matrix = net(torch.randn(2, 8, 3))
    assert torch.equal(matrix, torch.eye(3).expand(2, 3, 3))
    assert transform_regulariser(matrix).item() == 0
    # I - A A' = -3 I for A = 2 I: its norm is 3 sqrt(3)
    assert transform_regulariser(2 * matrix).item() == pytest.approx(3 * 3**0.5)
