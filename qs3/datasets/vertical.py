"""Which way is up in a frame, in camera coordinates: two ways, the more reliable first.

Floor: the plane of the pixels that are labelled so. 1/z of a plane's pixels is linear in their
rays, and a triangulating sensor's noise is even in it, so that is what is fitted.

Planes: the direction to which most surfaces are parallel or perpendicular, from up in the picture
on (Gupta, Arbeláez, Malik, CVPR 2013, whose published rotations of NYU Depth V2 were found so).
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from qs3.datasets.depth_images import CAMERA_UP, Pinhole

MOST_TILT_DEG = 60.0
"""A floor tilted more in the picture is none."""

LEAST_FLOOR_PX = 1500
_ROUNDS = 6  # of fit and trimming
_TRIM = 3.0  # median absolute deviations
_LEAST_SHARE = 0.5  # of the floor's pixels that must lie in the plane
_MOST_OF_EIGHT = 5
_STEP_PX, _REACH_PX = 4, 8  # every how many pixels a normal, and from how far
_FOCAL_PX = 525.0  # of the cameras for which that is so; smaller pictures have smaller windows
_SPAN_SHARE = 0.15  # of the depth, that a window's depths may span
_STEEP_UP = np.array([0.0, -0.5, -np.sqrt(0.75)])  # of a camera that looks down by 60 degrees
_LEAST_LEVEL = 0.05  # share of the normals that a level surface has
_WITHIN_DEG = (45.0, 45.0, 45.0, 15.0, 15.0, 15.0)  # a plane counts as level or upright, by round


def floor_up(
    depth_m: Float[np.ndarray, "h w"], camera: Pinhole, floor: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, " 3"] | None:
    """Unit vector up by the floor; None if too little of it is seen, or it is not plane."""
    used = floor & (depth_m > 0)
    if used.sum() < LEAST_FLOOR_PX:
        return None
    rays = camera.rays(*depth_m.shape)[used]
    inverse = 1 / depth_m[used]
    kept = np.ones(len(rays), dtype=bool)
    for _ in range(_ROUNDS):
        plane, *_ = np.linalg.lstsq(rays[kept], inverse[kept], rcond=None)
        off = np.abs(rays @ plane - inverse)
        scale = max(1.4826 * float(np.median(off)), 1e-6)
        kept = off <= _TRIM * scale
    length = float(np.linalg.norm(plane))
    if kept.mean() < _LEAST_SHARE or length < 1e-9:
        return None
    up: np.ndarray = -plane / length  # the camera is above its floor
    return up if angle_deg(up, CAMERA_UP) <= MOST_TILT_DEG else None


def planes_up(depth_m: Float[np.ndarray, "h w"], camera: Pinhole) -> Float[np.ndarray, " 3"] | None:
    """Unit vector up by the planes of a room; None if there are too few normals."""
    return _fitted(_normals(depth_m, camera), CAMERA_UP)


def planes_up_steep(
    depth_m: Float[np.ndarray, "h w"], camera: Pinhole
) -> tuple[Float[np.ndarray, " 3"] | None, bool]:
    """As `planes_up`, also for a camera that looks steeply down, and whether it is sure.

    Where a camera looks down by more than 45°, the wall before it is nearer to level in the picture
    than the floor, but hangs above the camera like a ceiling: such a fit is made again from steeply
    down on. It is sure if level surfaces below the camera are seen, and were found from up in the
    picture. A table seen from straight above looks like a wall from the front: never sure.
    """
    normals = _normals(_without_lone_holes(depth_m), camera)
    level = _fitted(normals, CAMERA_UP)
    floors, ceilings = _level_shares(normals, level)
    if level is not None and ceilings <= max(floors, _LEAST_LEVEL):
        return level, floors >= _LEAST_LEVEL
    steep = _fitted(normals, _STEEP_UP)
    floors, ceilings = _level_shares(normals, steep)
    return (steep if floors > ceilings else level), False


def _level_shares(normals: np.ndarray, up: np.ndarray | None) -> tuple[float, float]:
    """Shares of the normals that are of level surfaces below the camera, and above it."""
    if up is None:
        return 0.0, 0.0
    along = normals @ up  # normals point away from the camera
    least = np.cos(np.deg2rad(_WITHIN_DEG[-1]))
    return float((along < -least).mean()), float((along > least).mean())


def _fitted(
    normals: Float[np.ndarray, "n 3"], start: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, " 3"] | None:
    """The direction near `start` to which most normals are parallel or perpendicular."""
    if len(normals) < 100:
        return None
    up = start
    for within in np.deg2rad(_WITHIN_DEG):
        along = np.abs(normals @ up)
        level, upright = normals[along > np.cos(within)], normals[along < np.sin(within)]
        _, axes = np.linalg.eigh(upright.T @ upright - level.T @ level)
        up = axes[:, 0] * np.sign(axes[:, 0] @ up or 1.0)
    return up if angle_deg(up, start) <= MOST_TILT_DEG else None


def angle_deg(a: Float[np.ndarray, " 3"], b: Float[np.ndarray, " 3"]) -> float:
    """Between two unit vectors."""
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


def _without_lone_holes(depth_m: np.ndarray) -> np.ndarray:
    """Pixels without depth as the mean of those around them, where most of the eight have one."""
    measured = (depth_m > 0).astype(np.float64)
    nine = np.ones(3)
    count = cv2.sepFilter2D(measured, cv2.CV_64F, nine, nine, borderType=cv2.BORDER_CONSTANT)
    known = np.where(measured > 0, depth_m, 0.0)
    total = cv2.sepFilter2D(known, cv2.CV_64F, nine, nine, borderType=cv2.BORDER_CONSTANT)
    lone = (measured == 0) & (count >= _MOST_OF_EIGHT)
    filled: np.ndarray = np.where(lone, total / np.maximum(count, 1), depth_m)
    return filled


def _normals(depth_m: np.ndarray, camera: Pinhole) -> np.ndarray:
    """[n, 3] unit normals of a grid of pixels, where a window around them is measured and smooth.

    1/z is linear in a plane's pixels, so a normal is the slopes of 1/z over the window.
    """
    scale = min(1.0, camera.fx_px / _FOCAL_PX)  # else a floor's depths span too much in a window
    r, step = max(2, round(scale * _REACH_PX)), max(1, round(scale * _STEP_PX))
    width = 2 * r + 1
    window = np.ones((width, width), np.uint8)
    holes = cv2.dilate((depth_m <= 0).astype(np.uint8), window, borderValue=(1,)) > 0
    span = cv2.dilate(depth_m, window) - cv2.erode(depth_m, window)
    smooth = ~holes & (span < _SPAN_SHARE * depth_m)
    smooth[:r], smooth[-r:], smooth[:, :r], smooth[:, -r:] = False, False, False, False
    inverse = np.divide(1, depth_m, out=np.zeros_like(depth_m), where=depth_m > 0)
    steps = np.arange(-r, r + 1, dtype=np.float64)
    slope, mean = steps / (steps**2).sum(), np.full(width, 1 / width)
    along_u = cv2.sepFilter2D(inverse, cv2.CV_64F, slope, mean)
    along_v = cv2.sepFilter2D(inverse, cv2.CV_64F, mean, slope)
    level = cv2.sepFilter2D(inverse, cv2.CV_64F, mean, mean)
    v, u = np.nonzero(smooth[::step, ::step])
    at = (v * step, u * step)
    x, y = (at[1] - camera.cx_px) / camera.fx_px, (at[0] - camera.cy_px) / camera.fy_px
    nx, ny = along_u[at] * camera.fx_px, along_v[at] * camera.fy_px
    normal = np.stack([nx, ny, level[at] - nx * x - ny * y], axis=1)
    unit: np.ndarray = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    return unit
