"""t-SNE against its equations: perplexity, a numeric gradient, and clusters that stay together."""

import numpy as np
import pytest

from qs3.errors import ConfigError
from qs3.report.runs.tsne import affinities, gradient, pca, tsne


def points(n=60, d=8, seed=0):
    return np.random.default_rng(seed).normal(size=(n, d))


def squared_distances(x):
    return ((x[:, None] - x[None]) ** 2).sum(axis=2)


def conditional(squared, i, sigma):
    """Eq. 1, spelt out."""
    row = np.array([np.exp(-s / (2 * sigma**2)) if j != i else 0 for j, s in enumerate(squared[i])])
    return row / row.sum()


def test_affinities_have_the_perplexity():
    """A search for each point's sigma by itself gives the same joint probabilities."""
    squared, perplexity = squared_distances(points(40)), 7.0
    rows = []
    for i in range(40):
        low, high = 0.1, 1e3
        for _ in range(100):
            sigma = np.sqrt(low * high)
            p = conditional(squared, i, sigma)
            entropy = -sum(v * np.log2(v) for v in p if v > 0)
            low, high = (sigma, high) if 2**entropy < perplexity else (low, sigma)
        rows.append(conditional(squared, i, sigma))
    p = np.array(rows)
    found = affinities(squared, perplexity)
    np.testing.assert_allclose(found, (p + p.T) / 80, atol=1e-9)
    assert found.sum() == pytest.approx(1)
    x = points(20)  # far away, and copies
    x[0] += 1e4
    x[1:4] = x[4]
    assert affinities(squared_distances(x), 3.0).sum() == pytest.approx(1)
    with pytest.raises(ConfigError, match="perplexity"):
        affinities(squared_distances(x), 20.0)


def test_gradient_is_that_of_the_divergence():
    rng = np.random.default_rng(1)
    p, y = affinities(squared_distances(points(12)), 4.0), rng.normal(size=(12, 2))
    slope, loss = gradient(p, y)
    kernel = 1 / (1 + squared_distances(y))
    np.fill_diagonal(kernel, 0)
    q = kernel / kernel.sum()
    off = ~np.eye(12, dtype=bool)
    assert loss == pytest.approx((p[off] * np.log(p[off] / q[off])).sum())
    for i, k in ((0, 0), (3, 1), (11, 0)):
        step = np.zeros_like(y)
        step[i, k] = 1e-5
        numeric = (gradient(p, y + step)[1] - gradient(p, y - step)[1]) / 2e-5
        assert slope[i, k] == pytest.approx(numeric, rel=1e-4, abs=1e-9)


def test_clusters_stay_together():
    centres = 12 * np.eye(5)
    x = np.repeat(np.pad(centres, ((0, 0), (0, 20))), 25, axis=0)
    x = x + np.random.default_rng(2).normal(size=x.shape) * 0.5
    labels = np.repeat(np.arange(5), 25)
    y = tsne(x, perplexity=10)
    squared = squared_distances(y)
    np.fill_diagonal(squared, np.inf)
    assert (labels[squared.argmin(axis=1)] == labels).all()
    np.testing.assert_array_equal(y, tsne(x, perplexity=10))
    p = affinities(squared_distances(x) / x.var(), 10.0)
    loss = gradient(p, y)[1]
    flat = min(gradient(p, scale * pca(x, 2))[1] for scale in np.logspace(-3, 1, 40))
    assert loss < 0.7 * flat
    assert loss < 1.05 * gradient(p, tsne(x, perplexity=10, steps=1500))[1]  # it has settled


def test_small_and_flat_problems():
    assert np.isfinite(tsne(points(5), steps=50)).all()
    assert np.isfinite(tsne(np.ones((8, 3)), steps=50)).all()
    assert tsne(points(9, 1), steps=50).shape == (9, 2)
    with pytest.raises(ConfigError, match="5 points"):
        tsne(points(4))


def test_pca_of_a_plane():
    rng = np.random.default_rng(3)
    flat = rng.normal(size=(50, 2)) * [5, 1]
    turn, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    found = pca(flat @ turn[:2] + 3, 2)
    np.testing.assert_allclose(squared_distances(found), squared_distances(flat), atol=1e-9)
    assert found[:, 0].std() > found[:, 1].std()
    assert pca(points(4, 3), 50).shape == (4, 3)
