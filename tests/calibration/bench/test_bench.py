"""The bench with real sensors and the real renderer: measuring, resuming, writing its page."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from qs3.calibration.bench import comparison, edges, planar, runner
from qs3.calibration.bench.cached_renderer import StillRenderer
from qs3.calibration.bench.subject import Subject
from qs3.calibration.bench.targets import POSE, TiltedPlane
from qs3.errors import ConfigError, MissingDataError
from qs3.sensors.devices.reference_speckle import ReferenceSpeckle
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from tests.running import main

ROOT = Path(__file__).parents[3]
CLOUDS = ROOT.parent / "shared" / "data" / "kinect_v1"
KINECT = Subject("kinect_like", ReferenceSpeckle())
STEREO = Subject("speckle_stereo", SpeckleStereo())
PLAN = runner.Plan((60,), phases=4, repeats=3, half_px=8, edge_frames=1, room_frames=0)


@pytest.mark.parametrize("subject", [KINECT, STEREO], ids=lambda s: s.name)
@pytest.mark.parametrize(("tilt", "across"), [(0.0, True), (60.0, True), (75.0, False)])
def test_the_region_sees_the_plane_at_the_depth_and_angle_asked_for(
    renderer, subject, tilt, across
):
    k, step = subject.intrinsics, subject.step_px
    plane = TiltedPlane(2.0, tilt, across, (20.0, -10.0))
    region = plane.region(k, 12 * step, step)
    bodies, box = plane.scene(k, region, subject.margin_px)
    frame = subject.sensor.scan(bodies, box, POSE, renderer, np.random.default_rng(0))
    u = frame.left + np.arange(frame.depth_m.shape[1]) * frame.step_px
    v = frame.top + np.arange(frame.depth_m.shape[0]) * frame.step_px
    rows = (v >= region.top) & (v < region.top + region.height)
    cols = (u >= region.left) & (u < region.left + region.width)
    part = np.ix_(rows, cols)
    expected = plane.depth_at(u[cols] - k.cx_px, v[rows][:, None] - k.cy_px, k.focal_px)
    np.testing.assert_allclose(frame.clean_m[part], expected, rtol=1e-5)
    middle = frame.cosine[part][rows.sum() // 2, cols.sum() // 2]
    assert np.rad2deg(np.arccos(middle)) == pytest.approx(tilt, abs=1.5)


def test_phases_are_spread_evenly_over_a_pixel_and_over_the_steps():
    condition = planar.PlanarCondition(2.0, phases=16)
    disparity = 43.5 / condition.depths_m(43.5)
    assert np.ptp(disparity) == pytest.approx(1, abs=0.1)
    for period in (1.0, 1 / 8):
        counts, _ = np.histogram(disparity % period / period, bins=4, range=(0, 1))
        assert counts.min() >= 2


def test_more_read_noise_is_more_noise_over_time(renderer):
    quiet, _ = runner.load("kinect_like", ["sensor.infrared.read_noise_e=5"])
    loud, _ = runner.load("kinect_like", ["sensor.infrared.read_noise_e=300"])
    condition = planar.PlanarCondition(2.0, phases=4, half_px=10, repeats=3)
    over_time = [
        np.mean(planar.measure(s, condition, renderer)["temporal_std_m"]) for s in (quiet, loud)
    ]
    assert over_time[1] > 3 * over_time[0]


def test_a_preset_of_one_s_own_folder(tmp_path):
    """As generation takes it: the file may begin with one of ours."""
    (tmp_path / "conf" / "sensor").mkdir(parents=True)
    own = "defaults: [kinect_v1, _self_]\nbaseline_m: 0.06\n"
    (tmp_path / "conf" / "sensor" / "my_camera.yaml").write_text(own)
    words = [f"hydra.searchpath=[file://{tmp_path / 'conf'}]"]
    subject, settings = runner.load("my_camera", words)
    _, ours = runner.load("kinect_v1")
    assert settings == {**ours, "baseline_m": 0.06}
    assert subject.sensor.baseline_m == 0.06
    with pytest.raises(ConfigError, match=r"sensor=my_camer: .*did you mean \+sensor=my_camera"):
        runner.load("my_camer", words)
    with pytest.raises(ConfigError, match="sensor=my_camera is unknown; there are"):
        runner.load("my_camera")


def test_a_still_scene_is_rendered_once_and_its_noise_is_new(renderer):
    plane = TiltedPlane(2.0)
    k = KINECT.intrinsics
    bodies, box = plane.scene(k, plane.region(k, 10), 12)
    still = StillRenderer(renderer)
    frames = []
    for seed in range(2):
        still.rewind()
        rng = np.random.default_rng(seed)
        frames.append(KINECT.sensor.scan(bodies, box, POSE, still, rng))
    first, second = (frame.images["clean"] for frame in frames)
    assert first is second  # not rendered a second time
    assert (frames[0].images["left"] != frames[1].images["left"]).any()


@pytest.mark.parametrize("subject", [KINECT, STEREO], ids=lambda s: s.name)
def test_shadows_are_as_wide_as_geometry_says_on_the_right_side(renderer, subject):
    near, far = (1.2, 2.4) if subject is KINECT else (2.0, 4.0)
    m = edges.measure(subject, edges.EdgeCondition(near, far, frames=2), renderer)
    f, b = subject.sensor.focal_px, subject.sensor.baseline_m
    whole = f * b * (1 / near - 1 / far)
    expected = {"projector": whole if subject is KINECT else whole / 2}
    if subject is STEREO:
        expected["camera"] = whole
    for who, width in expected.items():
        assert m[f"{who}_left_px"] == pytest.approx(width, abs=2)
        assert m[f"{who}_right_px"] == pytest.approx(0, abs=2)
    assert m["fattening_right_px"] <= m["half_window_px"] + 1
    assert m["wall_left_px"] > m["wall_right_px"] + 5  # the shadow, and not on the other side


def test_a_bench_resumes_and_notices_changed_settings(renderer, tmp_path):
    subject, config = runner.load("kinect_like")
    first = runner.run(subject, config, renderer, tmp_path, PLAN)
    files = sorted(tmp_path.rglob("*.json"))
    assert len(files) == len(PLAN.conditions(subject)) == len(first.planes) + 1
    stamps = {path: path.stat().st_mtime_ns for path in files}
    files[0].write_text("{ half a file")  # as a crash of another program would leave it
    again = runner.run(subject, config, renderer, tmp_path, PLAN)
    assert (again.planes, again.edge) == (first.planes, first.edge)
    rewritten = [path for path in files if path.stat().st_mtime_ns != stamps[path]]
    assert rewritten == [files[0]]
    assert json.loads(files[0].read_text())
    changed = {**config, "ambient": 0.3}
    assert runner.fingerprint(config, 1) != runner.fingerprint(changed, 1)


def test_the_command_writes_page_numbers_and_figures(tmp_path, capsys):
    status = main(["bench", "sensor=kinect_like", "quick=true", "samples=4", f"out={tmp_path}"])
    said = capsys.readouterr()
    assert status == (1 if "FAIL" in said.out else 0)
    page = (tmp_path / "index.md").read_text(encoding="utf-8")
    assert "qs3 bench sensor=kinect_like quick=true samples=4\n" in page
    for name in ("noise-kinect.png", "subpixel.png", "fill.png", "locking.png"):
        assert f"({name})" in page
        assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"
    with open(tmp_path / "planes.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(KINECT.depths_m()) + 4
    facing = [row for row in rows if row["tilt_deg"] == "0.0"]
    assert all(0.9 < float(row["fill"]) <= 1 for row in facing)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("sensor=nothing", "unknown; there are"),
        ("kinect", "key=value"),
        ("depth=3", "keys are sensor, quick"),
        ("sensor.no_such_key=1", "no_such_key"),
    ],
)
def test_wrong_arguments_are_explained(word, message, capsys):
    assert main(["bench", word]) == 1
    assert message in capsys.readouterr().err


def test_a_sensor_that_sees_too_little_is_refused():
    with pytest.raises(ConfigError, match="fewer than two"):
        Subject("short", SpeckleStereo(min_depth_m=1.0, max_depth_m=1.2)).depths_m()


def test_without_the_real_clouds_the_comparison_says_so(tmp_path):
    with pytest.raises(MissingDataError, match="makes no such comparison"):
        comparison.real_clouds(tmp_path)


def test_simulated_tables_have_the_steps_and_the_noise_of_real_ones(renderer, tmp_path):
    """kinect_v1 and 8 real clouds; ranges, because the scenes are not the same."""
    pytest.importorskip("qs3.datasets.clouds.pcd")
    if not CLOUDS.is_dir():
        pytest.skip(f"{CLOUDS} is absent")
    subject, config = runner.load("kinect_v1")
    found = comparison.compare(subject, config, renderer, tmp_path, tmp_path / "real.png", CLOUDS)
    real, ours = (
        {key: found.spread(group, key)[1] for key in group[0]}
        for group in (found.real, found.simulated)
    )
    assert real["step_focal_baseline"] == pytest.approx(43.5, rel=0.02)
    assert ours["step_focal_baseline"] == pytest.approx(43.5, rel=0.005)
    assert real["step_residual"] < 0.15
    assert ours["step_residual"] < 0.15
    assert ours["table_subpixel_px"] == pytest.approx(real["table_subpixel_px"], rel=0.35)
    assert real["left_share"] > 0.5
    assert ours["left_share"] > 0.5
    for group in (found.real, found.simulated):
        share = sum(one["mixed_steps"] for one in group) / sum(one["steps"] for one in group)
        assert share < 0.03  # of the steps by a real one, three of 2,142
    assert Path(tmp_path / "real.png").is_file()


def failing(page: str) -> set[tuple[str, str]]:
    """Sensors and bands that a page says fail."""
    rows = [[cell.strip() for cell in line.split("|")] for line in page.splitlines()]
    return {(row[1], row[2]) for row in rows if "**FAIL**" in row}


@pytest.mark.slow
def test_the_whole_bench_holds_the_bands_that_the_page_says_it_holds(tmp_path, capsys):
    """The page in docs names what fails, mixed pixels in rooms before all; nothing else may."""
    known = failing((ROOT / "docs" / "sensors" / "index.md").read_text())
    status = main(["bench", f"out={tmp_path}"])
    assert failing((tmp_path / "index.md").read_text()) == known
    assert status == bool(known), capsys.readouterr().out
