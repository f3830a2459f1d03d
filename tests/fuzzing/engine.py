"""Runs a reader on damaged inputs for some seconds, in a process of its own, and says what escaped.

Kept are inputs that take steps through the code that none took before (`Coverage`), and damaged
further. What is found: an error that is not of qs3.errors, more memory than the budget, a call that
does not end, a process that dies.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import mmap
import os
import random
import resource
import shutil
import signal
import struct
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

from qs3.errors import Qs3Error
from qs3.utils.memory import memory_limit
from tests.fuzzing.coverage import Coverage
from tests.fuzzing.mutate import Shape, mutated

MOST_CPU_S = 5.0
"""Processor time of one call; none of these inputs needs a tenth of it."""

_SLACK = 1.25, 1 << 26  # times the budget, and bytes: what else the process takes meanwhile
_GLIBC = (-4, 65536), (-3, 128 << 10), (-1, 128 << 10), (-2, 128 << 10)
# of malloc.h: M_MMAP_MAX, M_MMAP_THRESHOLD, M_TRIM_THRESHOLD and M_TOP_PAD as they are by default
_SILENT_S = 90.0  # then the process hangs where no signal is heard
_RECENT = 16


@dataclass(frozen=True)
class Reader:
    """Something that opens files of others.

    Attributes:
        name: of the format.
        seeds: writes whole files into a folder; gives their bytes.
        read: is given the path of one input.
        file: the input's name.
        shape: how inputs are taken apart; None: they are bytes.
        covers: the modules that read, relative to qs3/.
    """

    name: str
    seeds: Callable[[Path], list[bytes]]
    read: Callable[[Path], Any]
    file: str
    shape: Shape | None = None
    covers: tuple[str, ...] = ()


@dataclass
class Found:
    """What escaped a reader.

    Attributes:
        kind: "foreign", "memory", "hang" or "crash".
        what: the error, or how much.
        where: the line of the reader.
        data: the input, in hexadecimal digits.
    """

    kind: str
    what: str
    where: str
    data: str

    def __str__(self) -> str:
        return f"{self.kind}: {self.what} at {self.where}; the input: {self.data[:2000]}"


@dataclass
class Outcome:
    """Of one reader.

    Attributes:
        executions: inputs that were read.
        accepted: of them, how many were taken for whole files.
        kept: inputs that brought new steps.
        steps: different ones from line to line.
        peak: most bytes that one call took.
        found: each place once.
    """

    executions: int = 0
    accepted: int = 0
    kept: int = 0
    steps: int = 0
    peak: int = 0
    found: list[Found] = field(default_factory=list)

    def count(self, kind: str) -> int:
        """Findings of a kind."""
        return sum(one.kind == kind for one in self.found)


class _TooLongError(BaseException):
    """Not to be caught by a reader's `except Exception`."""


def fuzz(reader: Reader, seconds: float, seed: int = 0) -> Outcome:
    """Try a reader; one that kills its process goes on in another with other inputs."""
    outcome, end = Outcome(), time.monotonic() + seconds
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None  # thousands of small files
    with tempfile.TemporaryDirectory(prefix="fuzzing-", dir=memory) as name:
        folder = Path(name)
        while (left := end - time.monotonic()) > 0:
            outcome, died = _watched(reader, left, seed, folder, outcome)
            if not died:
                break
            current = folder / "current"
            data = current.read_bytes().hex() if current.exists() else ""
            outcome.found.append(Found(*died, data))
            seed += 1
    unique = {(one.kind, one.where): one for one in outcome.found}
    outcome.found = list(unique.values())
    return outcome


def _watched(
    reader: Reader, seconds: float, seed: int, folder: Path, outcome: Outcome
) -> tuple[Outcome, tuple[str, str, str] | None]:
    """The outcome so far, and how the process died if it did."""
    clock, answer = mmap.mmap(-1, 8), folder / "answer.json"
    child = os.fork()
    if not child:
        status = 1
        try:
            # What C libraries say of damaged files.
            os.dup2(os.open(folder / "said", os.O_WRONLY | os.O_CREAT | os.O_APPEND), 2)
            _Loop(reader, seed, folder, clock, outcome).run(seconds)
            status = 0
        except BaseException:
            (folder / "broken").write_text(traceback.format_exc())
        finally:
            os._exit(status)
    last, seen = -1, time.monotonic()
    while os.waitpid(child, os.WNOHANG) == (0, 0):
        (now,) = struct.unpack("q", clock[:])
        if now != last:
            last, seen = now, time.monotonic()
        if time.monotonic() - seen > _SILENT_S:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.05)
    if (broken := folder / "broken").exists():  # by a mistake in these files or a seed of theirs
        raise RuntimeError(f"{reader.name}: {broken.read_text()}")
    if answer.exists():
        said = json.loads(answer.read_text())
        said["found"] = [Found(**one) for one in said["found"]]
        outcome = Outcome(**said)
    if (folder / "done").exists():
        return outcome, None
    hung = time.monotonic() - seen > _SILENT_S
    why = f"silent for {_SILENT_S:g} s" if hung else "the process died"
    return outcome, ("hang" if hung else "crash", why, reader.name)


class _Loop:
    """In the child."""

    def __init__(
        self, reader: Reader, seed: int, folder: Path, clock: mmap.mmap, outcome: Outcome
    ) -> None:
        self.reader, self.folder, self.clock, self.outcome = reader, folder, clock, outcome
        self.rng, self.coverage = random.Random(f"{reader.name} {seed}"), Coverage()
        self.place = folder / "input"
        self.known = {(one.kind, one.where) for one in outcome.found}

    def run(self, seconds: float) -> None:
        warnings.simplefilter("ignore")
        with tempfile.TemporaryDirectory(dir=self.folder) as made:
            corpus = self.reader.seeds(Path(made))
        self._call(corpus[0])  # what is imported now is not the input's
        _hand_back_freed_memory()
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + 3 * memory_limit() + (1 << 30)
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        signal.signal(signal.SIGPROF, self._stop)
        end = time.monotonic() + seconds
        for data in corpus:
            self.try_one(data)
        said = time.monotonic()
        whole = corpus.copy()
        while time.monotonic() < end:
            some = self.rng.choice((whole, corpus[-_RECENT:], corpus))
            data = mutated(self.rng.choice(some), corpus, self.reader.shape, self.rng)
            if self.try_one(data):
                corpus.append(data)
                self.outcome.kept += 1
            if time.monotonic() - said > 1:
                self._say()
                said = time.monotonic()
        self._say()
        (self.folder / "done").touch()

    def _say(self) -> None:
        self.outcome.steps = len(self.coverage.seen)
        draft = self.folder / "answer.tmp"
        draft.write_text(json.dumps(asdict(self.outcome)))
        draft.replace(self.folder / "answer.json")

    def try_one(self, data: bytes) -> bool:
        """Whether it took new steps."""
        steps = len(self.coverage.seen)
        (self.folder / "current").write_bytes(data)
        self.clock[:] = struct.pack("q", self.outcome.executions)
        before = _reset_peak()
        found = None
        with self.coverage.tracing():
            found = self._limited(data, MOST_CPU_S)
        if found is not None and found.kind == "hang":  # traced, everything takes longer
            found = self._limited(data, MOST_CPU_S)
        took = max(0, _peak() - before)
        self.outcome.peak = max(self.outcome.peak, took)
        if found is None and took > _SLACK[0] * memory_limit() + _SLACK[1]:
            found = Found("memory", f"{took / 1e9:.2f} GB", self.reader.name, "")
        self.outcome.executions += 1
        if found is not None and (found.kind, found.where) not in self.known:
            self.known.add((found.kind, found.where))
            found.data = data.hex()
            self.outcome.found.append(found)
            self._say()
        return len(self.coverage.seen) > steps

    def _limited(self, data: bytes, seconds: float) -> Found | None:
        signal.setitimer(signal.ITIMER_PROF, seconds)
        try:
            self._call(data)
            self.outcome.accepted += 1
        except Qs3Error:
            pass
        except _TooLongError as error:
            return Found("hang", f"more than {seconds:g} s", _line_of(error), "")
        except BaseException as error:
            words = f"{type(error).__name__}: {str(error)[:200]}"
            return Found("foreign", words, _line_of(error), "")
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
        return None

    def _call(self, data: bytes) -> None:
        shutil.rmtree(self.place, ignore_errors=True)
        self.place.mkdir()
        path = self.place / self.reader.file
        path.write_bytes(data)
        self.reader.read(path)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        raise _TooLongError


def _line_of(error: BaseException) -> str:
    """The deepest line of qs3 that the error passed."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [one for one in frames if "/qs3/" in one.filename] or frames
    return f"{ours[-1].filename.rpartition('/qs3/')[2]}:{ours[-1].lineno}"


def _hand_back_freed_memory() -> None:
    """Or what is taken from memory that was freed before, by a training say, is not seen.

    Trainings ask glibc to keep it (`qs3.utils.allocator`), for the whole process and its forks.
    """
    with contextlib.suppress(OSError, AttributeError):
        glibc = ctypes.CDLL(None)
        for key, value in _GLIBC:
            glibc.mallopt(key, value)
        glibc.malloc_trim(0)


def _reset_peak() -> int:
    """Bytes that this process has now; from here on `_peak` counts."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def _peak() -> int:
    """The most that this process had at once since `_reset_peak`."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return 1024 * int(line.split()[1])
    return 0
