"""The main job on embedded data, one command after the other: `make quickstart`.

Prints every command that it runs, so that they can be run and changed one by one. Sizes are
chosen to fit into 20 minutes on 2 cores; the paper's are in conf/experiment/qs3_s2d.yaml.
"""

from __future__ import annotations

import argparse
import os
import resource
import shlex
import subprocess
import sys
import time
from pathlib import Path

from omegaconf import OmegaConf

from qs3.config.location import CONF, ROOT

TABLE = CONF / "table" / "quickstart.yaml"

MESHES = "limit=24"
"""Objects a class and split of the source domains (the catalogue has 100)."""

DATASETS = (
    f"generate.py domain=modelnet10 {MESHES}",
    f"generate.py domain=specklenet10 {MESHES} views=3"
    " sensor=speckle_stereo_small renderer=mitsuba renderer.samples=4",
    "generate.py domain=kinectsim10 fraction=0.6 views=3 renderer.samples=4",
)


def main() -> int:
    """Run all steps; a step that was finished by an earlier call is skipped by the step itself."""
    parser = argparse.ArgumentParser(prog="python -m qs3.tools.quickstart", description=__doc__)
    parser.add_argument(
        "--out", type=Path, default=Path("out/quickstart"), help="where it all goes"
    )
    out = parser.parse_args().out
    if " " in str(out):
        parser.error(f"--out {out}: a path without spaces, please")
    paths = f"paths.data_dir={out / 'data'} paths.log_dir={out / 'logs'}"
    start = time.monotonic()
    _say(
        "The main job in small: few meshes, views, points and epochs, and a SIMULATED target.\n"
        "It shows that everything works; its figures are not the paper's.\n"
    )
    rows = OmegaConf.load(TABLE).rows
    runs = dict.fromkeys(row["target test"]["run"] for row in rows)  # rows may share a run
    trainings = [f"train.py -m seed=0,1,2 logger=csv {run}" for run in runs]
    for command in [*DATASETS, *trainings]:
        if _run(f"{command} {paths}"):
            return 1
    finish = (
        f"-m qs3.report table=quickstart {paths} out={out}",
        f"-m qs3.report pictures domains=[modelnet10,specklenet10,kinectsim10]"
        f" data_dir={out / 'data'} out={out / 'scans.png'}",
    )
    for command in finish:
        if _run(command):
            return 1
    memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    _say(
        f"\n{(time.monotonic() - start) / 60:.1f} minutes, "
        f"at most {memory:.1f} GB in one process\n"
        f"table    {out / 'quickstart.md'}\n"
        f"picture  {out / 'scans.png'}\n"
        f"next     README.md: your own meshes, your own scans, the paper's experiments"
    )
    return 0


def _run(command: str) -> int:
    """Run one step in a process of its own; its exit status."""
    _say(f"\n$ python {command}")
    start = time.monotonic()
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    status = subprocess.run(
        [sys.executable, *shlex.split(command)], cwd=ROOT, env=environment, check=False
    ).returncode
    if status:
        _say(f"This step failed (status {status}). Call `make quickstart` again: it continues.")
    else:
        _say(f"({time.monotonic() - start:.0f} s)")
    return status


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
