"""The bench as a page, and its numbers as CSV."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from qs3.calibration.bench import bands, laws, rooms
from qs3.calibration.bench.comparison import Comparison
from qs3.calibration.bench.edges import SIDES
from qs3.calibration.bench.runner import Plan, SensorResult
from qs3.utils import text_table

_INTRO = """# What our depth sensors measure

Each sensor of `conf/sensor` before targets whose geometry is known: planes at many distances and
tilts, a square before a wall, and rooms. Nothing here is fitted to a curve: the images are
rendered, exposed and matched as in a generated dataset, and the depths that come back are measured
as librealsense's depth-quality tool does it.

    {command}

makes this page ({detail}). A band that fails is shown as such.
"""

_HOW = """## How it is measured

- {phases} planes a condition; their disparities are spread over one whole pixel, so that every
  sub-pixel place counts alike. Each lies elsewhere in the image. Both signs of a tilt are pooled.
- **fill**: valid share of the region. **sigma_Z**: standard deviation of depth minus true depth
  over all planes of a condition, without the lowest and highest 0.5 %; it holds the quantiser and
  pixel locking. **bias**: median of the same, also as a disparity.
- **plane fit**: RMS distance to the plane fitted to each image, the lowest and highest 0.5 % of
  depths left out. **sub-pixel RMS**: RMS of f B / Z - f B / Z_plane. Both as in librealsense; one
  image of a plane that faces the camera has one sub-pixel phase, so they hold less than sigma_Z.
- **over time**: median over the pixels of std / median of frames of one still scene.
- **locking**: amplitude of the first harmonic of the mean error over the sub-pixel phase.
- **noise shared**: where the correlation of the disparity's distance from the fitted plane, pooled
  over rows and columns of all planes, has fallen to one half.
- **levels**: distinct depths between the nearest and farthest plane, found / expected.
"""

_DIFFERENCES = """## Known differences from the devices

- The real clouds use the eighths of a pixel unevenly with a period of half a pixel, ours with one
  of a whole pixel. Probably the device matches at the 1280 columns of its sensor; the preset has
  the 640 of its depth image.
- `kinect_v1` searches 88 px, not the 64 of its description, which do not reach from 0.5 m to 8 m.
- The paper's sensor exposes for the object, so a steep or far plane is as bright as a near one;
  contrast falls only relative to ambient light. The D400 presets meter all that is rendered, and
  amplify when the longest exposure is not enough (`sensor.infrared.metering`, `max_exposure`,
  `max_gain`), and the Kinects meter all surfaces. No device meters the part that is cut out.
- In a lit room 5 m away the D415's amplifier raises its noise to the dots, and 6 % of a wall are
  lost as without texture, one more than the band allows; wrong matches among the rest leave 1.2 px
  of sub-pixel RMS where it is 0.16 at 4 m. Of real ones no count was found.
- D400s ask for texture above their noise and lose planes that are nearly edge-on; how many pixels
  real ones keep at 80 and 85 degrees is not published, so those bands are wide and by geometry.
- Kinects and D435 have mixed pixels at three to five times as many steps of a room as real frames,
  so that band fails; the D415 is within it. Of `kinect_v1` it is known what makes them, the blur of
  the lens (`psf_px`): with 0.5 px in place of 0.8 it has 14 % in place of 42 (three rooms). Then
  its depths crowd at whole pixels, as real ones do not.
- `kinect_v1` and `structure_sensor` have laser speckle on their ambient light, too. It is faint
  behind their filter: `ambient_speckles: false` would be right and would move the bytes of R.
- Light goes straight from projector to surface to camera: matt targets, no light from one surface
  on another here (`light=bounced` has that for datasets), no warming up.
"""


def page(
    results: Sequence[SensorResult],
    figures: dict[str, str],
    comparison: Comparison | None,
    plan: Plan,
    command: str,
    detail: str,
) -> str:
    """The whole page as Markdown."""
    verdicts = [v for result in results for v in bands.judge(result)]
    parts = [_INTRO.format(command=command, detail=detail), _verdicts(verdicts)]
    parts.append(_HOW.format(phases=plan.phases))
    parts.append("## Figures\n")
    parts += [f"![{caption}]({name})\n\n{caption}\n" for name, caption in figures.items()]
    parts.append(_distances(results))
    parts.append(_tilts(results))
    parts.append(_edges(results))
    parts.append(_infrared(results))
    parts.append(_rooms(results))
    if comparison is not None:
        parts.append(_real(comparison))
    parts.append(_DIFFERENCES)
    return "\n".join(parts)


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(text_table.markdown([header, *rows])) + "\n"


def _number(value: Any, form: str = ".3f", factor: float = 1.0) -> str:
    return "-" if value is None else format(value * factor, form)


def _verdicts(verdicts: Sequence[bands.Verdict]) -> str:
    failed = [v for v in verdicts if not v.passed]
    text = f"## Bands\n\n{len(verdicts) - len(failed)} of {len(verdicts)} hold.\n\n"
    rows = [
        (v.sensor, v.band, v.measured, "pass" if v.passed else "**FAIL**")
        for v in sorted(verdicts, key=lambda v: (v.sensor, v.passed))
    ]
    return text + _table(("sensor", "band", "measured", ""), rows)


# Header, key of a result, format, factor.
_Column = tuple[str, str, str, float]
_FILL: _Column = ("fill %", "fill", ".1f", 100)
_NOISE: tuple[_Column, ...] = (
    ("sigma_Z mm", "sigma_m", ".2f", 1e3),
    ("bias mm", "bias_m", "+.2f", 1e3),
)
_PLANE: tuple[_Column, ...] = (
    ("plane fit mm", "plane_rms_m", ".2f", 1e3),
    ("sub-pixel RMS px", "subpixel_rms_px", ".3f", 1),
)
_FACING: tuple[_Column, ...] = (
    _FILL,
    *_NOISE,
    ("bias px", "bias_px", "+.4f", 1),
    *_PLANE,
    ("over time 1/1000", "temporal", ".2f", 1e3),
    ("locking px", "locking_px", ".3f", 1),
    ("noise shared px", "correlation_px", ".1f", 1),
)
_LAW: tuple[_Column, ...] = (("own law mm", "law_m", ".2f", 1e3),)
_TILTED: tuple[_Column, ...] = (
    _FILL,
    *_NOISE,
    *_PLANE,
    ("off by > 1 px, %", "outliers", ".2f", 100),
)


def _cells(m: dict[str, Any], columns: Sequence[_Column]) -> list[str]:
    return [_number(m.get(key), form, factor) for _, key, form, factor in columns]


def _heads(columns: Sequence[_Column]) -> list[str]:
    return [column[0] for column in columns]


def _distances(results: Sequence[SensorResult]) -> str:
    rows = []
    for result in results:
        for m in result.facing():
            expected = m.get("levels_expected")
            levels = f"{m['levels']} / {expected}" if expected else "-"
            place = [result.subject.name, f"{m['condition']['depth_m']:g}"]
            rows.append([*place, *_cells(m, _FACING), levels, *_cells(m, _LAW)])
    header = ["sensor", "Z m", *_heads(_FACING), "levels", *_heads(_LAW)]
    return "## Planes that face the camera\n\n" + _table(header, rows)


def _tilts(results: Sequence[SensorResult]) -> str:
    results = [result for result in results if result.tilted(True)]
    rows = [
        [result.subject.name, word, f"{m['condition']['tilt_deg']:g}", *_cells(m, _TILTED)]
        for result in results
        for across, word in ((True, "along"), (False, "across"))
        for m in result.tilted(across)[1:]
    ]
    text = (
        "## Tilted planes\n\nA window of w px on a plane tilted by theta sees a ramp of "
        "w B tan(theta) / Z px of disparity, whichever way the plane recedes; where it reaches "
        "one to two pixels no single shift fits it. At the same time a dot's radiance falls "
        "with cos(theta) and it is foreshortened, so contrast goes too. In degrees, next to "
        "where fill falls below 95 % and the ramp there:\n\n"
    )
    text += _table(_DROP_HEADER, [_drop_row(result) for result in results])
    return text + "\n" + _table(["sensor", "recedes", "tilt", *_heads(_TILTED)], rows)


_DROP_HEADER = (
    "sensor", "Z m", "window px", "1 px ramp", "2 px ramp", "fill < 95 %: along", "across"
)  # fmt: skip


def _drop_row(result: SensorResult) -> list[str]:
    """Where a window should fail on tilted planes, and where fill falls below 95 %."""
    subject, across = result.subject, result.tilted(True)
    window, baseline = subject.window_px, subject.baseline_m
    depth = across[0]["condition"]["depth_m"]
    predicted = ["-", "-"]
    if window and baseline:
        angles = [laws.ramp_angle_deg(window, baseline, depth, ramp) for ramp in (1, 2)]
        predicted = [f"{angle:.0f}" for angle in angles]
    measured = []
    for direction in (True, False):
        angle = bands.drop(result, direction)
        if angle is None:
            measured.append(f"not up to {max(m['condition']['tilt_deg'] for m in across):g}")
        elif window and baseline:
            ramp = laws.ramp_px(window, baseline, depth, angle)
            measured.append(f"{angle:.0f} ({ramp:.1f} px)")
        else:
            measured.append(f"{angle:.0f}")
    wide = "-" if window is None else str(window)
    return [subject.name, f"{depth:g}", wide, *predicted, *measured]


_EDGE_HEADER = (
    "sensor",
    "Z m",
    "camera shadow px: left / right (expected)",
    "projector shadow px",
    "half window px",
    "square reaches beyond px (l / r / t / b)",
    "wall begins px",
    "lateral noise px",
)


def _edges(results: Sequence[SensorResult]) -> str:
    rows = []
    for result in results:
        m, c = result.edge, result.edge["condition"]
        row = [result.subject.name, f"{c['near_m']:g}, {c['far_m']:g}"]
        row += [_shadow(m, who) for who in ("camera", "projector")]
        row.append(_number(m.get("half_window_px"), ".1f"))
        for key, form in (("fattening", "+.0f"), ("wall", ".0f"), ("lateral", ".2f")):
            row.append(" / ".join(_number(m[f"{key}_{side}_px"], form) for side in SIDES))
        rows.append(row)
    text = (
        "## A square before a wall\n\nShadows are measured on who sees and who lights the wall "
        "and expected as f B (1/Zf - 1/Zb), for a projector with its own distance from the "
        "camera; a pixel that is reached in part counts as reached, which makes them 1 px "
        "narrower at most. A blurred edge is not a shadow: there the window holds both surfaces. "
        "The near one, which is brighter, wins at first and what is doubtful is dropped, so the "
        "square reaches out and the wall begins within half a window of the edge where nothing "
        f"is hidden (right, top, bottom). Nguyen's lateral noise is "
        f"{laws.nguyen_lateral_px(0):.1f} px.\n\n"
    )
    return text + _table(_EDGE_HEADER, rows)


def _shadow(m: dict[str, Any], who: str) -> str:
    if f"{who}_left_px" not in m:
        return "-"
    expected = m.get(f"{who}_expected_px")
    wanted = "?" if expected is None else f"{expected:.1f} / 0"
    return f"{m[f'{who}_left_px']:.1f} / {m[f'{who}_right_px']:.1f} ({wanted})"


_INFRARED_COLUMNS: tuple[_Column, ...] = (
    ("contrast, 9 x 9 px", "contrast", ".2f", 1),
    ("dots over ambient", "dots_over_ambient", ".2f", 1),
    ("mean grey", "grey", ".0f", 1),
)


def _infrared(results: Sequence[SensorResult]) -> str:
    """The section beside real images; nothing if no sensor takes any."""
    real, rows = laws.REAL_D415, []
    for result in results:
        if (m := result.infrared) is None:
            continue
        lags = " / ".join(_number(lag, ".2f") for lag in m["autocorrelation"])
        place = [result.subject.name, f"{m['condition']['depth_m']:g}", lags]
        rows.append([*place, *_cells(m, _INFRARED_COLUMNS)])
    if not rows:
        return ""
    ranges = [f"{low:g} to {high:g}" for low, high in real.values()]
    text = (
        "## Infrared images, beside real ones\n\nThe left image of a plane that faces the camera. "
        "Contrast is standard deviation over mean, the median over all windows; correlation is "
        "that of pixels 1, 2 and 3 px apart along a row, without shading; dots over ambient light "
        "is what the projector adds where it is brightest, over the picture without it. Of a "
        f"**real** D415 they are {ranges[2]}, {ranges[3]} (2 px) and {ranges[4]}, over surfaces "
        "from metal to plastic. The preset `realsense_d415` is set by these and by the device's "
        "own depth (sub-pixel RMS of a plane 0.125 px, noise that neighbours share over 7.5 px); "
        "the real pictures are not part of this project. No real picture was held against the "
        "other sensors: `realsense_d435` has the D415's ambient light, read noise, smoothing and, "
        "for 848 columns, its blur; its projector's strength is set by the noise of a real D435 "
        "(Kotsonis).\n\n"
    )
    header = ["sensor", "Z m", "correlation 1 / 2 / 3 px apart", *_heads(_INFRARED_COLUMNS)]
    return text + _table(header, rows)


_ROOM_REASONS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("shadow", ("shadow", "occluded")),
    ("border", ("outside",)),
    ("too dark", ("dark", "saturated")),
    ("no sure match", ("ambiguous", "inconsistent", "unmatched")),
    ("filtered", ("filtered",)),
    ("range", ("range", "empty")),
)


def _rooms(results: Sequence[SensorResult]) -> str:
    """The section on whole frames of rooms; nothing if none was taken."""
    rows = []
    for result in results:
        for m in result.rooms:
            parts = [sum(m["reasons"].get(r, 0.0) for r in each) for _, each in _ROOM_REASONS]
            shares = [f"{100 * share:.1f}" for share in (m["empty"], *parts)]
            steps = [_number(m["mixed"], ".1f", 100), str(m["steps"]), f"{100 * m['flying']:.2f}"]
            rows.append([result.subject.name, m["condition"]["materials"], *shares, *steps])
    if not rows:
        return ""
    text = (
        "## Rooms\n\nWhole frames of a room of 5 by 4 m with furniture of the catalogue, matt or "
        "of mixed materials. The share of the pixels without depth, in percent of those that see a "
        "surface, and why; the steps of more than 10 cm at silhouettes within "
        f"{rooms.NEAR_M:g} m that have a pixel in between, {100 * rooms.APART_M:g} cm or more from "
        "both sides; and the pixels there that are wrong by more than that. In frames of **real** "
        f"rooms by Kinects {laws.REAL_ROOM_EMPTY:.0%} of the pixels have no depth, and "
        f"{laws.REAL_MIXED:.0%} of the steps a mixed pixel (frames that are not part of this "
        "project, steps counted at 2 cm). Not simulated are windows, screens and the border that "
        "the move to the colour camera costs. Nothing is dropped at random.\n\n"
    )
    header = ["sensor", "materials", "no depth %", *(word for word, _ in _ROOM_REASONS)]
    return text + _table([*header, "mixed %", "of steps", "wrong %"], rows)


_REAL_ROWS: tuple[tuple[str, str, Callable[[Any], str]], ...] = (
    ("levels", "distinct depths beyond 0.8 m", lambda v: f"{v:.0f}"),
    ("step_focal_baseline", "f B that fits 1/8 px steps (px m)", lambda v: f"{v:.2f}"),
    ("step_residual", "distance from that grid (steps; none: 0.29)", lambda v: f"{v:.3f}"),
    ("level_use", "uneven use of the eighths of a pixel (0: even)", lambda v: f"{v:.2f}"),
    ("table_rms_m", "plane fit on the table (mm)", lambda v: f"{1e3 * v:.2f}"),
    ("table_subpixel_px", "sub-pixel RMS on the table (px)", lambda v: f"{v:.3f}"),
    ("holes", "share of holes (%)", lambda v: f"{100 * v:.2f}"),
    ("run_median_px", "length of a hole along a row, median (px)", lambda v: f"{v:.1f}"),
    ("run_90_px", "the same, 90 % quantile (px)", lambda v: f"{v:.1f}"),
    ("left_share", "shadow left of the nearer surface (%)", lambda v: f"{100 * v:.0f}"),
    ("mixed", "steps of over 10 cm with a pixel between (%)", lambda v: f"{100 * v:.1f}"),
)


def _real(comparison: Comparison) -> str:
    rows = []
    for key, words, form in _REAL_ROWS:
        cells = [words]
        for found in (comparison.real, comparison.simulated):
            low, mid, high = comparison.spread(found, key)
            cells.append(f"{form(mid)} ({form(low)} to {form(high)})")
        rows.append(cells)
    text = (
        "## Next to real clouds\n\n"
        f"{len(comparison.real)} **real** clouds of a Kinect v1 (boxes and cups on a table, BSD-3; "
        "moved to the colour camera and cut to the table by those who made them) and "
        f"{len(comparison.simulated)} **simulated** ones by `{comparison.sensor}`: a table, boxes "
        "and cylinders at the same distances and pitch, other shapes and places, moved and cut "
        "the same way. Median, and range over the clouds.\n\n"
    )
    text += _table(("", "REAL Kinect v1", f"SIMULATED {comparison.sensor}"), rows)
    real, ours = (
        f"{sum(d['mixed_steps'] for d in found):,} of {sum(d['steps'] for d in found):,}"
        for found in (comparison.real, comparison.simulated)
    )
    text += f"\nSteps with a mixed pixel, all clouds together: real {real}, simulated {ours}.\n"
    return text + f"\n![real and simulated]({comparison.figure})\n"


_CSV_KEYS = (
    "pixels", "fill", "sigma_m", "bias_m", "accuracy", "plane_rms_m", "subpixel_rms_px", "sigma_px",
    "bias_px", "outliers", "temporal", "locking_px", "correlation_px", "levels", "levels_expected",
    "law_m",
)  # fmt: skip


def csv_text(results: Sequence[SensorResult]) -> str:
    """All numbers of the plane bench, one row a condition."""
    rows: list[list[Any]] = [["sensor", "depth_m", "tilt_deg", "recedes", *_CSV_KEYS]]
    for result in results:
        for m in result.planes:
            c = m["condition"]
            word = "" if c["tilt_deg"] == 0 else ("along" if c["across"] else "across")
            values = [m.get(key) for key in _CSV_KEYS]
            numbers = [f"{v:.6g}" if isinstance(v, float) else v for v in values]
            rows.append([result.subject.name, c["depth_m"], c["tilt_deg"], word, *numbers])
    return text_table.csv_text(rows)
