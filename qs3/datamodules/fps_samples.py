"""Several farthest point samples of each cloud, by several processes.

Imports no torch, so that they need not.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from qs3.geometry.sampling import farthest_point_sampling_np, unit_ball
from qs3.utils.pool import Processes
from qs3.utils.progress import shown
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
    points: Float[np.ndarray, "n p 3"],
    count: int,
    starts: int,
    processes: int | None = None,
) -> Int[np.ndarray, "n starts count"]:
    """The same, with a progress bar on a terminal, and by several processes if it takes long.

    How many, None asks the machine; the result does not depend on it.
    """
    if processes is None:
        processes = min(
            len(os.sched_getaffinity(0)), len(points) * starts // WORTH_A_PROCESS, len(points)
        )
    result = np.empty((len(points), starts, count), dtype=_index_type(points.shape[1]))
    begins = range(0, len(points), _CHUNK)
    if processes > 1:  # fpsample holds the interpreter's lock, so threads would not help
        try:
            _fill(result, points, begins, processes)
            return result
        except OSError as error:  # out of memory, or no more processes
            log.warning("sampling in one process, because several failed (%s)", error)
    _fill(result, points, begins, 0)
    return result


def _fill(result: np.ndarray, points: np.ndarray, begins: Sequence[int], processes: int) -> None:
    chunks = ((str(i), np.asarray(points[i : i + _CHUNK])) for i in begins)
    _, starts, count = result.shape
    outcomes = Processes(processes).run(partial(_sampler, count, starts), chunks)
    for outcome in shown(outcomes, "sampling points", total=len(begins)):
        if outcome.result is None:
            raise ChildProcessError("a process died twice")
        begin = int(outcome.name)
        result[begin : begin + len(outcome.result)] = outcome.result


def _sampler(count: int, starts: int) -> Callable[[np.ndarray], np.ndarray]:
    return partial(sample, count=count, starts=starts)


def _index_type(points: int) -> type[np.signedinteger]:
    return np.int16 if points <= np.iinfo(np.int16).max else np.int32
