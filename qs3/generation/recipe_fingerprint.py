"""A fingerprint of the recipe of a dataset, which is the same on every machine.

Rays that meet an edge, or two faces in one place, are decided by rounding, and compilers round
differently on different processors: of the same meshes, settings and code two machines may make
clouds that differ in a few points. Their content hashes differ, this does not, so that results may
be averaged (`qs3.report.tables.results`). Any change of the code that makes clouds changes it,
words in comments and docstrings do not; so do objects that failed on one machine alone.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from typing import Any

from qs3.generation.code_fingerprint import code_fingerprint
from qs3.generation.plan import plan_hash

_OF_THE_MACHINE = ("machine", "llvm", "width")


def recipe_fingerprint(recipe: Mapping[str, Any], made: Iterable[str]) -> str:
    """Twelve hexadecimal digits of settings, objects, libraries and code.

    Args:
        recipe: of `qs3.generation.plan.describe`.
        made: ids of the objects that have a cloud.
    """
    versions = {k: v for k, v in recipe["versions"].items() if k not in _OF_THE_MACHINE}
    decides = [plan_hash(dict(recipe)), versions, code_fingerprint(), sorted(made)]
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:12]
