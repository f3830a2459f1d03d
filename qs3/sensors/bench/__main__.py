"""Put depth sensors on the bench.

    python -m qs3.sensors.bench [sensor=NAME ...] [--quick] [out=out/bench] [samples=16]
                                [sensor.KEY=VALUE ...]

Measures planes, an edge and, for kinect_v1, a table beside real clouds; writes a page
(index.md), its figures and all numbers (planes.csv) to `out`. Every finished condition is kept in
`out`/cache: call it again after an interruption. Without sensor= the presets are measured.
"""

from __future__ import annotations

import argparse
import logging
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from qs3.errors import ConfigError, MissingDataError, Qs3Error


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit status.

    0 if all bands hold, 1 if one fails, 2 for an error.
    """
    parser = argparse.ArgumentParser(
        prog="python -m qs3.sensors.bench",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("words", nargs="*", metavar="key=value", help="see above")
    parser.add_argument("--quick", action="store_true", help="few conditions: seconds a sensor")
    arguments = parser.parse_intermixed_args(argv)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        return _bench(arguments.words, arguments.quick)
    except Qs3Error as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 2


class _Progress:
    """A line on stderr every few seconds."""

    def __init__(self, total: int) -> None:
        self.total, self.done, self.said = total, 0, time.monotonic()

    def __call__(self) -> None:
        """One step more."""
        self.done += 1
        if time.monotonic() - self.said > 5 or self.done == self.total:
            self.said = time.monotonic()
            print(f"bench: {self.done} of {self.total} conditions", file=sys.stderr)


def _bench(words: Sequence[str], quick: bool) -> int:
    names, overrides, out, samples = [], [], Path("out/bench"), 16
    for word in words:
        key, equals, value = word.partition("=")
        if not equals:
            raise ConfigError(f"unknown argument {word!r}: write key=value, e.g. sensor=kinect_v1")
        if key == "sensor":
            names += value.split(",")
        elif key.startswith("sensor."):
            overrides.append(word)
        elif key == "out":
            out = Path(value)
        elif key == "samples" and value.isdigit():
            samples = int(value)
        else:
            raise ConfigError(
                f"unknown argument {word!r}; known are sensor, sensor.*, out, samples"
            )

    # Only now: `--help` needs none of it.
    from qs3.sensors.bench import bands, comparison, figures, page, runner
    from qs3.sensors.renderers.mitsuba import MitsubaRenderer
    from qs3.utils.files import make_folder, write_json, write_text

    plan = runner.Plan.quick() if quick else runner.Plan()
    subjects = [runner.load(name, overrides) for name in names or runner.DEFAULT_SENSORS]
    make_folder(out)
    write_text(out / "cache" / ".gitignore", "*\n")  # a page may be committed, its cache not
    renderer = MitsubaRenderer(samples=samples)
    total = sum(len(plan.conditions(subject)) for subject, _ in subjects)
    results = []
    advance = _Progress(total)
    for subject, config in subjects:
        results.append(runner.run(subject, config, renderer, out / "cache", plan, advance))
    captions = figures.draw_all(results, out)
    beside = None
    for subject, config in subjects:
        if subject.name != "kinect_v1":
            continue
        try:
            figure = out / comparison.FIGURE
            beside = comparison.compare(subject, config, renderer, out / "cache", figure)
        except MissingDataError as error:
            print(error, file=sys.stderr)
    said = ["python -m qs3.sensors.bench", *words, *(["--quick"] if quick else [])]
    shown = [word for word in said if not word.startswith("out=")]
    detail = ", ".join(f"{k} {v}" for k, v in renderer.provenance().items())
    text = page.page(results, captions, beside, plan, " ".join(shown), detail)
    write_text(out / "index.md", text)
    write_text(out / "planes.csv", page.csv_text(results))
    write_json(out / "settings.json", {subject.name: config for subject, config in subjects})
    failed = [v for result in results for v in bands.judge(result) if not v.passed]
    for verdict in failed:
        print(f"FAIL {verdict.sensor}: {verdict.band}: {verdict.measured}")
    print(f"saved {out / 'index.md'}, planes.csv, settings.json and {len(captions)} figures")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
