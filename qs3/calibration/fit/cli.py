"""`qs3 fit`: a preset for one's own depth camera."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qs3.config.location import CONF, typed
from qs3.errors import ConfigError
from qs3.utils.cli import FLAG, NUMBER, Command, Option, one_of, several, text
from qs3.utils.plural import counted

if TYPE_CHECKING:
    from qs3.calibration.fit.frames import DepthImage
    from qs3.calibration.fit.preset import FittedPreset

_LEAST_DISTANCES = 3  # of walls: two tell no law from chance
_APART = 1.05  # times as far is another distance
_MOST_BIAS = 0.3  # of a distance: a larger one is of other units or another frame
_OF_FRAMES = ("intrinsics", "focal", "distances", "baseline", "power", "few")
_LONGEST_M = 2.0  # baseline of a depth camera: a longer one is in another unit


def _fit(
    words: Sequence[str],
    line: str,
    out: str,
    plot: str | None,
    images: str | None,
    base: str | None,
    distance: float | None,
    gain: float | None,
    **given: Any,
) -> None:
    if Path(out).suffix != ".yaml":
        raise ConfigError(f"out={out} must end in .yaml: it is a sensor preset")
    if images is not None:
        if words or plot is not None:
            raise ConfigError("images= fits a stereo preset: leave frames and plot= out")
        if of_frames := [key for key in _OF_FRAMES if given[key] not in (None, False)]:
            keys = " and ".join(f"{key}=" for key in of_frames)
            raise ConfigError(
                f"{keys} would have no effect beside images=: of frames of a wall; the camera is "
                "that of base="
            )
        file, unit = Path(out).expanduser(), given["unit"]
        fit_images(Path(images), base, distance, unit, file, line, 1.0 if gain is None else gain)
        return
    if (base, distance, gain) != (None, None, None):
        raise ConfigError("base=, distance= and gain= belong to images=FOLDER")
    file = Path(out).expanduser()
    picture = Path(plot).expanduser() if plot else file.with_suffix(".png")
    _check_picture(picture, words)
    preset = fit(words, **given)
    preset.save(file, line)
    preset.plot(picture)
    for said in preset.summary():
        print(said)
    print(f"wrote {file} and {picture}")
    generate = typed("python generate.py")
    if file.resolve().parent == CONF / "sensor":
        print(f"use it: {generate} sensor={file.stem} renderer=mitsuba")
    else:
        print(
            "to use it, put it into conf/sensor, or name the folder that holds sensor/"
            f"{file.name}: {generate} 'hydra.searchpath=[file:///FOLDER]' sensor={file.stem}"
        )


def _check_picture(picture: Path, frames: Sequence[str]) -> None:
    """Raise ConfigError if the plot is no .png, or would replace a frame that it is fitted to."""
    if picture.suffix.lower() != ".png":
        raise ConfigError(f"plot={picture} must end in .png")
    for frame in frames:
        if os.path.exists(picture) and os.path.exists(frame) and os.path.samefile(picture, frame):
            raise ConfigError(
                f"the plot would replace {frame}, which is a frame: give plot=FILE another name"
            )


def fit(
    files: Sequence[str],
    intrinsics: str | None,
    focal: float | None,
    unit: str | None,
    distances: Sequence[float] | None,
    baseline: float | None,
    power: str | None,
    few: bool = False,
) -> FittedPreset:
    """All steps, from files to the preset; `few` allows less than three distances.

    Raises:
        ConfigError, DataError: say which argument or file is to blame.
    """
    from qs3.calibration.fit.bias import find_bias
    from qs3.calibration.fit.doubts import check_walls
    from qs3.calibration.fit.fill import find_fill
    from qs3.calibration.fit.frames import check_field, off_centre, read_camera, read_frame
    from qs3.calibration.fit.noise import find_noise
    from qs3.calibration.fit.planes import find_wall
    from qs3.calibration.fit.preset import FittedPreset
    from qs3.calibration.fit.steps import find_steps
    from qs3.geometry.cameras import Intrinsics

    if intrinsics is not None and focal is not None:
        raise ConfigError("intrinsics= has the focal length: leave focal= out, or intrinsics=")
    if not files:
        raise ConfigError("of which frames? Name their files: qs3 fit frames/*.png ...")
    frames = [read_frame(Path(path), unit) for path in files]
    for frame in frames:
        print(f"{frame.name}: {frame.unit}")
    shapes = {frame.depth_m.shape for frame in frames}
    if len(shapes) > 1:
        raise ConfigError(f"frames of one camera have one size, these have {sorted(shapes)}")
    height, width = frames[0].depth_m.shape
    if intrinsics is not None:
        camera = read_camera(intrinsics, width, height)
    elif focal is not None:
        camera = Intrinsics.centred(width, height, focal)
    else:
        raise ConfigError("give the camera: intrinsics=fx,fy,cx,cy, or focal=PIXELS")
    check_field(camera)
    if unsure := off_centre(camera):
        print(unsure)
    if baseline is not None and not 0 < abs(baseline) < _LONGEST_M:
        hint = f"; if these are millimetres, give {baseline / 1000:g}"
        raise ConfigError(
            f"baseline={baseline:g}: metres from camera to projector, such as 0.075"
            + hint * (abs(baseline) >= _LONGEST_M)
        )
    if distances is not None and len(distances) != len(frames):
        values, of = counted(len(distances), "value"), counted(len(frames), "frame")
        raise ConfigError(f"distances= has {values} for {of}")
    kept = [i for i, frame in enumerate(frames) if not _copied(frame, frames[:i])]
    frames = [frames[i] for i in kept]
    distances = None if distances is None else [distances[i] for i in kept]
    steps = find_steps(frames)
    walls = [find_wall(frame.name, frame.depth_m, camera) for frame in frames]
    for wall, given in zip(walls, distances or [], strict=False):
        if not abs(given - wall.centre_m) < _MOST_BIAS * wall.centre_m:
            raise ConfigError(
                f"distances= says {given:g} m for {wall.name}, where the camera sees the wall "
                f"{wall.centre_m:.2f} m away: give metres, in the order of the frames, along the "
                "optical axis"
            )
    noise = find_noise(walls, steps, float(power) if power else None)
    doubts = check_walls(walls, noise, steps)
    if not few:
        _check_distances([wall.centre_m for wall in walls])
    return FittedPreset(
        camera, noise, steps, find_fill(walls), find_bias(walls, distances), baseline, walls, doubts
    )


def _copied(frame: DepthImage, before: Sequence[DepthImage]) -> bool:
    """Whether an earlier frame has the same depths; says so."""
    import numpy as np

    for other in before:
        if np.array_equal(frame.depth_m, other.depth_m, equal_nan=True):
            print(f"{frame.name}: the same depths as {other.name}, so they count once")
            return True
    return False


def _check_distances(centres_m: Sequence[float]) -> None:
    """Raise ConfigError if the walls are at too few distances to tell how noise grows."""
    apart: list[float] = []
    for centre in sorted(centres_m):
        if not apart or centre > apart[-1] * _APART:
            apart.append(centre)
    if len(apart) < _LEAST_DISTANCES:
        seen = ", ".join(f"{centre:.2f}" for centre in apart)
        raise ConfigError(
            f"the frames show walls at {counted(len(apart), 'distance')} ({seen} m), and how noise "
            f"grows takes {_LEAST_DISTANCES} that differ by {100 * (_APART - 1):.0f} % or more: "
            "add frames from others (say 1, 1.5, 2 and 3 m), or fit what there is with few=true"
        )


def fit_images(
    folder: Path,
    base: str | None,
    distance_m: float | None,
    unit: str | None,
    out: Path,
    line: str,
    gain: float = 1.0,
) -> None:
    """Fit a stereo preset's light, lens and noise to infrared pictures, and write it.

    Raises:
        ConfigError, DataError: say which argument or file is to blame.
    """
    from qs3.calibration.fit.infrared import fit_pictures
    from qs3.calibration.fit.pair_fill import pair_fills, words_of
    from qs3.calibration.fit.pictures import read_pictures
    from qs3.calibration.fit.stereo_preset import report, save
    from qs3.config.compose import choices, composed
    from qs3.config.hydra import build
    from qs3.config.preset_base import check_no_base
    from qs3.sensors.devices.speckle_stereo import SpeckleStereo

    name = base or "realsense_d415"
    known = [choice for choice in choices("sensor") if choice != "none"]
    if name not in known:
        raise ConfigError(f"base={name} is unknown; there are {', '.join(known)}")
    check_no_base(out, "sensor", name)
    sensor = build(composed(None, f"+sensor={name}").sensor)
    if not isinstance(sensor, SpeckleStereo):
        raise ConfigError(f"base={name} is no active stereo camera with two infrared pictures")
    scenes = read_pictures(folder, unit)
    found = fit_pictures(scenes, sensor, distance_m, gain)
    for said in report(found, sensor, len(scenes)):
        print(said)
    for pair in pair_fills(scenes, sensor, found.noise):
        print(words_of(pair, name))
    save(out, found, name, sensor, line)
    print(f"wrote {out}")


FIT = Command(
    "qs3 fit",
    "a preset for your own depth camera, from frames of a wall or infrared pictures",
    _fit,
    (
        Option("out", text("FILE"), "the preset, conf/sensor/NAME.yaml", required=True),
        Option("plot", text("FILE"), ".png (default: next to the preset)"),
        Option(
            "intrinsics",
            text("fx,fy,cx,cy"),
            "in px, or a .json or .yaml as ROS, librealsense or Open3D write it",
        ),
        Option(
            "focal",
            NUMBER,
            "focal length in px, in place of intrinsics=; the principal point is the middle",
        ),
        Option("unit", text("UNIT"), "m, mm, or units a metre (default: judged by the values)"),
        Option("distances", several(NUMBER), "true ones of each frame's middle, m: for the bias"),
        Option(
            "baseline",
            NUMBER,
            "m from camera to projector along x, negative to the left: for the shadows",
        ),
        Option(
            "power",
            one_of("1", "2"),
            "noise grows with Z to this power (default: whichever fits better)",
        ),
        Option("few", FLAG, "fit frames from fewer than three distances, too", False),
        Option("images", text("FOLDER"), "of infrared pictures, in place of frames"),
        Option("base", text("NAME"), "stereo preset to begin with (default realsense_d415)"),
        Option("distance", NUMBER, "m to the scenes, where they have no depth image"),
        Option(
            "gain",
            NUMBER,
            "of the camera's amplifier in all pictures, times (default 1; a RealSense's setting "
            "over 16)",
        ),
    ),
    (
        "qs3 fit frames/*.png intrinsics=580,580,319.5,239.5 baseline=0.075 \\",
        "    out=conf/sensor/my_camera.yaml plot=my_camera.png",
        "qs3 fit images=pictures base=realsense_d415 out=conf/sensor/my_stereo.yaml",
        "qs3-generate domain=specklenet10 renderer=mitsuba sensor=my_camera",
    ),
    about="""
FRAMES are .png (16 bits), .npy [h, w] or .pcd: three or more of a flat, matt wall, from distances
that differ (say 1, 1.5, 2 and 3 m), turned by a few degrees so that several steps of depth are
seen; and some at a slant (20 to 70 degrees) for the fill rate. Other things may be in view; the
plane that covers most is the wall. Fewer distances take few=true. Frames whose errors do not look
like a camera's noise on a wall are refused or, where that is not sure, named.

What is found: noise against distance (before the quantiser; growing with Z^2 as for cameras that
triangulate, or with Z, whichever fits better), its smoothness, steps of 1/Z or of Z, fill rate
against the angle of incidence, and, with distances=, the bias. A preset adds these to the true
depth; see qs3.sensors.devices.fitted.FittedDepth. The plot shows data and model: look at it.

images=FOLDER holds rectified pictures of an active stereo camera: SCENE_left.png, and where there
are any SCENE_right.png, SCENE_off.png (projector off, the same exposure) and SCENE_depth.png (the
left camera's). Several frames of a still scene, SCENE_left_0.png and so on (64 at most), tell noise
from texture. Found, with their errors: ambient light, blur, exposure, noise and speckle; with right
pictures and a depth image, f B. Electrons at white are those without an amplifier; one that raised
the pictures has to be said, gain=, for noise does not tell it from fewer electrons. Read-out noise
is that at this gain. What the pictures do not tell is said, and left as it is in base=. Of each
pair it is said how much of it the matcher of base= fills, and why the rest is lost.
""",
    words="FRAMES",
    line=True,
    interrupted="nothing was saved",
)
