"""`qs3 bench`: depth sensors before known targets."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from annotated_types import Ge


def bench(
    *,
    sensor: Annotated[tuple[str, ...], "of conf/sensor; all presets by default"] = (),
    quick: Annotated[bool, "few conditions: seconds a sensor"] = False,
    samples: Annotated[int, Ge(1), "rays a pixel of the renderer"] = 16,
    out: Annotated[Path, "folder of the page and its numbers"] = Path("out/bench"),
    **overrides: Annotated[str, "settings of all sensors (sensor.KEY), or hydra.searchpath"],
) -> int:
    """Measure depth sensors before known targets: are their errors those of the device?

    Renders planes and an edge, and writes a page (index.md) and all numbers (planes.csv, edges.csv,
    bands.csv). The exit status is 1 if a band does not hold.

    Example:
        qs3 bench sensor=kinect_v1,realsense_d435 quick=true
        qs3 bench sensor=kinect_v1 sensor.infrared.read_noise_e=20
    """
    from qs3.calibration.bench import run

    words = [f"{key}={value}" for key, value in overrides.items()]
    failed = [band for band in run(sensor, words, quick, samples, out) if not band.holds]
    for band in failed:
        print(f"FAIL {band.sensor}: {band.band}: {band.value:.3g} ({band.low:g} to {band.high:g})")
    print(f"saved {out / 'index.md'}, planes.csv, edges.csv and bands.csv")
    return 1 if failed else 0
