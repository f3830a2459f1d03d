"""Nothing is lost, and no foreign error is shown, wherever a command ends that touches the disk.

Points are: a file is opened for writing, half of it is written, it is flushed, renamed or removed,
a folder is made. At each the process, forked when everything is imported, is killed or fails as on
a full disk; then the same command runs once more, undisturbed, and must end as if nothing had
been. `python -m tests.test_faults training kill 0 4` tries every fourth point.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from qs3.errors import Qs3Error

ROOT = Path(__file__).parents[1]
PARTS = 4  # each tries a quarter of the points
KILLED, TOLD, FOREIGN = 77, 78, 79
GENERATION = ("domain=modelnet10", "workers=0", "limit=1", "classes=[chair,lamp]")


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize("how", ["kill", "fail"])
@pytest.mark.parametrize("name", ["generation", "training"])
def test_every_point_may_be_the_last(name, how, part):
    words = [sys.executable, "-W", "ignore", "-m", __name__, name, how, str(part), str(PARTS)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        words, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True, check=True
    )
    points, ends, wrong = json.loads(done.stdout.splitlines()[-1])
    assert wrong == []
    assert str(FOREIGN) not in ends
    assert points > 60
    assert sum(ends.values()) >= points // PARTS
    assert how != "kill" or set(ends) == {str(KILLED)}


class Points:
    """Counts what is done to files below a folder, and strikes at one of them.

    Args:
        folder: others are not counted.
        strike: at which point, from 1; 0: never.
        how: "kill" the process, or "fail" as a full disk does.
    """

    def __init__(self, folder: Path, strike: int, how: str) -> None:
        self.folder, self.strike, self.how, self.count = str(folder), strike, how, 0

    def __call__(self) -> None:
        self.count += 1
        if self.count == self.strike:
            if self.how == "kill":
                os._exit(KILLED)
            raise OSError(errno.ENOSPC, "No space left on device")

    def watch(self) -> None:
        """From now on, in this process."""
        fsync, write_bytes, save = os.fsync, Path.write_bytes, torch.save

        def audit(event: str, values: tuple) -> None:
            if event == "open":
                path, _, flags = values
                touched = str(path).startswith(self.folder) and flags & (os.O_WRONLY | os.O_RDWR)
            else:
                named = ["os.rename", "os.mkdir"]
                if self.how == "kill":  # to remove something takes no space
                    named += ["os.remove", "os.rmdir"]
                touched = event in named and str(values[0]).startswith(self.folder)
            if touched:
                self()

        def flush(handle: int) -> None:
            self()
            fsync(handle)

        def in_halves(path: Path, data: Any) -> int:
            write_bytes(path, bytes(data)[: len(data) // 2])
            self()
            return write_bytes(path, data)

        def save_in_halves(value: Any, file: Any) -> None:
            file.write(b"half")
            file.flush()
            self()
            file.seek(0)
            save(value, file)

        sys.addaudithook(audit)
        os.fsync, Path.write_bytes, torch.save = flush, in_halves, save_in_halves  # type: ignore


def forked(work: Callable[[], Any]) -> tuple[int, Any]:
    """How a process ended, and what it returned or said."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        status = 0
        try:
            said = work()
        except Qs3Error as error:
            status, said = TOLD, str(error)
        except BaseException as error:
            status, said = FOREIGN, f"{type(error).__name__}: {error}"
        os.write(writer, json.dumps(said).encode())
        os._exit(status)
    os.close(writer)
    with open(reader, "rb") as file:
        data = file.read()
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return status, json.loads(data) if data else None


def tried(command: Callable[[Path], Any], how: str, first: int, step: int) -> tuple:
    """Try points `first`, `first + step`, ... of a command that writes into a folder.

    Returns:
        How many points there are, how often processes ended how, and what was lost or foreign.
    """
    root = Path(tempfile.mkdtemp())

    def run(folder: Path, strike: int) -> Any:
        folder.mkdir(exist_ok=True)
        points = Points(folder, strike, how)
        points.watch()
        result = command(folder)
        return points.count, result

    status, said = forked(lambda: (run(root / "whole", 0), sorted(sys.modules)))
    assert status == 0, said
    (count, expected), modules = said
    for name in modules:  # not by running the command here: its threads would not be forked
        with contextlib.suppress(Exception):
            importlib.import_module(name)
    ends, wrong = Counter[int](), []
    for number in range(1 + first, count + 1, step):
        folder = root / str(number)
        status, said = forked(lambda: run(folder, number))  # noqa: B023
        ends[status] += 1
        if status == FOREIGN:
            wrong.append(f"point {number}: {said}")
        status, said = forked(lambda: run(folder, 0))  # noqa: B023
        if status or said[1] != expected:
            wrong.append(f"after point {number}: {said if status else 'another result'}")
    return count, ends, wrong


def training(folder: Path) -> Any:
    """The toy run, shorter: a warm-up of three epochs and a round of one; its result."""
    from qs3.training.command import train
    from tests.training.conftest import result_of

    cfg = _TOY[0].copy()
    cfg.paths.log_dir, cfg.paths.cache_dir = str(folder / "logs"), str(folder / "cache")
    train(cfg)
    (run,) = (path.parent for path in folder.rglob("metrics.json"))
    return result_of(run)


def generation(folder: Path) -> Any:
    """Surface samples; the names of all files, and the hash of those that do not say where."""
    from qs3.generation.command import generate
    from qs3.store.parts import CONFIG
    from qs3.utils.files import sha256_file
    from tests.generation.generating import composed

    generate(composed(*GENERATION, f"paths.data_dir={folder}"))
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.suffix != ".log")
    return {
        str(path.relative_to(folder)): path.name != CONFIG and sha256_file(path)
        for path in files
        if path.stat().st_size
    }


_TOY: list[Any] = []  # the composed config


def main(name: str, how: str, first: str, step: str) -> None:
    """Print what `tried` returns, as JSON."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        tempfile.tempdir = folder
        if name == "training":
            import qs3.training.fit  # noqa: F401  before forking
            from tests.training.toy import toy_config, write_toy

            data = Path(tempfile.mkdtemp())
            write_toy(data)
            short = ("protocol.epochs=3", "selftraining.rounds=1", "selftraining.epochs=1")
            _TOY.append(toy_config(data, f"paths.data_dir={data}", *short))
        command = {"training": training, "generation": generation}[name]
        said = json.dumps(tried(command, how, int(first), int(step)))
    sys.stdout.write(said + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
