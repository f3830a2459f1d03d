"""Seeds derived from names, so that no result depends on what ran before it.

Every use of chance in training owns a seed: a function of the run's seed and of what it is for
(`derive(seed, "shuffle", epoch)`). A resume, another number of workers or another job in the
same process therefore change nothing.
"""

from __future__ import annotations

import hashlib


def derive(seed: int, *names: int | str) -> int:
    """A 63-bit seed from the run's seed and the names of its use, e.g. `derive(0, "init", 3)`."""
    text = repr((int(seed), *names)).encode()
    return int.from_bytes(hashlib.sha256(text).digest()[:8], "big") >> 1
