import copy

import torch
from torch import nn

from qs3.geometry.neighbours import knn
from qs3.kernels.edgeconv import _Moments, neighbour_max
from qs3.models.dgcnn import EdgeConv


def test_float32_statistics_do_not_cancel() -> None:
    torch.manual_seed(0)
    single = EdgeConv(3, 9)
    nn.init.normal_(single.norm.weight)
    x = torch.randn(2, 200, 3) + 30  # std 1 at distance 30
    index = knn(x, 10)
    found, exact = single(x, index).double(), copy.deepcopy(single).double()
    torch.testing.assert_close(found, exact(x.double(), index), rtol=0, atol=2e-4)


def test_neighbour_ops_have_right_gradients() -> None:
    torch.manual_seed(0)
    x = torch.randn(7, 3, dtype=torch.float64, requires_grad=True)
    index = torch.randint(7, (5, 4))
    assert torch.autograd.gradcheck(lambda x: neighbour_max(x, index), x)
    clouds = torch.randn(2, 5, 3, dtype=torch.float64, requires_grad=True)
    index = torch.randint(10, (10, 4))
    assert torch.autograd.gradcheck(lambda x: _Moments.apply(x, index), clouds)
