"""B: the same objects and views as S, and another sensor."""

import numpy as np
import pytest
from omegaconf import OmegaConf

from qs3.config.hydra import build
from qs3.errors import MissingDataError
from qs3.generation.command import generate
from qs3.generation.objects import mesh_items
from qs3.sensors.devices.blensor_kinect import DotMask
from qs3.sensors.devices.fringe import FringeProjection
from qs3.sensors.devices.gaussian_time_of_flight import GaussianTimeOfFlight
from qs3.sensors.devices.time_of_flight import TimeOfFlight
from tests.generation.generating import composed


def config(domain, *overrides):
    return composed(f"domain={domain}", *overrides)


def test_b_is_s_but_for_its_name_and_its_sensor():
    s, b = (
        OmegaConf.to_container(config(name), resolve=True) for name in ("specklenet10", "blensor10")
    )
    for cfg in (s, b):
        del cfg["sensor"], cfg["recipe"]["sensor"]
        for key in ("name", "symbol", "title", "path", "published", "how_to_get", "make"):
            del cfg["domain"][key]
    assert s == b


def test_b_looks_through_a_kinect_with_the_camera_of_s():
    s, b = (build(config(name).recipe).sensor for name in ("specklenet10", "blensor10"))
    assert isinstance(b, DotMask)
    keys = ("width_px", "height_px", "focal_px", "baseline_m", "step_px", "min_depth_m")
    for key in (*keys, "max_depth_m"):
        assert getattr(b, key) == getattr(s, key)
    documented = (b.window_px, b.inlier_m, b.fill_px, b.quantiser.steps_per_px, b.column_sigma_px)
    assert documented == (9, 0.05, 3.1, 8, 0)
    assert b.min_share == 2 / 3


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("blensor_tof", GaussianTimeOfFlight),
        ("time_of_flight", TimeOfFlight),
        ("fringe", FringeProjection),
    ],
)
def test_other_sensors_are_one_word(name, kind):
    sensor = build(config("blensor10", f"sensor={name}").recipe).sensor
    assert isinstance(sensor, kind)
    if name != "blensor_tof":  # that one has the camera of S, not the device's
        assert sensor == kind()


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """One chair and one lamp a split, seen by three sensors with the same camera."""
    found = {}
    for key, domain, *more in (
        ("S", "specklenet10"),
        ("B", "blensor10"),
        ("tof", "blensor10", "sensor=blensor_tof"),
    ):
        data_dir = tmp_path_factory.mktemp(key)
        quick = ["renderer=mitsuba", "renderer.samples=2", "views=2", "workers=0", "limit=1"]
        where = ["classes=[chair,table]", f"paths.data_dir={data_dir}"]
        found[key] = (generate(config(domain, *quick, *where, *more)), data_dir / domain)
    return found


def test_poses_and_placing_are_those_of_s(made):
    clean = {key: np.load(folder / "points_clean.npy") for key, (_, folder) in made.items()}
    noisy = {key: np.load(folder / "points.npy") for key, (_, folder) in made.items()}
    assert [len(points) for points in clean.values()] == [4, 4, 4]
    for key in ("B", "tof"):
        assert made[key][0].ids == made["S"][0].ids
        np.testing.assert_array_equal(clean[key], clean["S"])
        assert not np.array_equal(noisy[key], noisy["S"])


def test_clouds_are_noisy_but_near_the_surface(made):
    for key, limit_m in (("B", 0.03), ("tof", 0.012)):
        _, folder = made[key]
        noisy, clean = (np.load(folder / f"{name}.npy") for name in ("points", "points_clean"))
        assert noisy.shape == (4, 2048, 3)
        for points, true in zip(noisy, clean, strict=True):
            gap = np.linalg.norm(points[::8, None] - true[None], axis=2).min(axis=1)
            assert 0.001 < np.median(gap) < limit_m


def test_every_object_of_the_plan_has_a_cloud(made):
    items = mesh_items(config("blensor10", "limit=1", "classes=[chair,table]"))
    assert {item.id for item in items} == set(made["B"][0].ids)


def test_a_missing_b_says_how_to_make_it(tmp_path):
    domain = build(config("blensor10", f"paths.data_dir={tmp_path}").domain)
    with pytest.raises(MissingDataError, match=r"python generate\.py domain=blensor10"):
        domain.open()
