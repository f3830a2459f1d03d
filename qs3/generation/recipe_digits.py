"""Digits of the recipe of a dataset, which are the same on every machine.

Rays that meet an edge, or two faces in one place, are decided by rounding, and compilers round
differently on different processors: of the same meshes, settings and code two machines may make
clouds that differ in a few points. Their content hashes differ, these digits do not, so that
results may be averaged (`qs3.report.tables.aggregate`). Any change of the code that makes clouds
changes them; words in comments and docstrings do not.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from qs3.generation.plan import plan_hash

_ROOT = Path(__file__).resolve().parents[1]
_MAKES_CLOUDS = ("clouds", "generation", "geometry", "meshes", "sensors")
_OF_THE_MACHINE = ("machine", "llvm", "width")


def recipe_digits(recipe: Mapping[str, Any]) -> str:
    """Twelve hexadecimal digits of settings, objects, libraries and code.

    Args:
        recipe: of `qs3.generation.plan.describe`.
    """
    versions = {k: v for k, v in recipe["versions"].items() if k not in _OF_THE_MACHINE}
    decides = [plan_hash(dict(recipe)), versions, code_digits()]
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:12]


@functools.cache
def code_digits(root: Path = _ROOT) -> str:
    """Hash of what the packages that make clouds do."""
    digest = hashlib.sha256()
    for package in _MAKES_CLOUDS:
        for path in sorted((root / package).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            digest.update(path.relative_to(root).as_posix().encode())
            digest.update(ast.dump(_without_docstrings(tree)).encode())
    return digest.hexdigest()


def _without_docstrings(tree: ast.AST) -> ast.AST:
    """The tree itself, whose constants that are statements are gone."""
    for node in ast.walk(tree):
        if isinstance(body := getattr(node, "body", None), list):
            body[:] = [
                line
                for line in body
                if not (isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant))
            ]
    return tree
