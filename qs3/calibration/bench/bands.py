"""What must hold of each sensor, and whether it does.

The limits come from devices (qs3.calibration.bench.laws) or from geometry, never from what a sensor
of ours happened to give.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from qs3.calibration.bench import laws, metrics
from qs3.calibration.bench.runner import SensorResult
from qs3.sensors.devices.fitted import FittedDepth

_KINECTS = ("kinect_v1", "structure_sensor")
NGUYEN_DEPTHS_M = (1.0, 1.5, 2.0, 3.0, 4.0)


@dataclass(frozen=True)
class Verdict:
    """One band of one sensor.

    Attributes:
        sensor: name.
        band: what is asked for.
        measured: as text.
        low, high: limits of `value`, both included.
        value: the number that is compared; None where it could not be measured.
    """

    sensor: str
    band: str
    measured: str
    low: float
    high: float
    value: float | None

    @property
    def passed(self) -> bool:
        """Whether the value lies within the limits."""
        return self.value is not None and self.low <= self.value <= self.high


_Band = tuple[str, str, float, float, float | None]
"""A `Verdict` but for the sensor."""


def judge(result: SensorResult) -> list[Verdict]:
    """All bands that apply to a sensor."""
    name = result.subject.name
    out: list[_Band] = []
    # A preset by `qs3 fit` is held against what its camera's frames say, however it is called.
    device = "" if isinstance(result.subject.sensor, FittedDepth) else name
    if result.subject.focal_baseline is not None:
        if device:
            p, _ = exponent(result, _reach_m(name))
            band = "sigma_Z grows as Z^p, p in 1.8 to 2.2" + _up_to(name)
            out.append((band, f"p = {p:.2f}", 1.8, 2.2, p))
        out += _bias(result) + _levels(result)
    if device.startswith("kinect_v1"):
        out += _nguyen(result)
    if "d415" in device:
        out += _real_d415(result)
    elif "d4" in device:
        out += _d400(result)
    if "d435" in device:
        out += _kotsonis(result)
    if "d4" in device:
        out += _grazing(result)
    out += _own_law(result) + _fill(result) + _edge(result)
    out += _rooms(result)
    return [Verdict(name, *band) for band in out]


def _own_law(result: SensorResult) -> list[_Band]:
    """Within 10 % of what the sensor states, at the distance where it is farthest from it."""
    worst: tuple[float, float, float, float] | None = None
    for m in result.facing():
        if m.get("law_m") and m["sigma_m"]:
            # The law is that of a whole normal error, sigma_m that of the inner 99 % of one.
            law = m["law_m"] * metrics.TRIMMED_NORMAL
            found = (m["sigma_m"] / law, m["condition"]["depth_m"], m["sigma_m"], law)
            if worst is None or abs(np.log(found[0])) > abs(np.log(worst[0])):
                worst = found
    if worst is None:
        return []
    ratio, depth, sigma, law = worst
    text = f"{1e3 * sigma:.2f} mm against {1e3 * law:.2f} mm at {depth:g} m, the worst"
    band = "sigma_Z within 10 % of the sensor's own law at every distance"
    return [(band, text, 0.9, 1.1, ratio)]


def _reach_m(name: str) -> float:
    """How far the laws of a sensor's noise are asked for."""
    return laws.D435_REACH_M if "d435" in name else np.inf


def _up_to(name: str) -> str:
    reach = _reach_m(name)
    return f" up to {reach:g} m" if np.isfinite(reach) else ""


def exponent(result: SensorResult, reach_m: float = np.inf) -> tuple[float, float]:
    """Exponent and factor of sigma_Z = a Z^p over the distances up to `reach_m`."""
    facing = [m for m in result.facing() if m["sigma_m"] and m["condition"]["depth_m"] <= reach_m]
    depth = np.array([m["condition"]["depth_m"] for m in facing])
    return metrics.power_law(depth, np.array([m["sigma_m"] for m in facing]))


def _bias(result: SensorResult) -> list[_Band]:
    """Pooled over phases: 0.02 px for a D400, else a quarter of a step of the disparity.

    What a device's calibration leaves is a bias too: of such a sensor the data sheet's is asked.
    """
    facing = [m for m in result.facing() if m["bias_px"] is not None]
    if _is_misaligned(result.subject.sensor):
        return _accuracy(facing)
    worst = max(facing, key=lambda m: abs(m["bias_px"]), default=None)
    if worst is None:
        return [("median bias", "nothing measured", 0, 0, None)]
    if isinstance(result.subject.sensor, FittedDepth):
        return _fitted_bias(result.subject.sensor, result.subject.focal_baseline or 0.0, facing)
    if "d4" in result.subject.name:
        limit = 0.02
        band = "median bias under 0.02 px at every distance"
    else:
        limit = 0.25 / (result.subject.steps_per_px or 16)
        band = f"median bias under a quarter of a step ({limit:.4f} px) at every distance"
    text = f"{worst['bias_px']:+.4f} px at {worst['condition']['depth_m']:g} m"
    return [(band, text, -limit, limit, worst["bias_px"])]


def _fitted_bias(sensor: FittedDepth, fb: float, facing: list[dict[str, Any]]) -> list[_Band]:
    """The bias beyond the one that a preset by `qs3 fit` states, because its camera has it.

    A quarter of the largest step there: its own of 1 / Z or of Z, or 1/16 px.
    """
    found = []
    for m in facing:
        depth = m["condition"]["depth_m"]
        stated = depth + float(np.polynomial.polynomial.polyval(depth, sensor.bias_m))
        off = m["bias_px"] - (fb / stated - fb / depth)
        own = max(sensor.inverse_step_per_m, sensor.depth_step_m / depth**2)
        found.append((off, 0.25 * max(abs(fb) * own, 1 / 16), depth))
    off, limit, depth = max(found, key=lambda one: abs(one[0]) / one[1])
    band = "median bias within a quarter of a step of the preset's own at every distance"
    text = f"{off:+.4f} px at {depth:g} m, where that is {limit:.4f} px"
    return [(band, text, -limit, limit, off)]


def _accuracy(facing: list[dict[str, Any]]) -> list[_Band]:
    """Median error over depth, as librealsense's tool has it."""
    most, reach = laws.D400_ACCURACY
    near = [m for m in facing if m["condition"]["depth_m"] <= reach]
    worst = max(near, key=lambda m: abs(m["accuracy"]), default=None)
    band = f"Z accuracy within {most:.0%} up to {reach:g} m"
    if worst is None:
        return [(band, "nothing measured", 0, 0, None)]
    value = worst["accuracy"]
    text = f"{value:+.2%} at {worst['condition']['depth_m']:g} m"
    return [(band, text, -most, most, value)]


def _levels(result: SensorResult) -> list[_Band]:
    """As many distinct depths as the quantiser has steps.

    What a calibration leaves moves the first and the last plane: up to a level a distance may
    be missing then.
    """
    subject = result.subject
    if not subject.steps_per_px:
        return []
    found = sum(m.get("levels", 0) for m in result.facing())
    wanted = sum(m.get("levels_expected", 0) for m in result.facing())
    low = wanted - len(result.facing()) * _is_misaligned(subject.sensor)
    band = f"distinct depth levels as 1/{subject.steps_per_px} px predicts"
    text = f"{found} of {wanted} over {len(result.facing())} distances"
    return [(band, text, low, wanted, found)]


def _is_misaligned(sensor: Any) -> bool:
    return bool(getattr(getattr(sensor, "misalignment", None), "columns_px", 0))


def _nguyen(result: SensorResult) -> list[_Band]:
    out: list[_Band] = []
    by_depth = {m["condition"]["depth_m"]: m for m in result.facing()}
    for depth in NGUYEN_DEPTHS_M:
        m = by_depth.get(depth)
        law = float(laws.nguyen_axial_m(depth))
        sigma = None if m is None else m["sigma_m"]
        ratio = None if sigma is None else sigma / law
        text = "-" if ratio is None else f"{1e3 * law * ratio:.2f} mm, {ratio - 1:+.0%}"
        band = f"sigma_Z at {depth:g} m within 30 % of Nguyen's {1e3 * law:.2f} mm"
        out.append((band, text, 0.7, 1.3, ratio))
    return out


def _d400(result: SensorResult) -> list[_Band]:
    low, high = laws.D400_BAND_PX
    name = result.subject.name
    near = [m for m in result.facing() if m["condition"]["depth_m"] <= _reach_m(name)]
    values = [m["subpixel_rms_px"] for m in near]
    good = [v for v in values if v is not None]
    text = f"{min(good):.3f} to {max(good):.3f} px" if good else "nothing measured"
    band = f"sub-pixel RMS in {low:g} to {high:g} px at every distance{_up_to(name)}"
    # The value farthest from the middle of the band decides.
    middle = (low + high) / 2
    worst = max(good, key=lambda v: abs(v - middle)) if len(good) == len(values) else None
    return [(band, text, low, high, worst)]


def _kotsonis(result: SensorResult) -> list[_Band]:
    """Noise of a real D435: within 30 %, where it is farthest from that."""
    worst: tuple[float, float, float] | None = None
    for m in result.facing():
        depth = m["condition"]["depth_m"]
        if depth in laws.D435_KOTSONIS_M and m["sigma_m"]:
            found = (m["sigma_m"] / float(laws.kotsonis_d435_m(depth)), depth, m["sigma_m"])
            if worst is None or abs(np.log(found[0])) > abs(np.log(worst[0])):
                worst = found
    first, last = laws.D435_KOTSONIS_M[0], laws.D435_KOTSONIS_M[-1]
    band = f"sigma_Z from {first:g} to {last:g} m within 30 % of a real D435's (Kotsonis)"
    if worst is None:
        return [(band, "nothing measured", 0, 0, None)]
    ratio, depth, sigma = worst
    text = f"{1e3 * sigma:.2f} mm at {depth:g} m, {ratio - 1:+.0%}, the worst"
    return [(band, text, 0.7, 1.3, ratio)]


def _grazing(result: SensorResult) -> list[_Band]:
    """Fill of planes that are nearly edge-on, the mean of both ways to recede."""
    out: list[_Band] = []
    for tilt, (low, high) in laws.FILL_TILTED.items():
        both = result.tilted(True) + result.tilted(False)
        found = [m["fill"] for m in both if m["condition"]["tilt_deg"] == tilt]
        if found:  # a quick bench leaves them out
            value = float(np.mean(found))
            band = f"fill at {tilt:g} degrees in {low:.0%} to {high:.0%}"
            out.append((band, f"{value:.1%}", low, high, value))
    return out


_D415_WORDS = {
    "subpixel_rms_px": ("sub-pixel RMS", "px"),
    "correlation_px": ("correlation length of the noise", "px"),
    "contrast": ("contrast of 9 x 9 infrared pixels", ""),
    "autocorrelation": ("correlation of infrared pixels 2 px apart", ""),
    "dots_over_ambient": ("brightest dots over ambient light", ""),
    "fill": ("fill", ""),
}


def _real_d415(result: SensorResult) -> list[_Band]:
    """A real device's figures, at one distance."""
    rows = (m for m in result.facing() if m["condition"]["depth_m"] == laws.D415_AT_M)
    found: dict[str, Any] = {**next(rows, {}), **(result.infrared or {})}
    if lags := found.get("autocorrelation"):
        found["autocorrelation"] = lags[1]
    out: list[_Band] = []
    for key, (low, high) in laws.REAL_D415.items():
        words, unit = _D415_WORDS[key]
        value = found.get(key)
        band = f"{words} in {low:g} to {high:g} {unit}".strip() + f" at {laws.D415_AT_M:g} m"
        out.append(
            (band, "-" if value is None else f"{value:.3g} {unit}".strip(), low, high, value)
        )
    return out


def _fill(result: SensorResult) -> list[_Band]:
    both = result.tilted(True) + result.tilted(False)
    gentle = result.facing() + [m for m in both if m["condition"]["tilt_deg"] <= 45]
    sensor = result.subject.sensor
    if isinstance(sensor, FittedDepth):
        return _fitted_fill(sensor, gentle)
    worst = min(gentle, key=lambda m: m["fill"])
    where = f"{worst['condition']['depth_m']:g} m, {worst['condition']['tilt_deg']:g} deg"
    text = f"at least {worst['fill']:.1%} ({where})"
    return [("fill above 95 % up to 45 degrees", text, 0.95, 1.0, worst["fill"])]


def _fitted_fill(sensor: FittedDepth, gentle: list[dict[str, Any]]) -> list[_Band]:
    """Of a preset by `qs3 fit` what its camera filled is asked for, which may be less than 95 %."""
    found = []
    for m in gentle:
        depth, tilt = m["condition"]["depth_m"], m["condition"]["tilt_deg"]
        stated = float(np.interp(tilt, sensor.tilts_deg, sensor.fill_rates))
        found.append((m["fill"] - stated, m["fill"], stated, f"{depth:g} m, {tilt:g} deg"))
    off, fill, stated, where = max(found, key=lambda one: abs(one[0]))
    band = "fill within 5 points of the preset's own up to 45 degrees"
    return [(band, f"{fill:.1%} against {stated:.1%} ({where}), the worst", -0.05, 0.05, off)]


def _edge(result: SensorResult) -> list[_Band]:
    m = result.edge
    out: list[_Band] = []
    for who, what in (("camera", "camera shadow"), ("projector", "projector shadow")):
        if f"{who}_left_px" not in m or m.get(f"{who}_expected_px") is None:
            continue
        expected = m[f"{who}_expected_px"]
        left, right = m[f"{who}_left_px"], m[f"{who}_right_px"]
        # What the other camera or the projector at +x does not reach lies left of the square.
        on, off = (left, right) if expected >= 0 else (right, left)
        side = "left" if expected >= 0 else "right"
        wide = abs(expected)
        text = f"{on:.1f} px {side}, {off:.1f} px on the other side"
        band = f"{what} {wide:.1f} px {side} of the square, within 2 px"
        worst = max(abs(on - wide), off)
        out.append((band, text, 0.0, 2.0, worst))
    half = m.get("half_window_px")
    if half and m.get("fattening_right_px") is not None:
        right, wall = m["fattening_right_px"], m["wall_right_px"]
        begins = "nowhere" if wall is None else f"{wall:.0f} px from the edge"
        text = f"square ends {right:+.0f} px, wall begins {begins}"
        band = f"open edge blurred by no more than half a window ({half:.1f} px) and 1 px"
        worst_px = max(abs(right), abs(wall if wall is not None else np.inf))
        out.append((band, text, 0.0, half + 1, worst_px))
    return out


def _rooms(result: SensorResult) -> list[_Band]:
    """Rooms with mixed materials: what is lost and what is mixed, within a factor of two of real.

    What is lost is a real Kinect's, and asked of Kinects; D400s have other shadows and ranges.
    """
    found = [m for m in result.rooms if m["condition"]["materials"] == "mixed"]
    if not found:  # a quick bench leaves them out
        return []
    out: list[_Band] = []
    if result.subject.name.startswith(_KINECTS):
        empty, real = found[0]["empty"], laws.REAL_ROOM_EMPTY
        band = f"pixels of a room without depth within a factor of 2 of {real:.0%}"
        out.append((band, f"{empty:.1%}", real / 2, 2 * real, empty))
    mixed, real = found[0]["mixed"], laws.REAL_MIXED
    band = f"steps of a room with a mixed pixel within a factor of 2 of {real:.0%}"
    text = "no steps" if mixed is None else f"{mixed:.1%} of {found[0]['steps']}"
    out.append((band, text, real / 2, 2 * real, mixed))
    return out


def drop(result: SensorResult, across: bool, below: float = 0.95) -> float | None:
    """The tilt at which the fill falls below a share, by linear interpolation; None if never."""
    rows = [(m["condition"]["tilt_deg"], m["fill"]) for m in result.tilted(across)]
    for (a, fill_a), (b, fill_b) in itertools.pairwise(rows):
        if fill_a >= below > fill_b:
            return float(a + (b - a) * (fill_a - below) / (fill_a - fill_b))
    return None
