"""From a stored cloud to what a net sees: unit ball, then farthest points; done once, cached."""

from __future__ import annotations

import contextlib
import logging
import time
from pathlib import Path

import numpy as np
from jaxtyping import Float

from qs3.errors import ConfigError, Qs3Error
from qs3.files import write_npy

log = logging.getLogger(__name__)

_DAY = 24 * 3600  # seconds
_VERSION = 1  # part of the cache's name: raise it when the numbers below would change


def prepare(
    points: Float[np.ndarray, "n p 3"], count: int, cache_dir: Path | None = None, key: str = ""
) -> Float[np.ndarray, "n count 3"]:
    """Normalise each cloud to the unit ball, then keep `count` farthest points, from point 0 on.

    The cloud is not normalised again afterwards, and nothing is random, so evaluation is
    deterministic. Training shuffles, turns and jitters these points later.

    Args:
        points: clouds as stored, e.g. a memmap.
        count: points to keep, at most p.
        cache_dir: where to keep the result for the next seed; None keeps nothing.
        key: names the clouds: hash of the dataset, and the split.

    Raises:
        ConfigError: the clouds have fewer points than asked for.
    """
    n, stored, _ = points.shape
    if not 1 <= count <= stored:
        raise ConfigError(f"data.points is {count}, but the clouds of {key} have {stored} points")
    cache = cache_dir / f"{key}-{count}-v{_VERSION}.npy" if cache_dir else None
    if cache is not None and (found := _read(cache, (n, count, 3))) is not None:
        return found

    from qs3.geometry.sampling import farthest_point_sampling_np, unit_ball

    log.info("sampling %d of %d points in %d clouds (%s)", count, stored, n, key)
    result = np.empty((n, count, 3), dtype=np.float32)
    for i in range(n):
        cloud = np.asarray(unit_ball(np.asarray(points[i])), dtype=np.float32)
        result[i] = cloud[farthest_point_sampling_np(cloud, count, 0)] if count < stored else cloud
    if cache is not None:
        try:
            write_npy(cache, result)
        except Qs3Error as error:  # the data may lie where only others may write
            log.warning("%s (paths.cache_dir, or data.cache_dir=null to keep none)", error)
    return result


def remove_old_leftovers(cache_dir: Path) -> None:
    """Delete what killed processes have left half written: if a day old, for others write here."""
    for path in cache_dir.glob(".*.npy.*.tmp.npy"):
        with contextlib.suppress(OSError):  # another run was quicker, or may and we may not
            if time.time() - path.stat().st_mtime > _DAY:
                path.unlink()


def _read(path: Path, shape: tuple[int, int, int]) -> np.ndarray | None:
    """The cached array, or None if it is not there or not what it should be (then it is redone)."""
    try:
        array = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None
    return array if array.shape == shape and array.dtype == np.float32 else None
