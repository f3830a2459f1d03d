"""Pages and texts from the templates next to this module; a page has everything inside."""

from __future__ import annotations

import base64
import functools
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Int

from qs3.utils.version import VERSION

if TYPE_CHECKING:
    from jinja2 import Environment

_TEMPLATES = Path(__file__).with_name("templates")


def render(template: str, **values: Any) -> str:
    """A page or a text from a template, such as "run.html"; values are never taken for HTML."""
    return _environment().get_template(f"{template}.j2").render(**values)


def confusion_rows(matrix: Int[np.ndarray, "c c"], classes: Sequence[str]) -> list[dict[str, Any]]:
    """A confusion matrix for the templates: the classes that occur; darker is more of the row."""
    there = [k for k in range(len(classes)) if matrix[k].sum() or matrix[:, k].sum()]
    rows = []
    for i in there:
        total, cells = int(matrix[i].sum()), []
        for j in there:
            colour = "58,143,92" if i == j else "181,64,58"
            share = 0.75 * matrix[i, j] / max(total, 1)
            cells.append((int(matrix[i, j]), f"rgba({colour},{share:.2f})", i == j))
        rows.append({"name": classes[i], "cells": cells, "hits": int(matrix[i, i]), "total": total})
    return rows


@functools.cache
def _environment() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    made = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=lambda name: str(name).endswith(".html.j2"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    script = (_TEMPLATES / "viewer.js").read_text("utf-8")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    made.filters["png"] = lambda data: (
        f"data:image/png;base64,{base64.b64encode(data).decode('ascii')}"
    )
    made.filters["percent"] = lambda share: f"{share:.0%}"
    made.globals.update(
        version=VERSION,
        script=script,
        script_hash=f"sha256-{digest}",
        style=(_TEMPLATES / "page.css").read_text("utf-8"),
    )
    return made
