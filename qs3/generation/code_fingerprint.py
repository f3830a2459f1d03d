"""A hash of the code that makes clouds: the same for the same code, whatever its words.

Of the packages and modules that make them and of what these take from others; what only checks,
reads settings, shows or stores is left out (`HARMLESS`, which a test compares with the imports), as
are nets' geometry and what measures, fits or differentiates sensors.
"""

from __future__ import annotations

import ast
import functools
import hashlib
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]
MAKES_CLOUDS = (
    *(
        "datasets/clouds",
        "generation",
        "meshes",
        "catalogue",
        "classes.py",
        "datasets/frames",
        "utils/seeding.py",
    ),
    *("geometry/cameras.py", "geometry/sampling.py"),
    *("sensors/base.py", "sensors/devices", "sensors/matching"),
    *("sensors/optics", "sensors/renderers"),
)
HARMLESS = ("cluster", "config", "store", "datasets", "errors", "utils")


@functools.cache
def code_fingerprint(root: Path = _ROOT) -> str:
    """Hash of what the packages that make clouds do."""
    digest = hashlib.sha256()
    for name in MAKES_CLOUDS:
        for path in [root / name] if name.endswith(".py") else sorted((root / name).rglob("*.py")):
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
