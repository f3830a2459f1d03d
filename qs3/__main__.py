"""All commands beside training and generation: `qs3 --help`, or `python -m qs3 --help`."""

import logging
import sys

from qs3.utils.cli import Group, run

QS3 = Group(
    "qs3",
    "from CAD meshes to a classifier that works on real depth scans",
    {
        "quickstart": "qs3.tools.quickstart:QUICKSTART",
        "doctor": "qs3.tools.doctor:DOCTOR",
        "plan": "qs3.tools.large_jobs:PLAN",
        "download": "qs3.data.download.cli:DOWNLOAD",
        "inspect": "qs3.data.inspection.cli:INSPECT",
        "compare": "qs3.data.inspection.cli:COMPARE",
        "view": "qs3.report.view.cli:VIEW",
        "scannet": "qs3.data.scannet.cli:SCANNET",
        "predict": "qs3.inference.cli:PREDICT",
        "export": "qs3.inference.cli:EXPORT",
        "report": "qs3.report.cli:REPORT",
        "leaderboard": "qs3.report.leaderboard.cli:LEADERBOARD",
        "bench": "qs3.sensors.bench.cli:BENCH",
        "fit": "qs3.sensors.fit.cli:FIT",
        "tune": "qs3.tuning.cli:TUNE",
    },
    (
        "qs3 quickstart",
        "qs3 predict input=scans",
        "qs3 report table=uda",
        "qs3 COMMAND --help",
    ),
    about="Datasets are made by qs3-generate and classifiers trained by qs3-train (in a checkout "
    "also\npython generate.py and python train.py); both have --help.",
)


def main() -> int:
    """The command of this process; returns the exit status."""
    logging.basicConfig(format="%(message)s")
    logging.getLogger("qs3").setLevel(logging.INFO)
    return run(QS3, sys.argv[1:])


if __name__ == "__main__":
    sys.exit(main())
