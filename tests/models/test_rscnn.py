import pytest
import torch
from torch.nn import functional as F

from qs3.models.rscnn import group, rscnn
from tests.models.by_formula import gradient_norm, set_weights, waves


def _line() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Points 0.1 apart on a line; the third is the centre."""
    points = torch.zeros(1, 6, 3, dtype=torch.float64)
    points[0, :, 0] = torch.arange(6) / 10 + 1
    return points, points[:, 2:3], torch.tensor([[2]])


@pytest.mark.parametrize(
    ("relation", "slots", "expected"),
    [
        ("released", 5, [1, 2, 3, 1, 1]),
        ("paper", 4, [1, 2, 3, 1]),
        ("original", 4, [2, 1, 3, 2, 2]),  # the centre, others, filled up with the centre
        ("original", 1, [2, 1]),
    ],
)
def test_members_of_a_ball(relation: str, slots: int, expected: list[int]) -> None:
    points, centres, index = _line()
    assert group(points, centres, index, 0.15, slots, relation)[0, 0].tolist() == expected


@pytest.mark.parametrize(
    ("relation", "training", "logits", "norm"),
    [
        ("released", True, [0.04220374, -0.03654153, 0.09100412, -0.10957539], 163.40028718),
        ("released", False, [0.0898171, -0.08528765, 0.07471872, -0.05036304], 0.51231639),
        ("original", True, [0.06816785, -0.05890843, 0.07941468, -0.07976023], 148.01160625),
        ("original", False, [0.08980314, -0.08527046, 0.07472163, -0.05038209], 0.51231922),
    ],
)
def test_numbers_of_the_original(
    relation: str, training: bool, logits: list[float], norm: float
) -> None:
    """SimpleView's and the authors' repository; see docs/reference/backbones.md."""
    model = rscnn(10, relation=relation, dropout=0.0).double()
    set_weights(model)
    if not training:  # they were recorded after the training step, which moved the norms
        model(waves())
        model.eval()
    out = model(waves())
    F.cross_entropy(out, torch.arange(4)).backward()
    torch.testing.assert_close(out[1, :4].tolist(), logits, rtol=1e-6, atol=1e-7)
    assert gradient_norm(model) == pytest.approx(norm, rel=1e-6)
