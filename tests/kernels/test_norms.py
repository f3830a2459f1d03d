import copy

import numpy as np
import pytest
import torch
from torch import nn

from qs3.evaluation.metrics import predict
from qs3.evaluation.norms import adapt_norms
from qs3.kernels.norms import (
    DomainNorm,
    adapt_batchnorm,
    track,
    use_domain,
    use_trained,
)
from qs3.models.dgcnn import dgcnn
from qs3.models.pointnet import pointnet


def _clouds(b: int, seed: int = 0, n: int = 40) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(b, n, 3, generator=generator, dtype=torch.float64)


def _running(net: nn.Module) -> list[torch.Tensor]:
    return [b.clone() for n, b in net.named_buffers() if "running" in n]


def _used(net: nn.Module, domain: str) -> set[str]:
    """Whose norms clouds of `domain` are served with."""
    with use_trained(net, domain):
        return {m.domain for m in net.modules() if isinstance(m, DomainNorm)}


@pytest.mark.parametrize("momentum", [0.1, None])
def test_track_is_what_torch_does(momentum: float | None) -> None:
    torch.manual_seed(0)
    ours, theirs = nn.BatchNorm1d(3, momentum=momentum), nn.BatchNorm1d(3, momentum=momentum)
    for rows in (5, 9, 2):
        x = torch.randn(rows, 3)
        theirs(x)
        track(ours, x.mean(0), x.var(0, correction=0), rows)
    for a, b in zip(ours.buffers(), theirs.buffers(), strict=True):
        torch.testing.assert_close(a, b)
    before = ours.running_mean.clone()
    track(ours.eval(), torch.ones(3), torch.ones(3), 4)
    assert torch.equal(ours.running_mean, before)


def test_what_is_kept_of_the_former_statistics() -> None:
    """Of every norm that share, and of the new ones, found in the same passes, the rest."""
    torch.manual_seed(0)
    net = dgcnn(4).double()
    net.train()
    net(_clouds(6))
    twin = copy.deepcopy(net)
    before, batches = _running(net), [_clouds(9)[:5], _clouds(9)[5:]]
    adapt_batchnorm(twin, batches)
    adapt_batchnorm(net, batches, kept=0.3)
    for now, old, new in zip(_running(net), before, _running(twin), strict=True):
        torch.testing.assert_close(now, 0.3 * old + 0.7 * new)


def test_each_layer_is_served_by_the_norm_that_was_trained() -> None:
    """As methods train them that show their target to the backbone alone; AdaBN is of the same."""
    torch.manual_seed(0)
    net = pointnet(3, norm="domain").double()
    points = _clouds(6)
    net(points)
    with use_domain(net, "target"):
        net.features(3 * points + 1)
    parts = (net.backbone, net.head)
    assert [_used(part, "target") for part in parts] == [{"target"}, {"source"}]
    assert _used(net, "source") == {"source"}
    with torch.no_grad(), use_domain(net.eval().backbone, "target"):
        expected = net(points).softmax(1).numpy()
    np.testing.assert_array_equal(predict(net, points, 6), expected)
    before = copy.deepcopy(net.state_dict())
    adapt_norms(net, points, 6, seed=0)
    changed = {k for k, value in net.state_dict().items() if not torch.equal(value, before[k])}
    trained = {k for k in before if ("target" if k.startswith("backbone") else "source") in k}
    assert changed == {k for k in trained if "running" in k or "num_batches" in k}
