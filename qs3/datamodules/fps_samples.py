"""Several farthest point samples of each cloud, by several processes. Imports no torch: they don't.

A process writes what it has sampled to a file and sends back nothing: one that is killed in the
middle of a large message leaves half of it in the pool's pipe, and the pool waits for the rest.
"""

from __future__ import annotations

import hashlib
import logging
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from qs3.geometry.sampling import farthest_point_sampling_np, unit_ball
from qs3.utils.seeding import derive

log = logging.getLogger(__name__)

_CHUNK = 64  # clouds that a process samples at a time
WORTH_A_PROCESS = 2000  # samples; about 2 s of work


def start_points(cloud: Float[np.ndarray, "p 3"], starts: int) -> list[int]:
    """Where the samples of a cloud begin: point 0, then points drawn by its bytes, all different.

    More starts add to the list and leave the others as they are.
    """
    digest = hashlib.sha256(np.ascontiguousarray(cloud).data).hexdigest()
    chosen = [0]
    for s in range(1, starts):
        start = derive(0, "start of a sample", digest, s) % len(cloud)
        while start in chosen:
            start = (start + 1) % len(cloud)
        chosen.append(start)
    return chosen


def sample(
    points: Float[np.ndarray, "n p 3"], count: int, starts: int
) -> Int[np.ndarray, "n starts count"]:
    """Indices of `count` farthest points of each cloud in the unit ball, from each of its starts.

    int16 where that is enough: 8 MB for a thousand clouds with four samples of 1,024 points.
    """
    result = np.empty((len(points), starts, count), dtype=_index_type(points.shape[1]))
    for i, stored in enumerate(points):
        cloud = np.asarray(unit_ball(np.asarray(stored)), dtype=np.float32)
        for s, start in enumerate(start_points(stored, starts)):
            result[i, s] = farthest_point_sampling_np(cloud, count, start)
    return result


def sample_all(
    points: Float[np.ndarray, "n p 3"], count: int, starts: int, processes: int | None = None
) -> Int[np.ndarray, "n starts count"]:
    """The same, with a progress bar on a terminal, and by several processes if it takes long.

    Args:
        points: clouds, e.g. a memmap.
        count: points of a sample.
        starts: samples of a cloud.
        processes: how many; None asks the machine. The result does not depend on it.
    """
    if processes is None:
        processes = min(
            len(os.sched_getaffinity(0)), len(points) * starts // WORTH_A_PROCESS, len(points)
        )
    result = np.empty((len(points), starts, count), dtype=_index_type(points.shape[1]))
    begins = range(0, len(points), _CHUNK)
    if processes > 1:  # fpsample holds the interpreter's lock, so threads would not help
        try:
            for begin, part in _shown(_by_processes(points, count, starts, processes), len(begins)):
                result[begin : begin + len(part)] = part
            return result
        except (BrokenProcessPool, OSError) as error:  # out of memory; no room for the files
            log.warning("sampling in one process, because several failed (%s)", error)
    here = ((i, sample(points[i : i + _CHUNK], count, starts)) for i in begins)
    for begin, part in _shown(here, len(begins)):
        result[begin : begin + len(part)] = part
    return result


def _by_processes(
    points: np.ndarray, count: int, starts: int, processes: int
) -> Iterator[tuple[int, np.ndarray]]:
    """The sampled chunks with their first positions, in the order in which they are done."""
    with tempfile.TemporaryDirectory(prefix="qs3-samples-") as folder:
        pool = ProcessPoolExecutor(
            processes,
            mp_context=get_context("spawn"),  # torch's threads do not survive a fork
            initializer=_start_worker,
            initargs=(os.getpid(),),
        )
        try:
            files = {}
            for i in range(0, len(points), _CHUNK):
                chunk, file = np.asarray(points[i : i + _CHUNK]), Path(folder) / f"{i}.npy"
                files[pool.submit(_sample_to, file, chunk, count, starts)] = (i, file)
            for future in as_completed(files):
                future.result()
                begin, file = files[future]
                yield begin, np.load(file, allow_pickle=False)
                file.unlink()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _sample_to(file: Path, points: np.ndarray, count: int, starts: int) -> None:
    np.save(file, sample(points, count, starts), allow_pickle=False)


def _start_worker(parent: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what Ctrl-C means
    threading.Thread(target=_die_with, args=(parent,), daemon=True).start()


def _die_with(parent: int) -> None:
    """A worker whose parent was killed would wait for work for ever."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def _shown(parts: Iterable[tuple[int, np.ndarray]], total: int) -> Iterator[tuple[int, np.ndarray]]:
    from rich.console import Console
    from rich.progress import track

    yield from track(
        parts,
        "sampling points",
        total=total,
        console=Console(stderr=True),
        transient=True,
        disable=not sys.stderr.isatty(),
    )


def _index_type(points: int) -> type[np.signedinteger]:
    return np.int16 if points <= np.iinfo(np.int16).max else np.int32
