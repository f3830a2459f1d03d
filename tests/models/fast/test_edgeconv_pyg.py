"""Our EdgeConv against PyTorch Geometric's on the same edges: an implementation by others."""

import pytest
import torch
from torch import nn
from torch_geometric.nn import EdgeConv as PygEdgeConv

from qs3.geometry.neighbours import knn
from qs3.models.dgcnn import EdgeConv


def pyg_twin(ours, in_channels):
    """PyG feeds its net (x_i, x_j - x_i); ours takes (x_j - x_i, x_i)."""
    out_channels = ours.linear.out_features
    linear = nn.Linear(2 * in_channels, out_channels, bias=False).double()
    norm = nn.BatchNorm1d(out_channels).double()
    theirs = PygEdgeConv(nn.Sequential(linear, norm, nn.LeakyReLU(0.2)), aggr="max")
    with torch.no_grad():  # after PyG has drawn weights of its own
        w_difference, w_centre = ours.linear.weight.split(in_channels, dim=1)
        linear.weight.copy_(torch.cat([w_centre, w_difference], dim=1))
        norm.weight.copy_(ours.norm.weight)
        norm.bias.copy_(ours.norm.bias)
    return theirs


def edges(index):
    """[2, B * N * k] source and target of a batch's graphs, numbered through."""
    b, n, k = index.shape
    offset = (torch.arange(b) * n)[:, None, None]
    target = (torch.arange(n)[None, :, None] + offset).expand(b, n, k)
    return torch.stack([(index + offset).reshape(-1), target.reshape(-1)])


@pytest.mark.parametrize("training", [True, False])
def test_outputs_statistics_and_gradients_equal_pyg(training):
    torch.manual_seed(0)
    ours = EdgeConv(5, 7).double()
    with torch.no_grad():
        ours.norm.weight.normal_()  # negative ones too
        ours.norm.bias.normal_()
    theirs = pyg_twin(ours, 5)
    ours.train(training)
    theirs.train(training)
    x = torch.randn(3, 40, 5, dtype=torch.float64)
    index = knn(x, 6)
    a = x.clone().requires_grad_()
    b = x.reshape(-1, 5).clone().requires_grad_()
    out_a, out_b = ours(a, index), theirs(b, edges(index)).reshape(3, 40, 7)
    torch.testing.assert_close(out_a, out_b, rtol=0, atol=1e-10)
    weights = torch.randn_like(out_a)
    (out_a * weights).sum().backward()
    (out_b * weights).sum().backward()
    torch.testing.assert_close(a.grad.reshape(-1, 5), b.grad, rtol=0, atol=1e-10)
    norm = theirs.nn[1]
    torch.testing.assert_close(ours.norm.weight.grad, norm.weight.grad, rtol=0, atol=1e-10)
    torch.testing.assert_close(ours.norm.running_var, norm.running_var, rtol=0, atol=1e-10)
