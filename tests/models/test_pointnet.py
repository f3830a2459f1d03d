import pytest
import torch

from qs3.models.pointnet import TNet, transform_regulariser


def test_tnet_starts_near_what_it_is_asked_and_regulariser_is_known() -> None:
    net = TNet(3).eval()
    torch.nn.init.zeros_(net.cloud[-1].weight)
    torch.nn.init.zeros_(net.cloud[-1].bias)
    matrix = net(torch.randn(2, 8, 3))
    assert torch.equal(matrix, torch.eye(3).expand(2, 3, 3))
    assert transform_regulariser(matrix).item() == 0
    # I - A A' = -3 I for A = 2 I: its norm is 3 sqrt(3)
    assert transform_regulariser(2 * matrix).item() == pytest.approx(3 * 3**0.5)
