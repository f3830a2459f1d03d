"""`qs3 bench` and `qs3 fit`: depth sensors before known targets, and a preset for one's own."""

from pathlib import Path
from typing import Annotated

from annotated_types import Ge, Gt


def bench(
    *,
    sensor: Annotated[tuple[str, ...], "of conf/sensor; all presets by default"] = (),
    quick: Annotated[bool, "few conditions: seconds a sensor"] = False,
    samples: Annotated[int, Ge(1), "rays a pixel of the renderer"] = 16,
    out: Annotated[Path, "folder of the page and its numbers"] = Path("out/bench"),
    **overrides: Annotated[str, "settings of all sensors (sensor.KEY), or hydra.searchpath"],
) -> int:
    """Measure depth sensors before known targets: are their errors those of the device?

    Renders planes and an edge, and writes a page (sensors.md) and all numbers (planes.csv,
    edges.csv, bands.csv). The exit status is 1 if a band does not hold.

    Example:
        qs3 bench sensor=kinect_v1,realsense_d435 quick=true
        qs3 bench sensor=kinect_v1 sensor.infrared.read_noise_e=20
    """
    from qs3.calibration.bench import run

    words = [f"{key}={value}" for key, value in overrides.items()]
    failed = [band for band in run(sensor, words, quick, samples, out) if not band.holds]
    for band in failed:
        print(f"FAIL {band.sensor}: {band.band}: {band.value:.3g} ({band.low:g} to {band.high:g})")
    print(f"saved {out / 'sensors.md'}, planes.csv, edges.csv and bands.csv")
    return 1 if failed else 0


def fit(
    *frames: Annotated[str, "depth images of a wall, .png of 16 bits or .npy"],
    out: Annotated[Path, "the preset, conf/sensor/NAME.yaml"],
    intrinsics: Annotated[str | None, "fx,fy,cx,cy in px, or a file that has them"] = None,
    focal: Annotated[float | None, Gt(0), "px, in place of intrinsics=; centred"] = None,
    unit: Annotated[str | None, "m, mm or units a metre (default: mm of whole numbers)"] = None,
    distances: Annotated[tuple[float, ...], "true ones of each frame's middle, m: the bias"] = (),
    baseline: Annotated[
        float | None, "m from camera to projector, negative to the left: for the shadows"
    ] = None,
) -> None:
    """Write a preset for your own depth camera, from images of a flat wall.

    FRAMES show a flat, matt wall from three or more distances (say 1, 1.5, 2 and 3 m), turned by a
    few degrees so that several steps of depth are seen. The plane that covers most is the wall.
    The law of the noise, the steps of 1/Z or of Z, the share of valid pixels and, with distances=,
    the bias are fitted; generation adds them to the true depth.

    Example:
        qs3 fit frames/*.png intrinsics=580,580,319.5,239.5 out=conf/sensor/my_camera.yaml
    """
    from qs3.calibration.fit import fit_walls, plot_noise
    from qs3.utils.files import write_text

    files = [Path(frame) for frame in frames]
    text, noise = fit_walls(files, intrinsics, focal, unit, distances, baseline)
    plot_noise(noise, out.with_suffix(".png"))
    write_text(out, text)
    print(f"{text}\nwrote {out}")
