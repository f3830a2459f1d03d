import pytest
import torch
from torch.nn import functional as F

from qs3.models.rscnn import rscnn
from tests.models.by_formula import gradient_norm, set_weights, waves


@pytest.mark.parametrize(
    ("training", "logits", "norm"),
    [
        (True, [0.04220374, -0.03654153, 0.09100412, -0.10957539], 163.40028718),
        (False, [0.0898171, -0.08528765, 0.07471872, -0.05036304], 0.51231639),
    ],
)
def test_numbers_of_the_original(training: bool, logits: list[float], norm: float) -> None:
    """SimpleView's repository; see docs/reference/backbones.md."""
    model = rscnn(10, dropout=0.0).double()
    set_weights(model)
    if not training:  # they were recorded after the training step, which moved the norms
        model(waves())
        model.eval()
    out = model(waves())
    F.cross_entropy(out, torch.arange(4)).backward()
    torch.testing.assert_close(out[1, :4].tolist(), logits, rtol=1e-6, atol=1e-7)
    assert gradient_norm(model) == pytest.approx(norm, rel=1e-6)
