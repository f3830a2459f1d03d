"""Seeds: an object's randomness is a function of the dataset's seed and the object's id."""

from __future__ import annotations

import hashlib

import numpy as np


def object_rng(dataset_seed: int, object_id: str, *stream: int) -> np.random.Generator:
    """A generator of its own for each (dataset seed, object id, stream).

    Neither the order of work nor the number of workers enters. `stream` separates uses
    within an object (0: placing and scene, 1: poses, 2 + i: view i), so that asking for
    more views leaves the first ones as they were.
    """
    digest = hashlib.sha256(object_id.encode()).digest()[:16]
    words = np.frombuffer(digest, dtype="<u4").tolist()
    return np.random.default_rng([dataset_seed, *words, *stream])
