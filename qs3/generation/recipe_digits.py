"""Digits of the recipe of a dataset, which are the same on every machine.

Rays that meet an edge, or two faces in one place, are decided by rounding, and compilers round
differently on different processors: of the same meshes, settings and code two machines may make
clouds that differ in a few points. Their content hashes differ, these digits do not, so that
results may be averaged (`qs3.report.tables.aggregate`). Any change of the code that makes clouds
changes them; words in comments and docstrings do not.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from qs3.generation.code_digits import code_digits
from qs3.generation.plan import plan_hash

_OF_THE_MACHINE = ("machine", "llvm", "width")


def recipe_digits(recipe: Mapping[str, Any]) -> str:
    """Twelve hexadecimal digits of settings, objects, libraries and code.

    Args:
        recipe: of `qs3.generation.plan.describe`.
    """
    versions = {k: v for k, v in recipe["versions"].items() if k not in _OF_THE_MACHINE}
    decides = [plan_hash(dict(recipe)), versions, code_digits()]
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:12]
