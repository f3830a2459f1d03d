import pytest
import torch
from torch.nn import functional as F

from qs3.models.simpleview import depth_images, simpleview
from tests.models.by_formula import gradient_norm, set_weights, waves


def _points(b: int = 3, n: int = 200) -> torch.Tensor:
    x = torch.randn(b, n, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return x / x.norm(dim=2).amax(1)[:, None, None]


# (0.3, 0.1, -0.2): which pixel by hand, from the table; size 128, so pixel ceil(63.5 + 64 r / d)
@pytest.mark.parametrize(
    ("view", "row", "column", "depth"),
    [
        (0, -0.1, 0.3, 1.2),
        (1, -0.1, 0.2, 1.7),
        (2, -0.1, -0.3, 1.6),
        (3, -0.1, -0.2, 1.1),
        (4, 0.2, 0.3, 1.3),
        (5, -0.2, 0.3, 1.5),
    ],
)
def test_one_point_in_each_view(view: int, row: float, column: float, depth: float) -> None:
    points = torch.tensor([[[0.3, 0.1, -0.2]]], dtype=torch.float64)
    image = depth_images(points)[0, view]
    where = [int(-(-(63.5 + 64 * c / depth) // 1)) for c in (row, column)]
    assert image.nonzero().tolist() == [where]
    assert image[tuple(where)].item() == pytest.approx(depth)


def test_shared_pixel() -> None:
    points = torch.tensor([[[0.0, 0, -0.4], [0, 0, 0.6]]])  # depths 1 and 2 in view 0
    harmonic = depth_images(points, views=[0])
    assert harmonic.max().item() == pytest.approx(2 / (1 + 1 / 2))
    assert depth_images(points, views=[0], pixel="nearest").max().item() == pytest.approx(1)
    assert (harmonic > 0).sum() == 1


def test_up_turns_the_cloud() -> None:
    points = _points()
    x, y, z = points.unbind(2)
    turned = torch.stack([x, z, -y], dim=2)  # a point above (z) comes to lie above (y)
    assert torch.equal(depth_images(points, up="z"), depth_images(turned, up="y"))
    above = torch.tensor([[[0.0, 0.0, 0.5]]])
    rows = depth_images(above, views=[0, 1, 2, 3], up="z")[0].nonzero()[:, 1]
    assert (rows < 64).all()  # in the upper half of each picture


@pytest.mark.parametrize(
    ("training", "logits", "norm"),
    [
        pytest.param(
            *(True, [-0.09085458, 0.08415982, -0.05754179, 0.01548372], 54.9939534),
            marks=pytest.mark.slow,
        ),
        (False, [-0.07243522, 0.08327869, -0.07432694, 0.04749585], 0.46095962),
    ],
)
def test_numbers_of_the_original(training: bool, logits: list[float], norm: float) -> None:
    """SimpleView's repository, with float32 images; see docs/reference/backbones.md."""
    precision = torch.float64 if training else torch.float32  # batches' statistics need more
    model, clouds = simpleview(10, dropout=0.0).to(precision), waves().to(precision)
    set_weights(model)
    if not training:  # they were recorded after the training step, which moved the norms
        model(clouds)
        model.eval()
    out = model(clouds)
    F.cross_entropy(out, torch.arange(4)).backward()
    torch.testing.assert_close(out[1, :4].tolist(), logits, rtol=1e-4, atol=1e-5)
    assert gradient_norm(model) == pytest.approx(norm, rel=1e-4)
