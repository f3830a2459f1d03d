"""`qs3 bench`: depth sensors before known targets."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from qs3.utils.cli import FLAG, Command, Option, several, text, whole


def _bench(
    sensor: Sequence[str],
    quick: bool,
    samples: int,
    out: str,
    real: str | None,
    more: Sequence[str],
    line: str,
) -> int:
    from qs3.calibration.bench import bands, comparison, figures, page, runner
    from qs3.sensors.renderers.mitsuba import MitsubaRenderer
    from qs3.utils.files import make_folder, write_json, write_text
    from qs3.utils.progress import progress_bar

    if real is not None:
        comparison.real_clouds(Path(real))  # said before hours of measuring
    plan = runner.Plan.quick() if quick else runner.Plan()
    subjects = [runner.load(name, more) for name in sensor or runner.DEFAULT_SENSORS]
    folder = make_folder(out)
    cache = folder / "cache"
    write_text(cache / ".gitignore", "*\n")  # a page may be committed, its cache not
    renderer = MitsubaRenderer(samples=samples)
    total = sum(len(plan.conditions(subject)) for subject, _ in subjects)
    with progress_bar("conditions", total=total) as advance:
        results = [runner.run(*subject, renderer, cache, plan, advance) for subject in subjects]
    captions = figures.draw_all(results, folder)
    compared = None
    for subject, config in subjects:
        if real is not None and subject.name == "kinect_v1":
            figure = folder / comparison.FIGURE
            compared = comparison.compare(subject, config, renderer, cache, figure, Path(real))
    typed = [word for word in shlex.split(line) if not word.startswith(("out=", "real="))]
    detail = ", ".join(f"{k} {v}" for k, v in renderer.provenance().items())
    said = page.page(results, captions, compared, plan, shlex.join(typed), detail)
    write_text(folder / "index.md", said)
    write_text(folder / "planes.csv", page.csv_text(results))
    write_json(folder / "settings.json", {subject.name: config for subject, config in subjects})
    failed = [v for result in results for v in bands.judge(result) if not v.passed]
    for verdict in failed:
        print(f"FAIL {verdict.sensor}: {verdict.band}: {verdict.measured}")
    print(f"saved {folder / 'index.md'}, planes.csv, settings.json and {len(captions)} figures")
    return 1 if failed else 0


BENCH = Command(
    "qs3 bench",
    "depth sensors before known targets: are their errors those of the device?",
    _bench,
    (
        Option("sensor", several(text("NAME")), "of conf/sensor; all presets by default", ()),
        Option("quick", FLAG, "few conditions: seconds a sensor", False),
        Option("samples", whole(), "rays a pixel of the renderer", 16),
        Option("out", text("FOLDER"), "of the page, its figures and all numbers", "out/bench"),
        Option("real", text("FOLDER"), "clouds of a real Kinect (.pcd), beside kinect_v1"),
    ),
    (
        "qs3 bench",
        "qs3 bench sensor=kinect_v1,realsense_d435 quick=true",
        "qs3 bench sensor=kinect_v1 sensor.infrared.read_noise_e=20",
    ),
    about="""
Measures planes, an edge and whole frames of rooms, and writes a page (index.md), its figures and
all numbers of the planes (planes.csv). The exit status is 1 if a band does not hold. Every finished
condition is kept in OUT/cache.
""",
    others={
        "sensor.": "settings of all of them",
        "hydra.": "as 'hydra.searchpath=[file:///FOLDER]': presets of yours in FOLDER/sensor, too",
    },
    line=True,
)
