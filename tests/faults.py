"""Ends or fails a command at every point where it touches a disk, one after the other.

Points are: a file is opened for writing, half of it is written, it is flushed, renamed or removed,
a folder is made. Each is tried in a process of its own, forked when everything is imported; then
the same command runs once more, undisturbed, and must end as if nothing had been.

    python -m tests.faults training kill 0 4     every fourth point, from the first
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from qs3.errors import Qs3Error

KILLED, TOLD, FOREIGN = 77, 78, 79
ENDS = {0: "finished", KILLED: "killed", TOLD: "told", FOREIGN: "foreign"}


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
            if event in ("os.rename", "os.remove", "os.mkdir", "os.rmdir"):
                touched = str(values[0]).startswith(self.folder)
            elif event == "open":
                path, _, flags = values
                touched = str(path).startswith(self.folder) and flags & (os.O_WRONLY | os.O_RDWR)
            else:
                return
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


def tried(
    command: Callable[[Path], None],
    result: Callable[[Path], Any],
    how: str,
    first: int,
    step: int,
) -> dict[str, Any]:
    """Try points `first`, `first + step`, ... of a command that writes into a folder.

    Returns:
        How many points there are and were tried, how they ended, what was lost or foreign, and the
        seconds a point.
    """
    root = Path(tempfile.mkdtemp(prefix="faults-"))

    def run(folder: Path, strike: int) -> Any:
        folder.mkdir(exist_ok=True)
        points = Points(folder, strike, how)
        points.watch()
        command(folder)
        return points.count, result(folder)

    status, said = forked(lambda: (run(root / "whole", 0), sorted(sys.modules)))
    assert status == 0, said
    (count, expected), modules = said
    for name in modules:  # not by running the command here: its threads would not be forked
        with contextlib.suppress(Exception):
            importlib.import_module(name)
    began, ends, wrong = time.monotonic(), dict.fromkeys(ENDS.values(), 0), []
    numbers = range(1 + first, count + 1, step)
    for number in numbers:
        folder = root / str(number)
        status, said = forked(lambda: run(folder, number))  # noqa: B023
        ends[ENDS[status]] += 1
        if status == FOREIGN:
            wrong.append(f"point {number}: {said}")
        status, said = forked(lambda: run(folder, 0))  # noqa: B023
        if status != 0:
            wrong.append(f"after point {number}: {said}")
        elif said[1] != expected:
            wrong.append(f"after point {number}: another result")
    seconds = (time.monotonic() - began) / max(len(numbers), 1)
    return {"points": count, "tried": len(numbers), **ends, "wrong": wrong, "seconds": seconds}


def training(folder: Path) -> None:
    """The toy run, shorter: a warm-up of three epochs and a round of one."""
    from qs3.training.command import train

    cfg = _TOY[0].copy()
    cfg.paths.log_dir, cfg.paths.cache_dir = str(folder / "logs"), str(folder / "cache")
    train(cfg)


def trained(folder: Path) -> Any:
    """What must be the same."""
    from tests.training.conftest import result_of

    (run,) = (path.parent for path in folder.rglob("metrics.json"))
    return result_of(run)


def generation(folder: Path) -> None:
    """Surface samples of one object a class and split."""
    from qs3.generation.command import generate
    from tests.generation.generating import composed

    generate(composed(*GENERATION, f"paths.data_dir={folder}"))


def generated(folder: Path) -> Any:
    """The names of all files that are there, and the bytes of all that do not say where or when."""
    from qs3.store.parts import CONFIG, COSTS
    from qs3.utils.files import sha256_file

    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.suffix != ".log")
    return {
        str(path.relative_to(folder)): path.name not in (CONFIG, COSTS) and sha256_file(path)
        for path in files
        if path.stat().st_size
    }


_TOY: list[Any] = []  # the composed config
GENERATION = ("domain=modelnet10", "workers=0", "limit=1", "classes=[chair,lamp]")
COMMANDS = {"training": (training, trained), "generation": (generation, generated)}


def main(name: str, how: str, first: str, step: str) -> None:
    """Print what `tried` says, as JSON."""
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        tempfile.tempdir = folder
        said = _tried(name, how, int(first), int(step))
    sys.stdout.write(json.dumps(said) + "\n")


def _tried(name: str, how: str, first: int, step: int) -> dict[str, Any]:
    torch.set_num_threads(1)
    command, result = COMMANDS[name]
    if name == "training":
        import qs3.training.fit  # noqa: F401  before forking
        from tests.training.toy import toy_config, write_toy

        data = Path(tempfile.mkdtemp(prefix="faults-data-"))
        write_toy(data)
        short = ("protocol.epochs=3", "selftraining.rounds=1", "selftraining.epochs=1")
        _TOY.append(toy_config(data, f"paths.data_dir={data}", *short))
    return tried(command, result, how, first, step)


if __name__ == "__main__":
    main(*sys.argv[1:])
