"""Which points of each stored cloud a net sees: farthest point sampling, done once, cached.

The lineage samples in every access, from a random point. Here each cloud is sampled from a few
points once, and an epoch draws one of these samples for each cloud: it costs an index.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import time
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import numpy as np
from jaxtyping import Float

from qs3.datamodules.clouds import Clouds
from qs3.datamodules.fps_samples import sample_all
from qs3.errors import ConfigError, Qs3Error
from qs3.utils.files import atomic_path
from qs3.utils.locks import locked
from qs3.utils.plural import counted

log = logging.getLogger(__name__)

_DAY = 24 * 3600  # seconds
_VERSION = 2  # of the cache: raise it when the samples would be others
_DIGEST = hashlib.sha256().digest_size


def prepare(
    points: Float[np.ndarray, "n p 3"],
    count: int,
    *,
    starts: int = 1,
    cache_dir: Path | None = None,
    key: str = "",
    scale: str = "unit_ball",
    floor: float = 0.0,
) -> Clouds:
    """Each cloud about its centroid, and of it `starts` samples of `count` farthest points.

    Sample 0 begins at point 0, the others at points that are a function of the cloud's bytes
    (`start_points`). A cloud is not normalised again after sampling. Nothing is random, so
    evaluation, which takes sample 0, is deterministic. Which points are farthest does not depend
    on a cloud's size: all scales share the cached indices, taken in the unit ball.

    Args:
        points: clouds as stored, e.g. a memmap; kept, not copied.
        count: points to keep, at most p. If it is p there is nothing to choose.
        starts: samples of each cloud, at most p.
        cache_dir: where to keep the indices for the next run; None keeps nothing.
        key: names the clouds: the dataset with its hash, and the split.
        scale, floor: of the clouds, see `Clouds`.

    Raises:
        ConfigError: the clouds have fewer points than asked for.
    """
    n, stored, _ = points.shape
    if not 1 <= count <= stored:
        raise ConfigError(f"data.points is {count}, but the clouds of {key} have {stored} points")
    if count == stored:
        return Clouds.of(points, None, scale, floor)
    starts = min(starts, stored)

    def work() -> np.ndarray:
        clouds = counted(n, "cloud")
        log.info("sampling %d of %d points of %s, %dx (%s)", count, stored, clouds, starts, key)
        return sample_all(points, count, starts)

    if cache_dir is None:
        return Clouds.of(points, work(), scale, floor)
    cache = cache_dir / f"{key}-{count}x{starts}-v{_VERSION}.npy"
    name = f"{key} {count} of {stored}, v{_VERSION}, fpsample {version('fpsample')}"
    shape = (n, starts, count)
    order = read_array(cache, shape, name, silent=True)  # what is wrong with it is said below
    if order is None:
        with _alone(cache_dir):  # seeds that start at the same time wait for the first
            order = read_array(cache, shape, name)
            if order is None:
                order = keep_array(cache, work(), name)
    return Clouds.of(points, order, scale, floor)


def remove_old_leftovers(cache_dir: Path) -> None:
    """Delete what killed processes have left half written: if a day old, for others write here."""
    for path in cache_dir.glob(".*.npy.*.tmp.npy"):
        with contextlib.suppress(OSError):  # another run was quicker, or may and we may not
            if time.time() - path.stat().st_mtime > _DAY:
                path.unlink()


# The cache's file is an .npy with 32 bytes after it: SHA-256 of what it is and of what it holds.


def read_array(
    path: Path, shape: tuple[int, ...], name: str, *, silent: bool = False
) -> np.ndarray | None:
    """A cached array as a memmap; None if it is not there or not what it should be.

    The latter is a warning, unless `silent`.
    """
    warn = log.debug if silent else log.warning
    if not path.is_file():
        return None
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
        with open(path, "rb") as file:
            file.seek(-_DIGEST, os.SEEK_END)
            digest = file.read()
    except Exception as error:  # numpy's parser of headers raises whatever Python's does
        warn("%s cannot be read (%s); made again", path, error)
        return None
    if array.shape != shape or digest != _digest(array, name):
        warn("%s is damaged or of another version; made again", path)
        return None
    return array


def keep_array(path: Path, order: np.ndarray, name: str) -> np.ndarray:
    """The array from the cache, after writing it there; from memory if that is not possible."""
    try:
        with atomic_path(path) as temporary, open(temporary, "wb") as file:
            np.save(file, order, allow_pickle=False)
            file.write(_digest(order, name))
    except Qs3Error as error:  # others' folder, a full disk
        log.warning("%s (paths.cache_dir, or data.cache_dir=null to keep none)", error)
        return order
    kept = read_array(path, order.shape, name)
    return order if kept is None else kept


def _digest(order: np.ndarray, name: str) -> bytes:
    digest = hashlib.sha256(f"{name} {order.shape} {order.dtype.str}".encode())
    digest.update(np.ascontiguousarray(order).data)
    return digest.digest()


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the cache's lock if there can be one; without it, at worst the work is done twice."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(Qs3Error, OSError):
            stack.enter_context(locked(folder / ".lock"))
        yield
