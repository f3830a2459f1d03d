"""Which clouds are said to be unlike those of training."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.datamodules.clouds import Clouds
from qs3.datamodules.fps_samples import farthest_points
from qs3.evaluation.ood import (
    MEASURES,
    limits,
    measure,
    measure_one,
    ood_reasons,
    relax_min_points,
)
from qs3.geometry.sampling import unit_ball


def prepare(points: np.ndarray, count: int, scale: str = "unit_ball", floor: float = 0.0) -> Clouds:
    return Clouds.of(points, farthest_points(points, count), scale, floor)


def measured(cloud: np.ndarray) -> dict[str, float]:
    cloud = cloud.astype(np.float32)
    return measure(cloud, unit_ball(cloud))


def test_known_answers():
    grid = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), -1).reshape(-1, 3)  # a cube
    found = measured(grid)
    assert found["points"] == 64
    corner = 1.5 * 3**0.5
    assert found["spacing"] == pytest.approx(1 / corner, rel=1e-5)
    assert found["thickness"] == pytest.approx(1, rel=1e-4)
    assert found["height"] == pytest.approx(1, rel=1e-4)
    norms = np.linalg.norm(grid - 1.5, axis=1) / corner
    assert found["middle"] == pytest.approx(np.median(norms), rel=1e-5)

    tall = measured(grid * (1, 1, 5))
    assert tall["height"] == pytest.approx(5, rel=1e-4)
    assert tall["thickness"] == pytest.approx(0.2, rel=1e-4)
    flat = measured(grid * (1, 1, 0))
    assert (flat["points"], flat["height"]) == (16, 0)
    assert flat["thickness"] == pytest.approx(0, abs=1e-3)
    one = measured(np.ones((10, 3)))
    assert one == dict(points=1, spacing=0, middle=0, thickness=0, height=0)
    line = measured(np.outer(np.arange(9.0), (0, 0, 1)))
    assert line["height"] == 1e3  # no horizontal extent: not infinite


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    angle=st.floats(0, 6.3),
    size=st.floats(0.01, 100),
    shift=st.floats(-10, 10),
)
def test_place_size_and_turns_about_z_do_not_matter(seed, angle, size, shift):
    cloud = np.random.default_rng(seed).normal(size=(100, 3)) * (1, 2, 3)
    c, s = np.cos(angle), np.sin(angle)
    turned = cloud @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    one, other = measured(cloud), measured((turned + shift) * size)
    for name in MEASURES:
        assert other[name] == pytest.approx(one[name], rel=5e-3, abs=1e-4)


def domain(rng: np.random.Generator, count: int, scale: tuple[float, float, float]) -> Clouds:
    clouds = rng.normal(size=(count, 128, 3)) * np.array(scale)
    return prepare(clouds.astype(np.float32), 64)


@pytest.mark.slow
def test_limits_take_the_wider_end_of_each_domain():
    rng = np.random.default_rng(0)
    low, tall = domain(rng, 300, (1, 1, 0.3)), domain(rng, 300, (1, 1, 3))
    both, one, other = limits(low, tall), limits(low), limits(tall)
    assert tuple(both) == tuple(MEASURES)
    for name in MEASURES:
        assert both[name][0] == min(one[name][0], other[name][0])
        assert both[name][1] == max(one[name][1], other[name][1])
    assert both["points"] == [128, np.inf]
    assert both["height"][0] < 0.35
    assert both["height"][1] > 2.5
    # a subset of the clouds has the limits of the subset
    assert limits(low.at(np.arange(5)))["height"] != one["height"]


def test_a_cloud_with_as_many_points_as_the_net_sees_lacks_none():
    usual = {"points": [2048.0, np.inf], "height": [0.5, 1.5]}
    assert relax_min_points(usual, 1024) == {"points": [1024, np.inf], "height": [0.5, 1.5]}
    assert relax_min_points(usual, 4096) == usual  # training had fewer than that
    assert usual["points"] == [2048, np.inf]  # not changed in place
    assert relax_min_points({"height": [0.5, 1.5]}, 64) == {"height": [0.5, 1.5]}


def test_of_clouds_in_metres_the_size_counts_too():
    rng = np.random.default_rng(0)
    clouds = rng.normal(size=(100, 128, 3)).astype(np.float32)
    ball, metres = (prepare(clouds, 64, scale=scale) for scale in ("unit_ball", "metres"))
    usual = limits(metres)
    assert {name: usual[name] for name in MEASURES} == limits(ball)
    sizes = [np.linalg.norm(cloud - cloud.mean(axis=0), axis=1).max() for cloud in clouds]
    assert usual["size"] == pytest.approx(np.quantile(sizes, [0.001, 0.999]), rel=1e-5)
    assert measure_one(metres, 7)["size"] == pytest.approx(sizes[7], rel=1e-5)
    assert "size" not in measure_one(ball, 7)
    millimetres = prepare(1000 * clouds[:1], 64, scale="metres")
    (reason,) = ood_reasons(measure_one(millimetres, 0), usual)
    assert reason.startswith("size ")
    assert reason.endswith(f" is over {usual['size'][1]:.4g}, as of other units than metres")
    (reason,) = ood_reasons(measure_one(prepare(3 * clouds[:1], 64, scale="metres"), 0), usual)
    assert reason.endswith(f" is over {usual['size'][1]:.4g}")  # large, and in metres


def test_of_clouds_over_the_floor_the_lowest_point_counts_too():
    rng = np.random.default_rng(0)
    clouds = rng.uniform(size=(100, 128, 3)).astype(np.float32)
    over = prepare(clouds, 64, scale="above_floor", floor=-1.0)
    assert measure_one(over, 7)["base"] == pytest.approx(clouds[7, :, 2].min() + 1, abs=1e-6)
    usual = limits(over)
    assert [*usual] == [*MEASURES, "size", "base"]
    assert ood_reasons(measure_one(over, 7), usual) == []
    other = prepare(clouds[7:8], 64, scale="above_floor", floor=0.5)
    (reason,) = ood_reasons(measure_one(other, 0), usual)
    assert reason.startswith("base -0.4")


def test_what_is_strange_is_named():
    rng = np.random.default_rng(0)
    ends = limits(domain(rng, 100, (1, 1, 1)))
    normal = rng.normal(size=(128, 3)).astype(np.float32)

    def reasons(cloud: np.ndarray) -> str:
        ready = prepare(cloud[None].astype(np.float32), 64).points[0].numpy()
        return "; ".join(ood_reasons(measure(cloud, ready), ends))

    assert reasons(normal) == ""
    assert reasons(normal[np.arange(128) % 40]).startswith("points 40 is under 128")
    assert "thickness" in reasons(normal * (1, 1, 0.01))
    assert "height" in reasons(normal * (1, 1, 5))
    stray = normal.copy()
    stray[0] = 60
    assert "middle" in reasons(stray)
    clumped = normal.copy()
    clumped[1:100] *= 1e-3
    assert "spacing" in reasons(clumped) or "middle" in reasons(clumped)
    assert ood_reasons({"height": 2.0}, {"height": [0.5, 1.5]}) == ["height 2 is over 1.5"]
    assert ood_reasons({"height": 0.1}, {"height": [0.5, 1.5]}) == ["height 0.1 is under 0.5"]
    assert ood_reasons({"height": 0.5}, {"height": [0.5, 1.5]}) == []
