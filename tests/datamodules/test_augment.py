from __future__ import annotations

import pytest
import torch
from scipy.optimize import linprog

from qs3.datamodules.augment import Augment, crop


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


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


@pytest.mark.parametrize("wrong", [{"scale": 0.5}, {"crop": 0.0}])
def test_wrong_settings(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Augment(**wrong)


def test_a_cut_leaves_what_lies_on_one_side_of_a_plane():
    points = torch.rand(64, 50, 3, generator=generator(2), dtype=torch.float64)
    cut = crop(points, 0.4, generator(1), scale="metres")
    again = crop(points, 0.4, generator(1), scale="metres")
    assert torch.equal(cut, again)
    shares = []
    for before, after in zip(points, cut, strict=True):
        # What stays was moved as a whole, by the difference that most pairs of points have.
        differences = (before[:, None] - after[None]).reshape(-1, 3)
        steps, counts = differences.mul(1e4).round().unique(dim=0, return_counts=True)
        move = steps[counts.argmax()] / 1e4
        stays = (torch.cdist(before, after + move) < 2e-4).any(dim=1)
        assert (torch.cdist(after + move, before).amin(dim=1) < 2e-4).all()  # nothing is new
        assert torch.allclose(
            (before[stays] - move).mean(dim=0), torch.zeros(3).double(), atol=2e-4
        )
        shares.append(float(stays.float().mean()))
        if not stays.all():  # some plane has them on one side
            sign = torch.where(stays, 1.0, -1.0)[:, None]
            rows = -(sign * torch.cat([before, torch.ones(50, 1)], dim=1)).numpy()
            found = linprog([0.0] * 4, rows, [-1.0] * 50, bounds=[(None, None)] * 4)
            assert found.status == 0
    assert min(shares) >= 0.4
    assert 0.6 < sum(shares) / 64 < 0.8


def test_a_lift_moves_each_cloud_up_or_down_as_a_whole():
    points = torch.rand(4000, 5, 3, generator=generator())
    augment = Augment(rotate_z=False, jitter_sigma=0.0, lift=0.2)
    moved = augment(points, generator(), "above_floor") - points
    assert torch.equal(moved[..., :2], torch.zeros(4000, 5, 2))
    by = moved[..., 2]
    assert torch.allclose(by, by[:, :1].expand(-1, 5), atol=1e-6)
    assert by.min() >= -0.2 - 1e-6
    assert by.max() <= 0.2 + 1e-6
    assert float(by[:, 0].mean()) == pytest.approx(0, abs=0.006)
    assert float(by[:, 0].std()) == pytest.approx(0.2 / 3**0.5, rel=0.03)
    assert torch.equal(augment(points, generator(), "metres"), points)
    assert torch.equal(augment(points, generator(), "unit_ball"), points)


def test_a_cut_cloud_fills_the_unit_ball_again_unless_it_has_a_size():
    points = torch.rand(16, 80, 3, generator=generator()) - 0.5
    assert torch.allclose(
        crop(points, 0.3, generator(), "unit_ball").norm(dim=2).amax(1), torch.ones(16)
    )
    metres = crop(points, 0.3, generator(), "metres")
    assert (metres.norm(dim=2).amax(1) < 0.95).all()
    augment = Augment(crop=0.3, rotate_z=False, jitter_sigma=0.0)
    assert torch.equal(augment(points, generator(), scale="metres"), metres)
    one = torch.ones(2, 5, 3)  # all points at one place: nothing to divide by
    assert torch.equal(crop(one, 0.3, generator(), "unit_ball"), torch.zeros(2, 5, 3))


def test_a_tilt_turns_each_cloud_about_its_middle_and_a_mirror_half_of_them():
    points = torch.rand(400, 30, 3, generator=generator(), dtype=torch.float64)
    points -= points.mean(1, keepdim=True)
    still = {"rotate_z": False, "jitter_sigma": 0.0}
    tilted = Augment(tilt_deg=3.0, **still)(points, generator())
    assert torch.allclose(torch.cdist(tilted, tilted), torch.cdist(points, points), atol=1e-6)
    assert torch.allclose(tilted[..., 2].mean(1), points[..., 2].mean(1))
    turns = torch.linalg.lstsq(points, tilted).solution  # [x y z] before to after
    assert float(turns[:, 2, 0].std().rad2deg()) == pytest.approx(3, rel=0.15)
    mirrored = Augment(mirror=True, **still)(points, generator())
    flipped = (mirrored != points).flatten(1).any(1)
    assert 150 < int(flipped.sum()) < 250
    assert torch.equal(mirrored[flipped], points[flipped] * torch.tensor([-1.0, 1, 1]))


def test_what_a_camera_has_seen_is_turned_a_little_to_either_side():
    points = torch.tensor([[1.0, 0, 0]]).repeat(2000, 1, 1)
    turned = Augment(jitter_sigma=0.0)(points, generator(), "seen")
    angle = torch.atan2(turned[..., 1], turned[..., 0]).rad2deg()
    assert float(angle.abs().max()) == pytest.approx(20, abs=0.1)
    assert float(angle.mean()) == pytest.approx(0, abs=1)
