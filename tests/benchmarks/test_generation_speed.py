"""Speed of Mesh2Point's parts as ratios, each against a baseline of the same run.

python -m pytest tests/benchmarks/test_generation_speed.py --benchmark-enable -s
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from qs3.catalogue import Catalogue
from qs3.generation.camera_poses import AnchoredViews
from qs3.generation.recipes import Mesh2Point
from qs3.geometry.cameras import Camera, Intrinsics
from qs3.meshes.placement import UnitCube
from qs3.sensors.base import DepthFrame, window_of
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.matching import ReferenceMatcher, scores
from qs3.sensors.renderers.base import Body, Image, Projector, Renderer, Scene
from qs3.sensors.renderers.blender import BlenderRenderer
from qs3.sensors.renderers.gloss import Gloss
from qs3.sensors.renderers.mitsuba import MitsubaRenderer

SENSOR = SpeckleStereo()
SAMPLES = 4


def paper_pair(*, windowed: bool) -> tuple[Scene, list[Camera]]:
    """A chair, seen by the paper's sensor from the paper's distance."""
    rng = np.random.default_rng(0)
    (item,) = Catalogue(seed=1, train=1, test=0, classes=("chair",)).items()
    mesh = UnitCube().place(item.load(), rng, item.id)
    (pose,) = AnchoredViews(count=1).poses(rng, mesh.bounds, item.id)
    k = Intrinsics.centred(SENSOR.width_px, SENSOR.height_px, SENSOR.focal_px)
    left = Camera(k, pose)
    right = left.moved((SENSOR.baseline_m, 0, 0))
    if windowed:
        left, right = (
            Camera(k, camera.world_from_camera, window_of(mesh.bounds, camera, margin_px=10))
            for camera in (left, right)
        )
    middle = Camera(k, pose).moved((SENSOR.baseline_m / 2, 0, 0)).world_from_camera
    slide = Projector(middle, SENSOR.pattern.slide, SENSOR.tan_half_width, strength=16.0)
    return Scene((Body(mesh),), slide, SENSOR.ambient), [left, right]


def render(renderer: Renderer, *, windowed: bool) -> Callable[[], list[Image]]:
    scene, cameras = paper_pair(windowed=windowed)
    return lambda: renderer.render(scene, cameras, seed=0, geometry=[True, False])


def best_s(call: Callable[[], object], rounds: int = 3) -> float:
    """The shortest of some calls: what others do on the machine only adds."""
    times = []
    for _ in range(rounds):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return min(times)


def report(
    benchmark: BenchmarkFixture,
    capsys: pytest.CaptureFixture,
    what: str,
    ours_s: float,
    baseline: str,
    theirs_s: float,
) -> None:
    benchmark.extra_info["times_faster"] = theirs_s / ours_s
    with capsys.disabled():
        print(  # noqa: T201
            f"\n{what}: {ours_s * 1e3:.2f} ms, {baseline}: {theirs_s * 1e3:.2f} ms: "
            f"{theirs_s / ours_s:.1f} times faster"
        )


@pytest.mark.parametrize("make", [MitsubaRenderer, BlenderRenderer])
def test_window_against_the_whole_frame(make, benchmark, capsys):
    renderer = make(samples=SAMPLES)
    benchmark.pedantic(render(renderer, windowed=True), rounds=4, warmup_rounds=1)
    if benchmark.enabled:
        whole = best_s(render(renderer, windowed=False))
        ours = benchmark.stats.stats.min
        report(benchmark, capsys, f"{make.__name__}, window", ours, "whole frame", whole)


def test_mitsuba_against_blender(benchmark, capsys):
    benchmark.pedantic(
        render(MitsubaRenderer(samples=SAMPLES), windowed=True), rounds=4, warmup_rounds=1
    )
    if benchmark.enabled:
        theirs = best_s(render(BlenderRenderer(samples=SAMPLES), windowed=True))
        ours = benchmark.stats.stats.min
        report(benchmark, capsys, f"Mitsuba, a pair, {SAMPLES} samples", ours, "Blender", theirs)


def released_loop(frame: DepthFrame, world_from_camera: np.ndarray) -> np.ndarray:
    """Back-projection as the released code does it: a double loop, an inverse a point."""
    camera_from_world = np.linalg.inv(world_from_camera)
    k, points = frame.camera.intrinsics, []
    height, width = frame.depth_m.shape
    for row in range(height):
        for col in range(width):
            z = float(frame.depth_m[row, col])
            if not np.isfinite(z):
                continue
            x = (frame.left + col * frame.step_px - k.cx_px) / k.focal_px * z
            y = (frame.top + row * frame.step_px - k.cy_px) / k.focal_px * z
            points.append((np.linalg.inv(camera_from_world) @ np.array([x, y, z, 1.0]))[:3])
    return np.array(points)


def test_back_projection_against_the_released_loop(benchmark, capsys):
    rng = np.random.default_rng(0)
    depth = rng.uniform(3, 5, (60, 60)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = np.nan
    camera = paper_pair(windowed=False)[1][0]
    nothing = np.zeros(depth.shape, dtype=np.uint8)
    cosine = np.ones(depth.shape, np.float32)
    frame = DepthFrame(camera, 402, 302, 4, depth, depth, nothing, cosine, nothing)
    pose = camera.world_from_camera
    points = benchmark.pedantic(frame.points, (depth, pose), rounds=20, warmup_rounds=1)
    np.testing.assert_allclose(points, released_loop(frame, pose), atol=1e-9)
    if benchmark.enabled:
        theirs = best_s(lambda: released_loop(frame, pose))
        report(
            benchmark, capsys, "3,600 pixels to points", benchmark.stats.stats.min, "loop", theirs
        )


def test_correlation_against_numpy(benchmark, capsys, monkeypatch):
    """A view of K's: 64 disparities, by compiled loops and by numpy's operations."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (400, 480), dtype=np.uint8)
    reference = rng.integers(0, 256, (400, 640)).astype(np.float32)
    matcher = ReferenceMatcher()
    found = benchmark.pedantic(matcher.match, (image, reference, 90), rounds=8, warmup_rounds=1)
    monkeypatch.setattr(scores, "has_numba", lambda: False)
    plain = matcher.match(image, reference, 90)
    np.testing.assert_array_equal(found.disparity, plain.disparity)
    if benchmark.enabled:
        theirs = best_s(lambda: matcher.match(image, reference, 90), 8)
        report(benchmark, capsys, "correlation", benchmark.stats.stats.min, "numpy", theirs)


class Recorded:
    """A renderer that answers from memory, so that what is timed is all the rest."""

    def __init__(self, renderer: Renderer) -> None:
        self.renderer, self.kept = renderer, {}

    def render(self, scene, cameras, *, seed, geometry):
        if seed not in self.kept:
            self.kept[seed] = self.renderer.render(scene, cameras, seed=seed, geometry=geometry)
        return self.kept[seed]


def test_all_but_the_render(benchmark, capsys):
    """Noise, matching, back-projection, crop, fusion and sampling of five views; no baseline
    but the render itself."""
    (item,) = Catalogue(seed=1, train=1, test=0, classes=("chair",)).items()
    mesh = item.load()
    recipe, recorded = Mesh2Point(SENSOR), Recorded(MitsubaRenderer(samples=SAMPLES))

    def make() -> np.ndarray:
        return recipe.make(mesh, item.id, 0, recorded).arrays["points"]

    first = make()
    again = benchmark.pedantic(make, rounds=3)
    np.testing.assert_array_equal(again, first)
    assert len(recorded.kept) == 5  # the seeds of the views, the same each time
    if benchmark.enabled:

        def render_too() -> None:
            recorded.kept.clear()
            make()

        ours, both = benchmark.stats.stats.min, best_s(render_too)
        report(benchmark, capsys, "an object without the render", ours, "with Mitsuba's", both)


LIT = {
    "one matt body": (Gloss(1.0, 0.0), 0),
    "gloss": (Gloss(0.5, 0.5), 0),
    "light between surfaces": (None, 1),
    "a clear body": (Gloss(0.2, 0.5, transmission=0.7), 0),
}


@pytest.mark.parametrize("what", LIT)
def test_what_light_costs(what, benchmark, capsys):
    """Against a matt body in direct light, at the 16 samples of the default."""
    renderer = MitsubaRenderer(samples=16)
    if renderer.variant.startswith("scalar_"):
        pytest.skip("no compiled variant works here")
    gloss, bounces = LIT[what]
    plain, cameras = paper_pair(windowed=True)
    lit = replace(
        plain, bodies=tuple(replace(body, gloss=gloss) for body in plain.bodies), bounces=bounces
    )

    def one(scene):
        return lambda: renderer.render(scene, cameras, seed=0, geometry=[True, False])

    benchmark.pedantic(one(lit), rounds=4, warmup_rounds=1)
    if benchmark.enabled:
        one(plain)()
        direct = best_s(one(plain))
        report(benchmark, capsys, what, benchmark.stats.stats.min, "matt and direct", direct)
