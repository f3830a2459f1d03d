"""`python -m qs3.sensors.fit`: a preset for one's own depth camera."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from qs3.config.location import CONF
from qs3.errors import ConfigError, Qs3Error
from qs3.geometry.cameras import Intrinsics
from qs3.sensors.fit.frames import read_frame, read_pinhole
from qs3.sensors.fit.laws import find_bias, find_fill, find_noise
from qs3.sensors.fit.planes import find_wall
from qs3.sensors.fit.preset import FittedPreset
from qs3.sensors.fit.steps import find_steps

HELP = """Measure a depth camera on a flat wall, and write a preset for generate.py.

Take three or more depth frames of a flat, matt wall: from distances that differ (say 1, 1.5, 2 and
3 m), turned by a few degrees so that several steps of depth are seen; and some at a slant (20 to
70 degrees) for the fill rate. Other things may be in view; the plane that covers most is the wall.

    python -m qs3.sensors.fit frames/*.png --intrinsics 580,580,319.5,239.5 --baseline 0.075 \\
        --out conf/sensor/my_camera.yaml --plot my_camera.png
    python generate.py domain=specklenet10 renderer=mitsuba sensor=my_camera

What is found: noise against distance (before the quantiser; growing with Z^2 as for cameras that
triangulate, or with Z, whichever fits better), its smoothness, steps of 1/Z or of Z, fill rate
against the angle of incidence, and, with --distances, the bias. A preset adds these to the true
depth; see qs3.sensors.devices.fitted.FittedDepth. The plot shows data and model: look at it."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Fit; 0 if a preset was written."""
    parser = argparse.ArgumentParser(
        prog="python -m qs3.sensors.fit",
        description=HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("frames", nargs="+", type=Path, help=".png (16 bits), .npy [h, w] or .pcd")
    parser.add_argument("--intrinsics", help="fx,fy,cx,cy in px, or a JSON file with these keys")
    parser.add_argument("--focal", type=float, help="px; the principal point is the middle")
    parser.add_argument("--unit", help="m, mm, or units a metre (default: judged by the values)")
    parser.add_argument("--distances", help="true distances of the wall in the middle of each "
                        "frame in metres, e.g. 1.0,1.5,2.0: for the bias")  # fmt: skip
    parser.add_argument("--baseline", type=float, help="metres from camera to projector along x "
                        "(negative: to the left), for shadows")  # fmt: skip
    parser.add_argument("--power", type=float, choices=(1.0, 2.0), help="fix the law of the noise")
    parser.add_argument("--out", type=Path, required=True, help="the preset, conf/sensor/NAME.yaml")
    parser.add_argument("--plot", type=Path, help="PNG (default: beside the preset)")
    given = parser.parse_args(arguments)
    try:
        preset = fit(given)
        words = sys.argv[1:] if arguments is None else list(arguments)
        preset.save(given.out, "python -m qs3.sensors.fit " + shlex.join(words))
        picture = given.plot or given.out.with_suffix(".png")
        preset.plot(picture)
    except Qs3Error as error:
        sys.stderr.write(f"{type(error).__name__}: {error}\n")
        return 2
    for line in preset.summary():
        sys.stdout.write(line + "\n")
    sys.stdout.write(f"wrote {given.out} and {picture}\n")
    if given.out.resolve().parent == (CONF / "sensor"):
        sys.stdout.write(f"use it: python generate.py sensor={given.out.stem} renderer=mitsuba\n")
    else:
        sys.stdout.write(
            "to use it, put it into conf/sensor, or name the folder that holds sensor/"
            f"{given.out.name}: generate.py 'hydra.searchpath=[file:///FOLDER]' "
            f"sensor={given.out.stem}\n"
        )
    return 0


def fit(given: argparse.Namespace) -> FittedPreset:
    """All steps, from files to the preset.

    Raises:
        ConfigError, DataError: say which argument or file is to blame.
    """
    frames = [read_frame(path, given.unit) for path in given.frames]
    for frame in frames:
        sys.stdout.write(f"{frame.name}: {frame.unit}\n")
    shapes = {frame.depth_m.shape for frame in frames}
    if len(shapes) > 1:
        raise ConfigError(f"frames of one camera have one size, these have {sorted(shapes)}")
    height, width = frames[0].depth_m.shape
    camera = _camera(given, width, height)
    distances = None
    if given.distances is not None:
        try:
            distances = [float(part) for part in given.distances.split(",")]
        except ValueError:
            raise ConfigError(f"--distances: expected numbers, got {given.distances}") from None
        if len(distances) != len(frames):
            raise ConfigError(f"--distances has {len(distances)} values for {len(frames)} frames")
    steps = find_steps(frames)
    walls = [find_wall(frame.name, frame.depth_m, camera) for frame in frames]
    noise = find_noise(walls, steps, given.power)
    return FittedPreset(
        camera, noise, steps, find_fill(walls), find_bias(walls, distances), given.baseline, walls
    )


def _camera(given: argparse.Namespace, width: int, height: int) -> Intrinsics:
    if given.intrinsics is None:
        if given.focal is None:
            raise ConfigError("give the camera: --intrinsics fx,fy,cx,cy, or --focal PIXELS")
        return Intrinsics.centred(width, height, given.focal)
    found = read_pinhole(given.intrinsics)
    if not 0.95 < found.fx_px / found.fy_px < 1.05:
        raise ConfigError(
            f"--intrinsics: fx {found.fx_px} and fy {found.fy_px} differ; pixels must be square"
        )
    focal = (found.fx_px + found.fy_px) / 2
    return Intrinsics(width, height, focal, found.cx_px, found.cy_px)


if __name__ == "__main__":
    sys.exit(main())
