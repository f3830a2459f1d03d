"""Seeds derived from names, so that no result depends on what ran before it.

Every use of chance in training owns a seed: a function of the run's seed and of what it is for
(`derive(seed, "shuffle", epoch)`); an object's is a function of the dataset's seed and its id. A
resume, another number of workers or another job in the same process therefore change nothing.
"""

import hashlib

import numpy as np


def derive(seed: int, *names: int | str) -> int:
    """A 63-bit seed from the run's seed and the names of its use, e.g. `derive(0, "init", 3)`."""
    text = repr((int(seed), *names)).encode()
    return int.from_bytes(hashlib.sha256(text).digest()[:8], "big") >> 1


def object_rng(dataset_seed: int, object_id: str, *stream: int) -> np.random.Generator:
    """A generator of its own for each (dataset seed, object id, stream).

    `stream` separates uses within an object (0: placing and scene, 1: poses, 2 + i: view i), so
    that more views leave the first ones as they were.
    """
    digest = hashlib.sha256(object_id.encode()).digest()[:16]
    words = np.frombuffer(digest, dtype="<u4").tolist()
    return np.random.default_rng([dataset_seed, *words, *stream])
