"""A depth image in memory and what is pointed at in it, for `Predictor.predict_depth`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from qs3.datasets.depth_images import (
    Intrinsics,
    Pinhole,
    camera_of,
    check_intrinsics,
    check_metres,
    off_centre,
)
from qs3.datasets.pointed import Pointed, point_out
from qs3.errors import DataError


@dataclass(frozen=True, eq=False)
class DepthPrediction:
    """A classifier's prediction for one object of a depth image.

    Attributes:
        name: "[3]", the number in the mask; "[210,95,480,430]", the box; "" of a mask of bool.
        cls: the likeliest class; "" if nothing of the object was measured, or the classifier's
            training has diverged.
        confidence: its probability, in [0, 1]; NaN if there is no class.
        probabilities: [C] float64, in the order of the predictor's classes; likewise.
        points_m: [n, 3] float32, z up, the camera at the origin.
        tier: "clean", "hard", or "poor": datasets leave such objects out.
        cautions: the reasons for `tier`, and what is not sure about the picture.
        up: how the vertical is known: "given", "planes" of the picture, or "level" camera.
        strange: how the cloud differs from all of training's; see `qs3.evaluation.ood`.
    """

    name: str
    cls: str
    confidence: float
    probabilities: Float[np.ndarray, " c"]
    points_m: Float[np.ndarray, "n 3"]
    tier: str
    cautions: tuple[str, ...]
    up: str
    strange: tuple[str, ...]


def objects_of(
    depth_m: Float[np.ndarray, "h w"],
    camera: Pinhole | Sequence[float] | np.ndarray,
    *,
    mask: np.ndarray | None = None,
    box: Sequence[float] | None = None,
    up: Sequence[float] | None = None,
) -> tuple[list[Pointed], list[str]]:
    """The objects in the order of the mask's numbers, and what is not sure about the camera.

    Args:
        depth_m, camera, mask, box, up: as `Predictor.predict_depth` takes them. What masked arrays
            hide was not measured, or is background.

    Raises:
        DataError: as of `Predictor.predict_depth`.
    """
    depth = _seen(depth_m)
    if depth.ndim != 2 or depth.dtype.kind != "f":
        raise DataError(
            f"the depth image is {depth.dtype} {depth.shape}, expected floats [h, w] in metres"
        )
    check_metres(depth, "the depth image")
    if not isinstance(camera, Pinhole):
        expected = "fx, fy, cx, cy in pixels, or the matrix [3, 3] of these"
        camera = camera_of(_numbers("camera", camera, expected), "camera")
    check_intrinsics(given := Intrinsics(camera), depth, "the depth image")
    unsure = [words] if (words := off_centre(given, depth)) else []
    if box is not None:
        box = _numbers("box", box, "left, top, right, bottom in pixels")
    if up is not None:
        up = _numbers("up", up, "x, y, z of a direction in the camera's frame")
    mask = None if mask is None else _seen(mask)
    return point_out(depth, camera, mask=mask, box=box, up=up), unsure


def _seen(image: Any) -> np.ndarray:
    """The values, 0 for those that a masked array hides: numpy would hand these on as they are."""
    return np.asarray(image.filled(0) if isinstance(image, np.ma.MaskedArray) else image)


def _numbers(what: str, given: Any, expected: str) -> list[float]:
    try:
        return [float(value) for value in np.ravel(given)]
    except (TypeError, ValueError) as error:  # words, None, rows of different lengths
        raise DataError(f"{what}={given!r:.60}: expected {expected}") from error
