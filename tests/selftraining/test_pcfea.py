"""PCFEA: the closed form against draws and loops, its pools by hand, and a part only they show."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from qs3.errors import ConfigError
from qs3.selftraining.pcfea import Pcfea, moments, penultimate, plain_epochs, style
from tests.methods.shapes import CLASSES, tiny_net


def _figures(classes: int = 3, width: int = 4) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    weights, shift, root = (
        torch.randn(*shape, generator=generator).double()
        for shape in ((classes, width), (classes, width), (classes, width, width))
    )
    return weights, root @ root.transpose(1, 2) / width, shift


def test_style_by_loops() -> None:
    weights, covariance, shift = _figures()
    found = style(weights, covariance, shift, 0.3)
    for y in range(3):
        for j in range(3):
            apart = weights[j] - weights[y]
            expected = 0.15 * apart @ covariance[y] @ apart + 0.3 * apart @ shift[y]
            torch.testing.assert_close(found[y, j], expected)


def test_styled_logits_are_the_mean_over_styled_features() -> None:
    """log E sum_j exp(w_j' f' - w_y' f') over f' = f + λ shift + N(0, λ S_y), by 400,000 draws."""
    weights, covariance, shift = _figures()
    weights, grown, y = 0.5 * weights, 0.2, 1
    f = torch.randn(4, generator=torch.Generator().manual_seed(1)).double()
    logits = (weights @ f + style(weights, covariance, shift, grown)[y])[None]
    root = torch.linalg.cholesky(grown * covariance[y])
    draws = torch.randn(400_000, 4, generator=torch.Generator().manual_seed(2)).double() @ root.T
    each = (f + grown * shift[y] + draws) @ weights.T  # [draws, 3]
    expected = (each - each[:, y : y + 1]).exp().sum(1).mean().log()
    found = F.cross_entropy(logits, torch.tensor([y]))
    assert found.item() == pytest.approx(expected.item(), rel=0.01)
    assert found > F.cross_entropy(each, torch.full((len(each),), y))  # the bound (Jensen)


def test_moments_are_numpy_s_and_empty_classes_zero() -> None:
    features, labels = torch.randn(30, 5).double(), torch.arange(30) % 3 * 2  # 0, 2, 4
    mean, covariance = moments(features, labels, 6)
    for k in (0, 2, 4):
        of_class = features[labels == k].numpy()
        np.testing.assert_allclose(mean[k], of_class.mean(0), atol=1e-12)
        np.testing.assert_allclose(covariance[k], np.cov(of_class.T, bias=True), atol=1e-12)
    assert not mean[[1, 3, 5]].any()
    assert not covariance[[1, 3, 5]].any()


def _data(b: int = 40) -> Any:
    generator = torch.Generator().manual_seed(0)
    source, target = (torch.rand(b, 16, 3, generator=generator) * 2 - 1 for _ in range(2))
    return _both(source, torch.arange(b) % CLASSES, target, 16)


def _both(source: torch.Tensor, labels: torch.Tensor, target: torch.Tensor, size: int) -> Any:
    ids = [f"{i:03d}" for i in range(len(labels))]
    clouds = SimpleNamespace(points=source)
    return SimpleNamespace(
        labelled=SimpleNamespace(clouds=clouds, labels=labels, ids=ids),
        target=SimpleNamespace(points=target, ids=list(ids)),
        eval_batch_size=size,
    )


def test_pools_are_due_every_twentieth_after_a_tenth() -> None:
    """Ten epochs of a hundred, then every five, as in the paper; others in proportion."""
    for epochs, expected in ((100, list(range(10, 100, 5))), (3, [1, 2]), (40, range(4, 40, 2))):
        net, method, due = tiny_net(), Pcfea(), []
        method.prepare(net)
        for epoch in range(epochs):
            method.mean.fill_(math.nan)
            method.start_epoch(net, _data(8), epoch, epochs)
            if not method.mean.isnan().any():
                due.append(epoch)
            assert method.styled == (epoch >= expected[0])
        assert due == list(expected)


def test_a_pool_by_hand() -> None:
    """From the source alone to nearly the target alone; training mode and norms are left alone."""
    net, data = tiny_net(), _data()
    method = Pcfea()
    method.prepare(net)
    net.train()
    before = {key: value.clone() for key, value in net.state_dict().items()}
    method.start_epoch(net, data, 10, 100)
    torch.testing.assert_close(method.mean, method.source_mean)
    method.start_epoch(net, data, 55, 100)
    assert net.training
    assert all(torch.equal(value, before[key]) for key, value in net.state_dict().items())
    net.eval()
    with torch.no_grad():
        sides = [penultimate(net, x) for x in (data.labelled.clouds.points, data.target.points)]
    labels = [data.labelled.labels, sides[1][1].argmax(1)]
    for k in range(CLASSES):
        pool = []
        for (f, z), y in zip(sides, labels, strict=True):
            p, own = z.softmax(1)[:, k], (y == k).nonzero()[:, 0]
            best = own[p[own].argsort(descending=True)][: round(0.5 * len(own))]
            pool.append(f[best])
        both = torch.cat(pool)
        expected = both.mean(0) if len(both) else method.source_mean[k]
        torch.testing.assert_close(method.mean[k], expected, rtol=1e-4, atol=1e-5)
        if len(both):
            centred = both - both.mean(0)
            torch.testing.assert_close(
                method.covariance[k], centred.T @ centred / len(both), rtol=1e-4, atol=1e-5
            )
        of_class = sides[0][0][labels[0] == k]
        torch.testing.assert_close(method.source_mean[k], of_class.mean(0), rtol=1e-4, atol=1e-5)


def test_terms_before_and_with_a_pool() -> None:
    net, data = tiny_net(norm=False), _data()
    method = Pcfea(align_weight=2.0)
    method.prepare(net)
    source = {"points": data.labelled.clouds.points, "y_source": data.labelled.labels}
    batch = {"source": source, "target": {"points": data.target.points}, "progress": 0.6}
    plain = method.loss(net, batch, torch.Generator())
    expected = F.cross_entropy(net(source["points"]), source["y_source"])
    torch.testing.assert_close(plain, {"ce": expected})
    method.start_epoch(net, data, 55, 100)
    terms = method.loss(net, batch, torch.Generator())
    assert set(terms) == {"ce", "align_source", "align_target"}
    with torch.no_grad():
        f, z = penultimate(net, source["points"])
        shift = method.mean - method.source_mean
        added = style(net.head[-1].weight, method.covariance, shift, 0.25 * 0.6)
        ce = [(z[i] + added[y]).log_softmax(0)[y] for i, y in enumerate(source["y_source"])]
        cos = F.cosine_similarity(f[:, None], method.mean[None], dim=2) / 2
    torch.testing.assert_close(terms["ce"], -torch.stack(ce).mean())
    align = 2 * F.cross_entropy(cos, source["y_source"])
    torch.testing.assert_close(terms["align_source"], align)


@pytest.mark.parametrize(
    ("plain", "epochs", "first"),
    [(0.07, 100, 7), (0.07, 101, 8), (0.1, 100, 10), (0.1, 3, 1), (0, 1, 0), (0.14, 50, 7)],
)
def test_plain_epochs_by_hand(plain, epochs, first):
    assert plain_epochs(plain, epochs) == first


@pytest.mark.parametrize(("plain", "epochs"), [(0.1, 1), (0.95, 19), (0.7, 3)])
def test_an_epoch_must_be_left_for_a_pool(plain, epochs):
    with pytest.raises(ConfigError):
        plain_epochs(plain, epochs)
