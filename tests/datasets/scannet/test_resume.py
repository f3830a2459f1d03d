"""Kill -9 at random instants, to the command or to one of its workers."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.datasets.scannet.rooms import write_lists, write_scene
from tests.datasets.scannet.test_extraction import SMALL, contents, run

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["parent", "worker"])
def test_kill_at_random_instants_changes_no_byte(recorded, tmp_path, victim):
    """SIGKILL again and again, until it gets through."""
    names = [f"scene{i:04d}_00" for i in range(12)]
    one, other = recorded.values()
    for i, name in enumerate(names):
        write_scene(tmp_path / "scans", name, *(one if i % 2 else other))
    write_lists(tmp_path, names[:8], names[8:])
    out = tmp_path / "killed" / "d"
    run(tmp_path, tmp_path / "whole" / "d", SMALL)
    whole = contents(tmp_path / "whole" / "d")
    assert len(whole) == 12 + 5
    command = [
        sys.executable, "-m", "qs3", "scannet", f"scans={tmp_path}/scans", f"out={out}",
        f"labels={tmp_path}/labels.tsv", f"train={tmp_path}/train.txt",
        f"val={tmp_path}/val.txt", "workers=2", "min_points=600",
    ]  # fmt: skip
    chance = random.Random(victim)
    kills = 0
    for _ in range(60):
        process = subprocess.Popen(
            command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        if kills < 12:
            time.sleep(chance.uniform(0.3, 3.5))
            kills += _kill(process.pid if victim == "parent" else _a_child(process.pid))
        if process.wait(timeout=120) == 0:  # a hung run is a failure, too
            assert contents(out) == whole
            if kills >= 10:
                break
            subprocess.run(["rm", "-rf", str(out)], check=True)
    else:
        pytest.fail("it never finished")
    assert not list(out.rglob("*.tmp*"))


def _a_child(pid):
    found = Path(f"/proc/{pid}/task/{pid}/children")
    children = found.read_text().split() if found.exists() else []
    return int(children[-1]) if children else None


def _kill(pid):
    try:
        os.kill(pid, signal.SIGKILL)
    except (ProcessLookupError, TypeError):
        return 0
    return 1
