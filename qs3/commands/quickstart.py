"""The main job on embedded data, one command after the other: `qs3 quickstart`.

Prints every command that it runs, so that they can be run and changed one by one. Sizes are
chosen to fit into 8 minutes on 2 idle cores (it took 6.6 and 7.3); the paper's are in
conf/experiment/qs3_s2d.yaml.
"""

from __future__ import annotations

import os
import resource
import shlex
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated

from qs3.config.location import python_command, typed

MESHES = "limit=40 splits=[train]"
"""Objects a class of the source domains (the catalogue has 100); nobody is tested on these."""

DATASETS = (
    f"generate.py domain=modelnet10 {MESHES}",
    f"generate.py domain=specklenet10 {MESHES} views=3"
    " sensor=speckle_stereo_small renderer=mitsuba renderer.samples=4",
    "generate.py domain=kinectsim10 fraction=0.35 views=3 renderer=mitsuba renderer.samples=4",
)


def steps(out: str) -> list[str]:
    """All commands, as they are typed; `out` may hold any letters."""
    from qs3.config.quoting import override  # imports Hydra, which no help page waits for

    data, logs = f"{out}/data", f"{out}/logs"
    paths = shlex.join([override("paths.data_dir", data), override("paths.log_dir", logs)])
    # Nets this small gain little from a second thread, and nothing beside another busy process.
    at_once = min(len(os.sched_getaffinity(0)), 4)
    runs = "logger=csv report.pictures=false"  # pictures take as long as a training
    shown = shlex.join([f"data_dir={data}", f"log_dir={logs}"])
    table = f"table=quickstart {shown} overrides={runs!r}"
    domains = "domains=modelnet10,specklenet10,kinectsim10"
    return [
        *(f"python {command} {paths}" for command in DATASETS),
        f"qs3 report train {table} seeds=0,1,2 jobs={at_once}",
        f"qs3 report {table} {shlex.quote(f'out={out}')}",
        f"qs3 report pictures {domains} {shlex.join([f'data_dir={data}', f'out={out}/scans.png'])}",
    ]


def quickstart(*, out: Annotated[Path, "where it all goes"] = Path("out/quickstart")) -> int:
    """Run the main job on embedded data, about seven minutes on 2 idle cores.

    Prints every command that it runs. A step that an earlier call finished is skipped.
    """
    start = time.monotonic()
    print(
        "The main job in small: few meshes, views, points and epochs, and a SIMULATED target.\n"
        "It shows that everything works; its figures are not the paper's.\n"
    )
    for command in steps(str(out)):
        if _run(command):
            return 1
    memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    print(
        f"\n{(time.monotonic() - start) / 60:.1f} minutes, "
        f"at most {memory:.1f} GB in one process\n"
        f"table    {out}/quickstart.md\n"
        f"picture  {out}/scans.png\n"
        "next     README.md: your own meshes, your own scans, the paper's experiments"
    )
    return 0


def _run(command: str) -> int:
    """Run one step in a process of its own; its exit status."""
    print(f"\n$ {typed(command)}", flush=True)
    start = time.monotonic()
    if command.startswith("python "):
        _, script, *words = shlex.split(command)
        argv = [*python_command(script.removesuffix(".py")), *words]
    else:
        argv = [sys.executable, "-m", *shlex.split(command)]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    status = subprocess.run(argv, env=environment, check=False).returncode
    if status:
        print(f"This step failed (status {status}). Call the same command again: it continues.")
    else:
        print(f"({time.monotonic() - start:.0f} s)")
    return status
