"""Whole frames of rooms: what is lost there, counted on known images and on a small camera."""

from dataclasses import replace

import numpy as np
import pytest

from qs3.calibration.bench import bands, page, rooms, runner
from qs3.calibration.bench.subject import Subject
from qs3.sensors.devices.reference_speckle import ReferenceSpeckle
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.optics.patterns import Speckle
from qs3.sensors.renderers.gloss import Gloss
from tests.sensors.scenery import middle, plane, scan

DOTS = Speckle(columns=158, rows=124, tiles=1, dot_px=1, seed=1)
SMALL = Subject("small", ReferenceSpeckle(160, 120, 145.0, pattern=DOTS))


def test_a_silhouette_is_a_step_that_the_sensor_resolves():
    depth = np.full((40, 60), 2.0)
    depth[:, 30:] = 2.5  # 43.5 (1 / 2 - 1 / 2.5) is 4.35 px
    found = rooms.silhouettes(depth, 43.5, reach_px=3)
    columns = np.flatnonzero(found.all(axis=0))
    assert (columns[0], columns[-1], len(columns)) == (26, 33, 8)
    assert not rooms.silhouettes(depth, 15.0).any()  # 1.5 px
    assert not rooms.silhouettes(depth + 2, 1000.0).any()  # too far away
    ramp = np.linspace(1.0, 2.9, 60)[None] * np.ones((40, 1))
    assert not rooms.silhouettes(ramp, 43.5).any()


def test_rooms_are_the_same_shapes_in_other_materials_and_seen_whole(renderer):
    built = {
        name: rooms.room(rooms.RoomCondition(name), np.random.default_rng(3))
        for name in rooms.MATERIALS
    }
    vertices = {
        name: np.unique(np.concatenate([b.mesh.vertices for b in bodies]), axis=0)
        for name, (bodies, _) in built.items()
    }
    np.testing.assert_array_equal(*vertices.values())
    assert all(body.gloss is None for body in built["lambert"][0])
    assert sum(body.gloss is not None for body in built["mixed"][0]) >= 8
    bodies, pose = built["lambert"]
    frame = rooms.take(SMALL, bodies, pose, renderer, np.random.default_rng(0))
    assert frame.depth_m.shape == (120, 160)
    assert np.isfinite(frame.clean_m).all()
    assert 0.5 < frame.clean_m.min() < 2.5 < frame.clean_m.max() < 5.5


def test_what_is_lost_in_a_room_is_counted_by_reason(renderer):
    found = rooms.measure(SMALL, rooms.RoomCondition(frames=1), renderer)
    assert sum(found["reasons"].values()) == pytest.approx(1)
    assert found["empty"] == pytest.approx(1 - found["reasons"]["ok"])
    assert 0.02 < found["empty"] < 0.6
    assert found["reasons"]["shadow"] > 0.002
    blind = replace(SMALL.sensor, max_depth_m=1.6)  # nearly all is out of its range
    lost = rooms.measure(Subject("blind", blind), rooms.RoomCondition(frames=1), renderer)
    assert lost["empty"] > 0.8 > found["empty"]


def test_rooms_are_for_devices_that_look_at_them():
    assert rooms.applies(SMALL)
    assert not rooms.applies(Subject("paper", SpeckleStereo()))  # every fourth pixel
    kinds = [type(c).__name__ for c in runner.Plan().conditions(SMALL)]
    assert kinds.count("RoomCondition") == 2
    assert "RoomCondition" not in {type(c).__name__ for c in runner.Plan.quick().conditions(SMALL)}


def crafted(name, empty=0.08, fill=0.9, edge_on=0.0, mixed=0.2):
    subject, config = runner.load(name)
    result = runner.SensorResult(subject, config)

    def planar(depth, tilt, across, sigma, filled):
        condition = {"depth_m": depth, "tilt_deg": tilt, "across": across}
        return {
            "condition": condition, "sigma_m": sigma, "fill": filled, "bias_px": 0.0,
            "accuracy": 0.0, "subpixel_rms_px": 0.05,
        }  # fmt: skip

    result.planes = [planar(z, 0.0, True, 0.003 * z * z, 1.0) for z in (0.5, 1.0, 2.0, 3.0)]
    for across in (True, False):
        result.planes += [
            planar(2.0, 80.0, across, 0.02, fill),
            planar(2.0, 85.0, across, 0.1, edge_on),
        ]
    result.rooms = [
        {
            "condition": {"materials": materials, "frames": 1}, "empty": empty, "mixed": mixed,
            "reasons": {"ok": 1 - empty, "shadow": empty}, "steps": 100, "flying": 0.01,
        }
        for materials in rooms.MATERIALS
    ]  # fmt: skip
    return result


@pytest.mark.parametrize(
    ("name", "more", "words", "holds"),
    [
        ("kinect_v1", {"empty": 0.08}, "of a room without depth", True),
        ("kinect_v1", {"empty": 0.005}, "of a room without depth", False),
        ("kinect_v1", {"mixed": 0.1}, "with a mixed pixel", True),
        ("kinect_v1", {"mixed": 0.3}, "with a mixed pixel", False),
        ("realsense_d415", {"mixed": 0.01}, "with a mixed pixel", False),
        ("realsense_d415", {"mixed": None}, "with a mixed pixel", False),
        ("realsense_d415", {"fill": 0.9}, "fill at 80 degrees", True),
        ("realsense_d415", {"fill": 0.1}, "fill at 80 degrees", False),
        ("realsense_d415", {"edge_on": 0.2}, "fill at 85 degrees", True),
        ("realsense_d435", {"edge_on": 0.988}, "fill at 85 degrees", False),
        ("realsense_d435", {}, "Kotsonis", False),  # 3 mm at 1 m, a real one 2.1
    ],
)
def test_rooms_grazing_planes_and_a_real_d435_have_bands_that_can_fail(name, more, words, holds):
    found = [v for v in bands.judge(crafted(name, **more)) if words in v.band]
    assert [v.passed for v in found] == [holds]


def test_the_page_has_a_section_on_rooms():
    result = crafted("kinect_v1")
    said = page._rooms([result])
    assert "| kinect_v1 | mixed" in " ".join(said.split())
    assert page._rooms([]) == ""


def test_metal_that_mirrors_elsewhere_loses_depth_where_a_matt_surface_keeps_it(renderer):
    """What a polished plate at 35 degrees gives back of the dots goes past both cameras."""
    subject, _ = runner.load("realsense_d415")
    fill = {}
    for name, gloss in (("matt", None), ("metal", Gloss(0.15, 0.5, metal=True))):
        plate = replace(plane(1.0, 0.08, tilt_deg=35), gloss=gloss)
        frame = scan(subject.sensor, [plate], renderer)
        inside = middle(frame.label == 1)
        fill[name] = np.isfinite(middle(frame.depth_m))[inside].mean()
    assert fill["matt"] > 0.97, fill
    assert fill["metal"] < 0.3, fill
