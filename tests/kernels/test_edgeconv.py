import torch
from torch import nn

from qs3.geometry.neighbours import knn
from qs3.kernels.edgeconv import _Moments, neighbour_max
from qs3.models.dgcnn import EdgeConv
from tests.models.reference import NaiveEdgeConv


def _pair(norm: str, c: int = 6, d: int = 9, seed: int = 0) -> tuple[EdgeConv, NaiveEdgeConv]:
    torch.manual_seed(seed)
    ours = EdgeConv(c, d, norm=norm).double()
    with torch.no_grad():
        nn.init.normal_(ours.norm.weight)
        nn.init.normal_(ours.norm.bias)
        ours.norm.weight[0] = -1.3
        if norm == "batch":
            ours.norm.running_mean.normal_()
            ours.norm.running_var.uniform_(0.5, 2)
    assert (ours.norm.weight < 0).any()
    assert (ours.norm.weight > 0).any()
    return ours, NaiveEdgeConv(ours)


def test_float32_statistics_do_not_cancel() -> None:
    ours, _ = _pair("batch", c=3)
    x = torch.randn(2, 200, 3) + 30  # std 1 at distance 30
    index = knn(x, 10)
    single = EdgeConv(3, 9)
    single.load_state_dict(ours.state_dict())
    torch.testing.assert_close(
        single(x, index).double(), ours(x.double(), index), rtol=0, atol=2e-4
    )


def test_neighbour_ops_have_right_gradients() -> None:
    torch.manual_seed(0)
    x = torch.randn(7, 3, dtype=torch.float64, requires_grad=True)
    index = torch.randint(7, (5, 4))
    assert torch.autograd.gradcheck(lambda x: neighbour_max(x, index), x)
    clouds = torch.randn(2, 5, 3, dtype=torch.float64, requires_grad=True)
    index = torch.randint(10, (10, 4))
    assert torch.autograd.gradcheck(lambda x: _Moments.apply(x, index), clouds)
