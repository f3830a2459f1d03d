import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional as F

from qs3.methods.pcm import mix, pcm_loss


def _batch(b: int, n: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Cloud i lies in [2 i, 2 i + 1], so a point tells whose it is."""
    points = torch.rand(b, n, 3) + 2 * torch.arange(b)[:, None, None]
    return points, torch.arange(b)


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 5), st.integers(1, 40), st.integers(0, 10_000))
def test_proportions_and_labels(b: int, n: int, seed: int) -> None:
    points, labels = _batch(b, n)
    mixed, own, other, drawn = mix(points, labels, torch.Generator().manual_seed(seed))
    lam = float(drawn)
    assert torch.equal(own, labels)
    assert sorted(other.tolist()) == labels.tolist()  # a permutation
    assert 0 <= lam <= 1
    owner = (mixed[:, :, 0] // 2).long()
    for i in range(b):
        if other[i] == i:  # it stays whole
            assert torch.equal(mixed[i].sort(dim=0)[0], points[i].sort(dim=0)[0])
        else:
            assert (owner[i] == i).sum() == round(lam * n)
            assert (owner[i] == other[i]).sum() == n - round(lam * n)
        assert all(
            (points[int(o), :] == p).all(1).any() for o, p in zip(owner[i], mixed[i], strict=True)
        )


def test_pcm_loss_known_answer() -> None:
    logits = torch.tensor([[math.log(3.0), 0.0]])  # probabilities 3/4, 1/4
    a, b = torch.tensor([0]), torch.tensor([1])
    expected = 0.3 * math.log(4 / 3) + 0.7 * math.log(4)
    assert pcm_loss(logits, a, b, 0.3).item() == pytest.approx(expected, rel=1e-6)
    torch.testing.assert_close(pcm_loss(logits, a, a, 0.2), F.cross_entropy(logits, a))
