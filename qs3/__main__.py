"""All commands except training and generation: `qs3 --help`, or `python -m qs3 --help`."""

import logging
import sys

from qs3.utils.commands import Commands, run

ABOUT = """from CAD meshes to a classifier that works on real depth scans

Datasets are made by qs3-generate and classifiers trained by qs3-train (in a checkout also
python generate.py and python train.py); both have --help."""

COMMANDS: Commands = {
    "quickstart": "qs3.commands.quickstart:quickstart",
    "doctor": "qs3.commands.doctor:doctor",
    "download": "qs3.commands.download:download",
    "inspect": "qs3.commands.inspect:inspect",
    "compare": "qs3.commands.inspect:compare",
    "view": "qs3.commands.inspect:view",
    "scannet": "qs3.commands.download:scannet",
    "predict": "qs3.commands.predict:predict",
    "export": "qs3.commands.predict:export",
    "report": {
        "": "qs3.commands.report:table",
        "table": "qs3.commands.report:table",
        "train": "qs3.commands.report:train",
        "keep": "qs3.commands.report:keep",
        "compare": "qs3.commands.report:compare",
        "judge": "qs3.commands.report:judge",
        "page": "qs3.commands.report:page",
        "pipeline": "qs3.commands.report:pipeline",
    },
    "leaderboard": "qs3.commands.report:leaderboard",
    "bench": "qs3.commands.sensors:bench",
    "fit": "qs3.commands.sensors:fit",
    "sense": "qs3.commands.sense:sense",
    "match": "qs3.commands.sense:match",
}


def main() -> int:
    """Run the command of this process; returns the exit status."""
    logging.basicConfig(format="%(message)s")
    logging.getLogger("qs3").setLevel(logging.INFO)
    return run(COMMANDS, sys.argv[1:], about=ABOUT)


if __name__ == "__main__":
    sys.exit(main())
