"""Twin: the loss by hand, and what a second draw shows and the first hides."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from qs3.methods.twin import Twin
from tests.methods.shapes import CLASSES, accuracy, tiny_net, train


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


def blobs(right: Tensor | None, left: Tensor, generator: torch.Generator) -> Tensor:
    """Three points at one of four corners on the right, if any, and seven at one on the left."""
    corners = torch.tensor([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])

    def blob(classes: Tensor, side: float, n: int) -> Tensor:
        centre = torch.cat([torch.full((len(classes), 1), side), corners[classes]], 1)[:, None]
        return 0.6 * centre + 0.05 * torch.randn(len(classes), n, 3, generator=generator)

    seven = blob(left, -1.0, 7)
    return torch.cat([seven[:, :3] if right is None else blob(right, 1.0, 3), seven], 1)


def test_a_second_draw_teaches_what_the_first_hides() -> None:
    """The labelled draw shows an object's right side, the second draw its left, as test clouds do.

    A left corner is the right one of another class; so the copy without the term cannot know it.
    """
    generator = torch.Generator().manual_seed(0)
    labels = torch.arange(256) % CLASSES
    left, held_out = (blobs(None, labels, generator) for _ in range(2))
    mirrored = blobs(None, (labels + 1) % CLASSES, generator)
    right = mirrored * torch.tensor([-1.0, 1.0, 1.0])
    result = []
    for weight in (1.0, 0.0):
        net = tiny_net(0, norm=False)
        beside = ({"again": left}, {})
        train(Twin(weight), net, (right, labels), right, steps=200, seed=0, beside=beside)
        result.append(accuracy(net, held_out, labels))
    assert result[0] > 0.8
    assert result[1] < 0.25
