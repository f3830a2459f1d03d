import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.methods.defrec import masked_chamfer


def brute_force(a, b, mask_a, mask_b):
    """Loops over clouds and points."""
    result = []
    for cloud in range(len(a)):
        first, second = a[cloud][mask_a[cloud]], b[cloud][mask_b[cloud]]
        if len(first) == 0 or len(second) == 0:
            result.append(a.new_zeros(()))
            continue
        forth = torch.stack([torch.stack([(p - q).square().sum() for q in second]).min()
                             for p in first])  # fmt: skip
        back = torch.stack([torch.stack([(p - q).square().sum() for p in first]).min()
                            for q in second])  # fmt: skip
        result.append(forth.mean() + back.mean())
    return torch.stack(result)


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 3), st.integers(1, 9), st.integers(1, 9), st.integers(0, 10_000))
def test_values_and_gradients_against_brute_force(b: int, n: int, m: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    a, c = (torch.randn(b, k, 3, generator=generator, dtype=torch.float64) for k in (n, m))
    mask_a, mask_c = (torch.rand(b, k, generator=generator) < 0.6 for k in (n, m))
    a.requires_grad_()
    c.requires_grad_()
    ours = masked_chamfer(a, c, mask_a, mask_c)
    theirs = brute_force(a, c, mask_a, mask_c)
    torch.testing.assert_close(ours, theirs)
    if theirs.requires_grad:
        mine = torch.autograd.grad(ours.sum(), (a, c))
        other = torch.autograd.grad(theirs.sum(), (a, c), allow_unused=True)
        for x, y in zip(mine, other, strict=True):
            torch.testing.assert_close(x, torch.zeros_like(x) if y is None else y)


def test_known_answer() -> None:
    a = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [9, 9, 9]]])
    b = torch.tensor([[[0.0, 2, 0], [0, 0, 0]]])
    mask = torch.tensor([[True, True, False]])
    everything = torch.ones(1, 2, dtype=torch.bool)
    # a to b: 0 and 1, mean 1/2; b to a: 4 and 0, mean 2
    assert masked_chamfer(a, b, mask, everything).item() == pytest.approx(2.5)


def test_unmarked_points_do_not_matter() -> None:
    a, b = torch.randn(2, 20, 3), torch.randn(2, 20, 3)
    mask = torch.arange(20)[None].expand(2, -1) < 7
    elsewhere = torch.where(mask[:, :, None], a, 1e3)
    assert torch.equal(masked_chamfer(a, b, mask, mask), masked_chamfer(elsewhere, b, mask, mask))
