from __future__ import annotations

import pytest
import torch

from qs3.datamodules.augment import Augment, rotate_z
from qs3.errors import ConfigError


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_quarter_turn():
    x = torch.tensor([[[1.0, 0.0, 5.0]]])
    assert torch.allclose(
        rotate_z(x, torch.tensor([torch.pi / 2])), torch.tensor([[[0.0, 1.0, 5.0]]]), atol=1e-6
    )


def test_turning_keeps_height_and_distance_and_is_of_each_cloud():
    points = torch.rand(5, 7, 3, generator=generator())
    turned = Augment(jitter_sigma=0.0)(points, generator(1))
    assert torch.equal(turned[..., 2], points[..., 2])
    assert torch.allclose(turned.norm(dim=2), points.norm(dim=2), atol=1e-6)
    assert torch.equal(turned, Augment(jitter_sigma=0.0)(points, generator(1)))
    moved = (turned - points).abs().amax(dim=(1, 2))
    assert len(moved.unique()) == 5


def test_jitter_is_clipped():
    points = torch.zeros(2, 1000, 3)
    noise = Augment(rotate_z=False, jitter_sigma=0.01, jitter_clip=0.02)(points, generator())
    assert noise.abs().max() == pytest.approx(0.02)
    assert float(noise.std()) == pytest.approx(0.0095, rel=0.05)


def test_scale_and_shift_are_of_each_cloud_and_axis():
    points = torch.ones(4, 6, 3)
    augment = Augment(rotate_z=False, scale=1.5, shift=0.2, jitter_sigma=0.0)
    moved = augment(points, generator())
    assert (moved.std(dim=1) < 1e-6).all()
    assert len(moved[:, 0].flatten().unique()) == 12
    assert moved.min() > 1 / 1.5 - 0.2
    assert moved.max() < 1.5 + 0.2


def test_all_off_changes_nothing():
    points = torch.rand(2, 3, 3)
    off = Augment(rotate_z=False, jitter_sigma=0.0)
    assert torch.equal(off(points, generator()), points)


@pytest.mark.parametrize("settings", [{"scale": 0.5}, {"shift": -1.0}, {"jitter_clip": -0.1}])
def test_wrong_settings(settings):
    with pytest.raises(ConfigError, match=r"protocol\.augment"):
        Augment(**settings)
