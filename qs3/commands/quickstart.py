"""`qs3 quickstart`: the main job on embedded data, one command after the other.

Sizes are chosen to fit into 8 minutes on 2 idle cores; the paper's are in
conf/experiment/qs3_s2d.yaml.
"""

import os
import shlex
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated

from qs3.config.location import python_command, typed

MESHES = "limit=40 splits=[train]"
"""Objects a class of the source domains (the catalogue has 100); nothing is tested on these."""

DATASETS = (
    f"generate.py domain=modelnet10 {MESHES}",
    f"generate.py domain=specklenet10 {MESHES} views=3"
    " sensor=speckle_stereo_small renderer.samples=4",
    "generate.py domain=kinectsim10 fraction=0.35 views=3",
)


def steps(out: str) -> list[str]:
    """All commands, as they are typed; `out` may hold any letters."""
    from qs3.config.compose import override  # imports Hydra, which no help page waits for

    data, logs = f"{out}/data", f"{out}/logs"
    paths = shlex.join([override("paths.data_dir", data), override("paths.log_dir", logs)])
    # Nets this small gain little from a second thread, and nothing next to another busy process.
    at_once = min(len(os.sched_getaffinity(0)), 4)
    runs = "logger=csv report.pictures=false"  # pictures take as long as a training
    shown = shlex.join([f"data_dir={data}", f"log_dir={logs}"])
    table = f"table=quickstart {shown} overrides={runs!r}"
    places = shlex.join([f"data_dir={data}", f"out={out}/gap"])
    return [
        *(f"python {command} {paths}" for command in DATASETS),
        f"qs3 report train {table} seeds=0,1,2 jobs={at_once}",
        f"qs3 report {table} {shlex.quote(f'out={out}')}",
        f"qs3 compare specklenet10 kinectsim10 {places}",
    ]


def quickstart(*, out: Annotated[Path, "where it all goes"] = Path("out/quickstart")) -> int:
    """Run the main job on embedded data, about six minutes on 2 idle cores.

    Prints every command that it runs. A step that an earlier call finished is skipped.
    """
    start = time.monotonic()
    print(
        "The main job in small: few meshes, views, points and epochs, and a SIMULATED target.\n"
        "It shows that everything works; its figures are not the paper's.\n"
    )
    for command in steps(str(out)):
        print(f"\n$ {typed(command)}", flush=True)
        first, *words = shlex.split(command)
        argv = [sys.executable, "-m", first, *words]
        if first == "python":
            argv = [*python_command(words[0].removesuffix(".py")), *words[1:]]
        environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
        if status := subprocess.run(argv, env=environment, check=False).returncode:
            print(f"This step failed (status {status}). Call the same command again: it continues.")
            return 1
    print(
        f"\n{(time.monotonic() - start) / 60:.1f} minutes\n"
        f"table    {out}/quickstart.md\n"
        f"picture  {out}/gap/clouds.png\n"
        "next     README.md: your own meshes, your own scans, the paper's experiments"
    )
    return 0
