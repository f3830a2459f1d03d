import math

import pytest
import torch

from qs3.methods.defrec import VOXELS
from qs3.methods.gast import Gast, turn_parts
from tests.methods.shapes import CLASSES, tiny_net


def rotation(axis: int, quarters: int) -> torch.Tensor:
    """What multiplies row vectors from the right, from sines and cosines."""
    c, s = math.cos(quarters * math.pi / 2), math.sin(quarters * math.pi / 2)
    if axis == 0:
        return torch.tensor([[1, 0, 0], [0, c, -s], [0, s, c]])
    return torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])


@pytest.mark.parametrize("seed", range(6))
def test_parts_are_turned_as_their_labels_say(seed: int) -> None:
    points = torch.rand(5, 40, 3, generator=torch.Generator().manual_seed(seed)) * 2 - 1
    mixed, about_x, about_y, lam = turn_parts(points, torch.Generator().manual_seed(seed))
    own = round(float(lam) * 40)
    for i in range(5):
        first = points[i] @ rotation(0, int(about_x[i]))
        second = points[i] @ rotation(1, int(about_y[i]))
        near_first = (mixed[i][:, None] - first).abs().amax(2).amin(1) < 1e-5
        near_second = (mixed[i][:, None] - second).abs().amax(2).amin(1) < 1e-5
        assert (near_first | near_second).all()
        if about_x[i] or about_y[i]:  # else the parts cannot be told apart
            assert near_first.sum() == own
            assert near_second.sum() == 40 - own


def test_a_net_that_knows_nothing_pays_ln_27_and_ln_4() -> None:
    net, method = tiny_net(), Gast(min_points=2, class_weight=3.0)
    method.prepare(net)
    for p in (*method.parameters(), *net.head.parameters()):
        torch.nn.init.zeros_(p)
    clouds = torch.rand(4, 64, 3) * 2 - 1
    source = {"points": clouds, "y_source": torch.tensor([0, 1, 2, 3])}
    batch = {"source": source, "target": {"points": clouds}}
    terms = method.loss(net, batch, torch.Generator().manual_seed(0))
    assert terms["ce"].item() == pytest.approx(3 * math.log(CLASSES), rel=1e-5)
    for domain in ("source", "target"):
        assert terms[f"def_{domain}"].item() == pytest.approx(0.5 * math.log(VOXELS), rel=1e-5)
        assert terms[f"rot_{domain}"].item() == pytest.approx(0.2 * math.log(4), rel=1e-5)
