"""t-SNE: points of many dimensions laid out on a plane, neighbours near each other.

van der Maaten and Hinton, "Visualizing Data using t-SNE", JMLR 9, 2008: equations are those of
that paper. Exact (no tree): O(n²) a step, some 20 s for 1,200 points.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from qs3.errors import ConfigError

_EXAGGERATION, _EARLY = 12.0, 100  # section 3.4 has 4 and 50; 12 is what later programs use
_LEAST = 1e-12


def pca(features: Float[np.ndarray, "n d"], dimensions: int) -> Float[np.ndarray, "n k"]:
    """Coordinates along the directions of largest variance, k = min(dimensions, n, d).

    Signs are fixed (the largest entry of a direction is positive), so the result is repeatable.
    """
    centred = features - features.mean(axis=0)
    _, _, directions = np.linalg.svd(centred, full_matrices=False)
    directions = directions[:dimensions]
    largest = np.take_along_axis(directions, np.abs(directions).argmax(axis=1)[:, None], axis=1)
    return centred @ (directions * np.where(largest < 0, -1.0, 1.0)).T


def affinities(squared: Float[np.ndarray, "n n"], perplexity: float) -> Float[np.ndarray, "n n"]:
    """Symmetric joint probabilities p_ij, of sum 1 (eq. 1 and section 3.1).

    The Gaussian about each point is as wide as gives its neighbours the perplexity (2 to the
    entropy in bits), found by bisection of 1 / (2 σ²) for all points at once.

    Args:
        squared: squared distances.
        perplexity: about how many neighbours a point has; below n.
    """
    n = len(squared)
    if not 1 <= perplexity < n:
        raise ConfigError(f"perplexity must lie in [1, {n}), got {perplexity}")
    others = ~np.eye(n, dtype=bool)
    gaps = squared[others].reshape(n, n - 1)
    gaps = gaps - gaps.min(axis=1, keepdims=True)  # a factor that cancels; nothing underflows
    low, high = np.zeros(n), np.full(n, np.inf)
    beta = 1 / np.maximum(gaps.mean(axis=1), _LEAST)
    for _ in range(64):
        p = np.exp(-gaps * beta[:, None])
        p /= p.sum(axis=1, keepdims=True)
        entropy = -(p * np.log(np.maximum(p, _LEAST))).sum(axis=1)
        wide = entropy > np.log(perplexity)
        low, high = np.where(wide, beta, low), np.where(wide, high, beta)
        beta = np.where(np.isinf(high), beta * 2, (low + high) / 2)
    joint = np.zeros((n, n))
    joint[others] = p.ravel()
    return (joint + joint.T) / (2 * n)


def gradient(
    p: Float[np.ndarray, "n n"], y: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 2"], float]:
    """The gradient of the Kullback-Leibler divergence by the places y (eq. 5), and it (eq. 2)."""
    norms = (y * y).sum(axis=1)
    kernel = 1 / (1 + np.maximum(norms[:, None] + norms[None] - 2 * y @ y.T, 0))  # Student's t
    np.fill_diagonal(kernel, 0)
    q = np.maximum(kernel / kernel.sum(), _LEAST)
    pull = (p - q) * kernel
    loss = float((p * np.log(np.maximum(p, _LEAST) / q)).sum())
    return 4 * (pull.sum(axis=1)[:, None] * y - pull @ y), loss


def tsne(
    features: Float[np.ndarray, "n d"], perplexity: float = 30.0, steps: int = 500
) -> Float[np.ndarray, "n 2"]:
    """Places on a plane. Nothing is random: the first places are the two main components.

    Args:
        features: at least 5 points; reduced to 50 components first, as in section 4.2.
        perplexity: lowered to (n - 1) / 3 for few points.
        steps: of gradient descent with momentum and gains; the first 100 with exaggerated p.

    Raises:
        ConfigError: too few points.
    """
    n = len(features)
    if n < 5:
        raise ConfigError(f"t-SNE needs at least 5 points, got {n}")
    x = pca(np.asarray(features, dtype=np.float64), 50)
    x = x / max(float(x.std()), _LEAST)
    norms = (x * x).sum(axis=1)
    squared = np.maximum(norms[:, None] + norms[None] - 2 * x @ x.T, 0)
    p = affinities(squared, min(perplexity, (n - 1) / 3))
    y = np.zeros((n, 2))
    first = x[:, :2]
    y[:, : first.shape[1]] = 1e-4 * first / max(float(first.std()), _LEAST)
    speed, gains = np.zeros_like(y), np.ones_like(y)
    rate = max(n / _EXAGGERATION / 4, 50.0)
    for step in range(steps):
        early = step < _EARLY
        slope, _ = gradient(p * _EXAGGERATION if early else p, y)
        gains = np.where(np.sign(slope) != np.sign(speed), gains + 0.2, gains * 0.8)
        gains = np.maximum(gains, 0.01)
        speed = (0.5 if early else 0.8) * speed - rate * gains * slope
        y = y + speed
        y -= y.mean(axis=0)
    return y
