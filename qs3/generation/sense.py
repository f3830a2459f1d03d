"""Depth sensors for any simulator: `qs3.sense` and `qs3.match`."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from qs3.config.compose import composed
from qs3.config.hydra import build
from qs3.datasets.depth_images import Intrinsics, Pinhole, camera_of, check_intrinsics
from qs3.errors import ConfigError
from qs3.sensors.base import DepthFrame, DepthSensor, Lighting
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.matching.base import for_picture, found_px
from qs3.sensors.optics.infrared import InfraredCamera
from qs3.sensors.optics.visibility import Reason
from qs3.sensors.renderers.depth import DepthRenderer
from qs3.utils.processor import cores

Lens = Pinhole | Sequence[float] | np.ndarray

_SAMPLES = 3  # of a pixel of the device, along its row
_EVERYWHERE = np.array([[-1e6] * 3, [1e6] * 3])


@lru_cache(maxsize=32)
def device(name: str, *overrides: str) -> DepthSensor:
    """The sensor of conf/sensor with this name ("kinect_v1"), changed by words of Hydra."""
    cfg = composed(None, f"+sensor={name}", *overrides, place=f"sensor={name}: ")
    made: DepthSensor = build(cfg.sensor)
    return made


def sense(
    depth_m: np.ndarray,
    intrinsics: Lens,
    *,
    sensor: str | DepthSensor = "realsense_d435",
    seed: int | Sequence[int] = 0,
    albedo: float | np.ndarray = 0.8,
    ambient: float | None = None,
    explain: bool = False,
) -> Any:
    """Measure perfect depth as a real depth camera would.

        noisy = qs3.sense(depth, (fx, fy, cx, cy), sensor="realsense_d435", seed=0)

    The depth image is the geometry: its pixels become a surface with breaks at depth steps, on
    which the device's projector throws its pattern, with shadows, the cosine of incidence and the
    inverse square of the distance. The device's cameras take noisy images of it, which its own
    matcher, filters and quantiser turn into depth; time of flight and fringes follow their laws.

    The device looks from the depth image's camera in the same direction, through its own lens at
    its own resolution: give it at least that resolution and field of view. Each pixel of the result
    has the value of the device's pixel nearest to its ray, never a mean of several, as where
    librealsense aligns depth to another camera or OpenNI scales it. Outside of the device's field
    of view there is none.

    Args:
        depth_m: [h, w] or [n, h, w] floats, metres along the optical axis; 0, NaN or infinite where
            nothing is. Several frames run on all cores.
        intrinsics: fx, fy, cx, cy in pixels, the centre of the top left one at (0, 0); or the
            matrix [3, 3] of these.
        sensor: a preset of conf/sensor, or a sensor: `qs3.generation.sense.device("kinect_v1",
            "sensor.infrared.read_noise_e=20")`.
        seed: of all noise, one number or several; frame k of a batch has noise of its own. The same
            depth and seed give the same bytes on any number of threads.
        albedo: reflectance in the near infrared, 0..1, or an image [h, w] (or [n, h, w]) of it: a
            simulator's grey picture / 255 serves.
        ambient: radiance of other light on white, in the sensor's units (`ambient` of its preset,
            the default).
        explain: also give the reason of each pixel.

    Returns:
        [h, w] (or [n, h, w]) float32 metres, NaN where the device measures nothing; with `explain`
        also uint8 of the same shape, `qs3.sensors.optics.visibility.Reason`: OK, SHADOW, DARK, ...

    Raises:
        DataError: these intrinsics cannot be those of the image, or it is not in metres.
        ConfigError: there is no such preset.
    """
    given = device(sensor) if isinstance(sensor, str) else sensor
    lens = _pinhole(intrinsics)
    frames = np.asarray(depth_m, dtype=np.float32)
    many, frames = frames.ndim == 3, frames if frames.ndim == 3 else frames[None]
    grey = np.broadcast_to(np.asarray(albedo, dtype=np.float32), frames.shape)

    def one(k: int) -> tuple[np.ndarray, np.ndarray]:
        check_intrinsics(Intrinsics(lens), frames[k], "sense")
        how = (*np.atleast_1d(seed), k), grey[k], ambient, explain
        return seen_by(frame_of(frames[k], lens, given, *how), lens, frames[k].shape)

    with ThreadPoolExecutor(len(cores())) as pool:
        found = list(pool.map(one, range(len(frames))))
    depth, why = (np.stack(each) if many else each[0] for each in zip(*found, strict=True))
    return (depth, why) if explain else depth


def frame_of(
    depth_m: np.ndarray,
    lens: Pinhole,
    sensor: DepthSensor,
    seed: Sequence[int],
    albedo: float | np.ndarray = 0.8,
    ambient: float | None = None,
    explain: bool = False,
) -> DepthFrame:
    """The device's own frame of a depth image [h, w], with its infrared images; see `sense`."""
    where = (lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px)
    renderer = DepthRenderer(depth_m, where, albedo, _SAMPLES * sensor.focal_px)
    rng = np.random.default_rng(seed)
    light = Lighting(ambient=ambient)
    frame = sensor.scan((), _EVERYWHERE, np.eye(4), renderer, rng, explain, light)
    assert frame is not None, "the whole view is in view"
    return frame


def seen_by(
    frame: DepthFrame, lens: Pinhole, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Depth [h, w] float32 and reason [h, w] uint8 of a frame, at the pixels of another lens."""
    k, samples = frame.camera.intrinsics, frame.depth_m.shape

    def nearest(count: int, f: float, c: float, middle: float, first: int, n: int) -> np.ndarray:
        at = k.focal_px * (np.arange(count) - c) / f + middle
        place = np.floor((at - first) / frame.step_px + 0.5).astype(int)
        return np.where((place >= 0) & (place < n), place, n)

    rows = nearest(shape[0], lens.fy_px, lens.cy_px, k.cy_px, frame.top, samples[0])
    columns = nearest(shape[1], lens.fx_px, lens.cx_px, k.cx_px, frame.left, samples[1])
    at = np.ix_(rows, columns)
    depth = np.pad(frame.depth_m, (0, 1), constant_values=np.nan)[at]
    return depth, np.pad(frame.reason, (0, 1), constant_values=Reason.OUTSIDE)[at]


def match(
    left: np.ndarray,
    right: np.ndarray,
    intrinsics: Lens,
    *,
    baseline_m: float,
    preset: str | SpeckleStereo = "realsense_d435",
    num_disparities: int | None = None,
    explain: bool = False,
) -> Any:
    """Match a rectified infrared pair of your own by a device's matcher and filters.

    Args:
        left, right: [h, w] uint8, rectified: a point lies in the same row of both, in the right one
            f b / Z columns farther left.
        intrinsics: of the left image; see `sense`. The principal points are the same.
        baseline_m: b, from the left camera to the right one.
        preset: a sensor of conf/sensor with two cameras, or such a sensor.
        num_disparities: how many whole disparities are searched; None: the preset's. Nearer than
            f b over that many nothing is found.
        explain: also give the reason of each pixel.

    Returns:
        [h, w] float32 metres, NaN where nothing matches; with `explain` also [h, w] uint8
        `qs3.sensors.optics.visibility.Reason`.

    Raises:
        ConfigError: there is no such preset, or it has one camera.
    """
    sensor: Any = device(preset) if isinstance(preset, str) else preset
    if not isinstance(sensor, SpeckleStereo):
        raise ConfigError(f"preset={preset} does not match two cameras' images")
    assert left.dtype == right.dtype == np.uint8, "pictures have 8 bits, as the camera's noise"
    lens, matcher = _pinhole(intrinsics), sensor.matcher
    if num_disparities is not None:
        matcher = replace(matcher, num_disparities=num_disparities)  # type: ignore[type-var]
    least, most = (lens.fx_px * baseline_m / max(px, 1e-6) for px in found_px(matcher)[::-1])
    sensor = replace(
        sensor,
        focal_px=lens.fx_px,
        baseline_m=baseline_m,
        matcher=matcher,
        min_depth_m=max(sensor.min_depth_m, least * 1.000001),
        max_depth_m=min(sensor.max_depth_m, most * 0.999999),
    )
    if isinstance(sensor.infrared, InfraredCamera):  # as exposed without an amplifier
        matcher = for_picture(matcher, sensor.infrared.noise(0.0))
    depth, _, why = sensor.depth_of(matcher.match(left, right))
    return (depth, why) if explain else depth


def _pinhole(intrinsics: Lens) -> Pinhole:
    if isinstance(intrinsics, Pinhole):
        return intrinsics
    return camera_of([float(value) for value in np.ravel(intrinsics)], "intrinsics")
