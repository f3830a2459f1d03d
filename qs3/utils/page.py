"""Pages and texts from the templates next to this module; a page has everything inside."""

from __future__ import annotations

import base64
import functools
import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qs3.utils.version import VERSION

if TYPE_CHECKING:
    from jinja2 import Environment

_TEMPLATES = Path(__file__).with_name("templates")


def render(template: str, **values: Any) -> str:
    """A page or a text from a template, such as "run.html"; values are never taken for HTML."""
    return _environment().get_template(f"{template}.j2").render(**values)


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
