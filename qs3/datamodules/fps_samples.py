"""Which points of each stored cloud a net sees: farthest point sampling, done once, cached.

The lineage samples in every access, from a random point. Here each cloud is sampled from a few
points once, by several threads, and an epoch draws one of these samples for each cloud: it costs an
index.
"""

import contextlib
import hashlib
import logging
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from qs3.errors import ConfigError, Qs3Error
from qs3.geometry.sampling import farthest_point_sampling_np, unit_ball
from qs3.utils.files import atomic_path, locked, remove_leftovers
from qs3.utils.processor import cores
from qs3.utils.progress import shown
from qs3.utils.seeding import derive

log = logging.getLogger(__name__)

_CHUNK = 64  # clouds that a thread samples at a time
_VERSION = 2  # of the cache: raise it when the samples would be others
_DIGEST = hashlib.sha256().digest_size


def farthest_points(
    points: Float[np.ndarray, "n p 3"],
    count: int,
    starts: int = 1,
    cache_dir: Path | None = None,
    key: str = "",
) -> Int[np.ndarray, "n starts count"] | None:
    """`starts` samples of `count` farthest points of each stored cloud; None if `count` is p.

    Sample 0 begins at point 0, the others at points that are a function of the cloud's bytes
    (`start_points`). Nothing is random, so evaluation is deterministic. `cache_dir` keeps the
    indices for the next run, under a `key` that names the dataset with its hash, and the split.

    Raises:
        ConfigError: the clouds have fewer points than asked for.
    """
    n, stored, _ = points.shape
    if not 1 <= count <= stored:
        raise ConfigError(f"data.points is {count}, but the clouds of {key} have {stored} points")
    if count == stored:
        return None
    starts = min(starts, stored)

    if cache_dir is None:
        return sample_all(points, count, starts)
    cache = cache_dir / f"{key}-{count}x{starts}-v{_VERSION}.npy"
    name = f"{key} {count} of {stored}, v{_VERSION}"
    shape = (n, starts, count)
    order = read_array(cache, shape, name)
    if order is None:
        with contextlib.ExitStack() as stack:  # seeds that start together wait for the first
            with contextlib.suppress(Qs3Error, OSError):  # without a lock it is done twice at worst
                stack.enter_context(locked(cache_dir / ".lock"))
            remove_leftovers(cache_dir)
            order = read_array(cache, shape, name)
            if order is None:
                log.info("sampling %d of %d points, %dx (%s)", count, stored, starts, key)
                order = keep_array(cache, sample_all(points, count, starts), name)
    return order


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
    small = points.shape[1] <= np.iinfo(np.int16).max
    result = np.empty((len(points), starts, count), dtype=np.int16 if small else np.int32)
    for i, stored in enumerate(points):
        cloud = np.asarray(unit_ball(np.asarray(stored)), dtype=np.float32)
        for s, start in enumerate(start_points(stored, starts)):
            result[i, s] = farthest_point_sampling_np(cloud, count, start)
    return result


def sample_all(
    points: Float[np.ndarray, "n p 3"], count: int, starts: int
) -> Int[np.ndarray, "n starts count"]:
    """The same by several threads, with a progress bar on a terminal."""
    chunks = [points[i : i + _CHUNK] for i in range(0, len(points), _CHUNK)]
    with ThreadPoolExecutor(len(cores())) as threads:
        parts = threads.map(lambda chunk: sample(np.asarray(chunk), count, starts), chunks)
        return np.concatenate([*shown(parts, "sampling points", total=len(chunks))])


# The cache's file is an .npy with 32 bytes after it: SHA-256 of what it is and of what it holds.


def read_array(path: Path, shape: tuple[int, ...], name: str) -> np.ndarray | None:
    """A cached array as a memmap; None if it is not there, damaged, or of another version."""
    if not path.is_file():
        return None
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
        with open(path, "rb") as file:
            file.seek(-_DIGEST, os.SEEK_END)
            digest = file.read()
    except Exception:  # numpy's parser of headers raises whatever Python's does
        return None
    return array if array.shape == shape and digest == _digest(array, name) else None


def keep_array(path: Path, order: np.ndarray, name: str) -> np.ndarray:
    """The array from the cache, after writing it there; from memory if that is not possible."""
    try:
        with atomic_path(path) as temporary, open(temporary, "wb") as file:
            np.save(file, order, allow_pickle=False)
            file.write(_digest(order, name))
    except Qs3Error as error:  # others' folder, a full disk
        log.warning("%s (data.cache_dir=null keeps none)", error)
        return order
    kept = read_array(path, order.shape, name)
    return order if kept is None else kept


def _digest(order: np.ndarray, name: str) -> bytes:
    digest = hashlib.sha256(f"{name} {order.shape} {order.dtype.str}".encode())
    digest.update(np.ascontiguousarray(order).data)
    return digest.digest()
