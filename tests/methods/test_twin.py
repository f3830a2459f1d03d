"""Twin: the loss by hand."""

from __future__ import annotations

import torch
from torch.nn import functional as F

from qs3.methods.twin import Twin
from tests.methods.shapes import tiny_net


def test_both_draws_teach_the_class() -> None:
    net, method, points = tiny_net(norm=False), Twin(again_weight=13.0), torch.rand(2, 4, 24, 3)
    assert method.again
    assert not method.uses_target
    labels = torch.arange(4)
    batch = {"source": {"points": points[0], "again": points[1], "y_source": labels}}
    terms = method.loss(net, batch, torch.Generator())
    assert set(terms) == {"ce", "again"}
    torch.testing.assert_close(terms["ce"], F.cross_entropy(net(points[0]), labels))
    torch.testing.assert_close(terms["again"], 13 * F.cross_entropy(net(points[1]), labels))
