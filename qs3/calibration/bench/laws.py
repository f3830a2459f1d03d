"""Published laws of the noise of real depth cameras, to compare ours with. Depths in metres.

Only formulas and constants; each function names where they come from.
"""

from __future__ import annotations

import numpy as np

NGUYEN_WITHIN_DEG = 60.0
"""Up to this angle of incidence Nguyen's axial noise does not depend on it."""

INTEL_SUBPIXEL_PX = (0.032, 0.08)
"""Sub-pixel RMS of a D400 on a well-textured wall: what is possible, and what to count on
(Grunnet-Jepsen, librealsense #3904)."""

D400_BAND_PX = (0.03, 0.10)
"""Sub-pixel RMS that we allow a D400 preset; the upper end is what simulators of it assume."""


D400_ACCURACY = (0.02, 2.0)
"""Z accuracy of the D400 data sheet: within 2 % up to 2 m."""

D435_KOTSONIS_M = (0.5, 0.7, 1.0, 1.5, 2.0, 3.0)
"""Where Kotsonis' noise of a real D435 (0.2 to 3.25 m) is asked of a D435 preset. Below 0.5 m it is
that of the whole steps of his depth images, not of the disparity."""

D435_REACH_M = 3.25
"""To here Kotsonis' D435 measured. Beyond, on a plain wall in a lit room, its dots are too dim for
the texture that Intel's sub-pixel RMS asks for."""

FILL_TILTED: dict[float, tuple[float, float]] = {80.0: (0.3, 1.0), 85.0: (0.0, 0.7)}
"""Fill of planes that are nearly edge-on (in degrees), where D400s lose pixels. By geometry: at 80
degrees and 2 m the disparity changes by 2 px and more across a D415's window (`ramp_px`), at 85
degrees by 5, where one or two are the most that a single shift fits; at the same time a dot's light
falls with the cosine, to a sixth and to a tenth. No published count of their pixels was found, so
the ranges are wide: at 80 degrees all or a third, at 85 a minority or little more."""

REAL_ROOM_EMPTY = 0.11
"""Share of pixels without depth in frames of real rooms by Kinects; what windows, screens and the
move to the colour camera take is part of it."""

REAL_MIXED = 0.11
"""Share of the steps over 10 cm in frames of real rooms with a mixed pixel, 2 cm or more from both
sides; ours are counted at 5 cm, on near silhouettes alone, which lets fewer through: the band is
lenient to a sensor with too many. In the eight clouds of
a table that the bench reads it is three of 2,142: edges there are near, and clearer."""

D415_AT_M = 1.0
"""Where a D415 preset is held against the device's figures: its pictures show a table."""

REAL_D415: dict[str, tuple[float, float]] = {
    "subpixel_rms_px": (0.09, 0.16),
    "correlation_px": (5.6, 9.4),
    "contrast": (0.09, 0.22),
    "autocorrelation": (0.48, 0.69),
    "dots_over_ambient": (0.6, 1.8),
    "fill": (0.97, 1.0),
}
"""A real D415: its infrared pictures with and without the projector, and its own depth (f = 1344
px, B = 54.8 mm). Sub-pixel RMS of a plane 0.125 px and correlation length of its noise 7.5 px, both
with 25 to 30 % either way, as they are of one plane; contrast of 9 x 9 windows from metal to
plastic; correlation of pixels 2 px apart over the surfaces; brightest dots over ambient light;
fill 98 %, and a percent less. Pixels are taken for pixels although the preset has f = 1004.6:
matching, smoothing and a lens that suits its grid are the same there, an angle is not."""


def nguyen_axial_m(depth_m: np.ndarray | float, angle_deg: float = 0.0) -> np.ndarray:
    """Axial noise of Kinect v1, one standard deviation.

    Nguyen, Izadi and Lovell, 3DIMPVT 2012: 0.0012 + 0.0019 (z - 0.4)^2 up to 60 degrees,
    beyond with 0.0001 / sqrt(z) theta^2 / (pi / 2 - theta)^2 on top.
    """
    z = np.asarray(depth_m, dtype=np.float64)
    sigma = 0.0012 + 0.0019 * (z - 0.4) ** 2
    if angle_deg > NGUYEN_WITHIN_DEG:
        theta = np.deg2rad(angle_deg)
        sigma = sigma + 0.0001 / np.sqrt(z) * theta**2 / (np.pi / 2 - theta) ** 2
    return sigma


def nguyen_lateral_px(angle_deg: float) -> float:
    """Lateral noise of Kinect v1 at an edge: 0.8 + 0.035 theta / (pi / 2 - theta), same paper."""
    theta = np.deg2rad(angle_deg)
    return float(0.8 + 0.035 * theta / (np.pi / 2 - theta))


def khoshelham_m(depth_m: np.ndarray | float) -> np.ndarray:
    """Random error of Kinect v1: 1.425e-6 Z^2 with Z in mm (Khoshelham and Elberink 2012)."""
    return 1.425e-3 * np.asarray(depth_m, dtype=np.float64) ** 2


def kotsonis_d435_m(depth_m: np.ndarray | float) -> np.ndarray:
    """Axial noise of a D435 as measured by L. Kotsonis (elevation_mapping, 0.2 to 3.25 m)."""
    z = np.asarray(depth_m, dtype=np.float64)
    return 0.000611 + 0.003587 * (z - 0.3515) ** 2


def triangulation_m(
    depth_m: np.ndarray | float, focal_px: float, baseline_m: float, subpixel_px: float
) -> np.ndarray:
    """Z^2 / (f B) times the error of the disparity: Intel's formula for the RMS of a D400."""
    z = np.asarray(depth_m, dtype=np.float64)
    return z**2 * subpixel_px / (focal_px * baseline_m)


def ramp_px(window_px: int, baseline_m: float, depth_m: float, tilt_deg: float) -> float:
    """By how much the disparity changes across a window on a plane tilted along the baseline.

    w B tan(theta) / Z: with more than a pixel or two of it, no single shift fits the window.
    """
    return window_px * baseline_m * float(np.tan(np.deg2rad(tilt_deg))) / depth_m


def ramp_angle_deg(window_px: int, baseline_m: float, depth_m: float, ramp: float = 1.0) -> float:
    """The tilt at which `ramp_px` reaches `ramp` px."""
    return float(np.rad2deg(np.arctan(ramp * depth_m / (window_px * baseline_m))))
