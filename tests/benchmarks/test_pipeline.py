"""Rendering, loading, predicting, and how soon commands answer: against named baselines. CPU."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from lightning.pytorch import Trainer
from pytest_benchmark.fixture import BenchmarkFixture

import qs3
from qs3.catalogue import Catalogue
from qs3.datamodules.adaptation import AdaptationData
from qs3.datamodules.augment import Augment
from qs3.datamodules.clouds import Clouds, Labelled
from qs3.datamodules.fps_samples import farthest_points
from qs3.datamodules.phases import Phases, SelfTrainingConfig
from qs3.datasets.domain import Domain
from qs3.generation.camera_poses import AnchoredViews
from qs3.geometry.cameras import Camera, Intrinsics
from qs3.kernels import plain
from qs3.meshes.placement import UnitCube
from qs3.sensors.base import window_of
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.renderers.base import Body, Projector, Renderer, Scene
from qs3.sensors.renderers.blender import BlenderRenderer
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.benchmarks.test_nets import released_fps
from tests.benchmarks.timing import DEVICE, ENABLED, Pair, Step, compare, seconds, show
from tests.models.test_all_nets import build as build_net

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.skipif(DEVICE.type != "cpu", reason="is of the CPU")


def rendering(renderer: Renderer, *, windowed: bool) -> Step:
    """A pair of a chair, seen by the paper's sensor from the paper's distance."""
    sensor, rng = SpeckleStereo(), np.random.default_rng(0)
    (item,) = Catalogue(seed=1, train=1, test=0, classes=("chair",)).items()
    mesh = UnitCube().place(item.load(), rng, item.id)
    (pose,) = AnchoredViews(count=1).poses(rng, mesh.bounds, item.id)
    k = Intrinsics.centred(sensor.width_px, sensor.height_px, sensor.focal_px)
    cameras = [Camera(k, pose), Camera(k, pose).moved((sensor.baseline_m, 0, 0))]
    if windowed:
        cameras = [
            Camera(k, one.world_from_camera, window_of(mesh.bounds, one, margin_px=10))
            for one in cameras
        ]
    middle = Camera(k, pose).moved((sensor.baseline_m / 2, 0, 0)).world_from_camera
    slide = Projector(middle, sensor.pattern.slide, sensor.tan_half_width, strength=16.0)
    scene = Scene((Body(mesh),), slide, sensor.ambient)
    return lambda: renderer.render(scene, cameras, seed=0, geometry=[True, False])


def of_window(make: type) -> Pair:
    """The object's window against the whole frame."""
    renderer = make(samples=4)
    ways = (rendering(renderer, windowed=windowed) for windowed in (True, False))
    return Pair(*ways, "whole frame")


def of_renderers() -> Pair:
    """A pair by Mitsuba against Blender, 4 samples."""
    ways = (rendering(r(samples=4), windowed=True) for r in (MitsubaRenderer, BlenderRenderer))
    return Pair(*ways, "Blender")


def of_prediction() -> Pair:
    """Clouds of 2,048 points to probabilities of DGCNN, against loops and its formulas."""
    clouds = np.random.default_rng(0).normal(size=(64 if ENABLED else 2, 2048, 3))
    predictor, net = qs3.load("dgcnn-speckle"), build_net("dgcnn").float()
    few = clouds[:8]

    def theirs() -> None:
        for cloud in few:
            cloud = cloud - cloud.mean(0)
            cloud = cloud / np.linalg.norm(cloud, axis=1).max()
            chosen = torch.from_numpy(cloud[released_fps(cloud, 1024)]).float()
            with torch.no_grad(), plain():
                net(chosen[None])

    given = list(clouds.astype(np.float32))
    return Pair(lambda: predictor(given), theirs, "by formula", (len(clouds), len(few)))


PAIRS: dict[str, Callable[[], Pair]] = {
    "Mitsuba, a window": lambda: of_window(MitsubaRenderer),
    "Blender, a window": lambda: of_window(BlenderRenderer),
    "Mitsuba, a pair": of_renderers,
    "predict, a cloud": of_prediction,
}
NEED_BLENDER = ("Blender, a window", "Mitsuba, a pair")


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[pytest.mark.blender] * (n in NEED_BLENDER)) for n in PAIRS],
)
def test_pair(name: str, benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture) -> None:
    compare(name, PAIRS[name](), benchmark, capsys)


def released_item(path: Path, rng: np.random.Generator) -> np.ndarray:
    """One augmented cloud [1024, 3], as QS3's and GAST's data sets load it."""
    points = np.loadtxt(path).astype(np.float32)
    points = points - points.mean(axis=0)
    points = points / np.max(np.sqrt(np.sum(points**2, axis=1)))
    points = points[released_fps(points, 1024, int(rng.integers(len(points))))]
    angle = rng.uniform() * 2 * np.pi
    cos, sin = np.cos(angle), np.sin(angle)
    points = points @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    noise = np.clip(0.01 * rng.standard_normal(points.shape), -0.02, 0.02)
    return (points + noise).astype(np.float32)


@pytest.mark.filterwarnings("ignore:.*:UserWarning")  # Lightning's on trainers without a loader
def test_loading(
    benchmark: BenchmarkFixture, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """An epoch of a run's batches, augmented, against files item by item."""
    clouds, rng = 4183 if ENABLED else 32, np.random.default_rng(0)  # PointDA-10's ModelNet
    stored = rng.normal(size=(clouds, 2048, 3)).astype(np.float32)
    np.save(tmp_path / "points.npy", stored)
    mapped = np.load(tmp_path / "points.npy", mmap_mode="r")
    ids = tuple(f"{i:05d}" for i in range(clouds))
    kept = Clouds.of(mapped, farthest_points(mapped, 1024, 4, tmp_path, "benchmark"), names=ids)
    domain = Domain("made", "M", "Made", "nowhere")
    data = AdaptationData(
        domain, domain, phases=Phases(200), scheme=SelfTrainingConfig(), augment=Augment(),
        batch_size=16, seed=0,
    )  # fmt: skip
    data.labelled_domain.train = Labelled(kept, torch.arange(clouds) % 10)
    data.trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    data.trainer.training = True

    def epoch() -> None:
        seen = 0
        for batch in data.train_dataloader():
            points = data.on_after_batch_transfer(batch, 0)["source"]["points"]
            assert points.shape[1:] == (1024, 3)
            seen += len(points)
        assert seen == clouds

    paths = [tmp_path / f"{i}.xyz" for i in range(16 if ENABLED else 1)]
    for path, cloud in zip(paths, stored, strict=False):
        np.savetxt(path, cloud, fmt="%.6f")

    def released() -> None:
        np.stack([released_item(path, rng) for path in paths])

    pair = Pair(epoch, released, "the released way", (clouds, len(paths)))
    compare("loading, a cloud", pair, benchmark, capsys)


COMMANDS = {
    "train.py --help": ("train.py", "--help"),
    "generate.py --help": ("generate.py", "--help"),
    "qs3 --help": ("-m", "qs3", "--help"),
    "import qs3": ("-c", "import qs3"),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_first_answer(name: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Against importing torch, which commands must not wait for."""

    def run(*words: str) -> None:
        words = tuple(str(ROOT / word) if word.endswith(".py") else word for word in words)
        env = {**os.environ, "PYTHONPATH": str(ROOT)}
        command = [sys.executable, *words]
        subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, check=False)

    if not ENABLED:
        run(*COMMANDS[name])
        return
    ours, torchs = (
        seconds(lambda w=w: run(*w), 3) for w in (COMMANDS[name], ("-c", "import torch"))
    )
    show(capsys, f"{name}: {ours:.2f} s, {ours / torchs:.2f} of importing torch")
