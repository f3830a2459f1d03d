"""Values as words of Hydra's command line: quoted where Hydra would read something else. Light.

Unquoted, a comma makes a sweep of a word, brackets a list, digits a number, and `${` an
interpolation, whoever named the folder; letters such as umlauts, and ~, it refuses.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException


def override(key: str, value: str | Path) -> str:
    """`key=value` for a value that is text and nothing else, such as the name of a folder."""
    # OmegaConf's way to say that `${` begins no interpolation; backslashes before it are doubled.
    text = re.sub(r"(\\*)\$\{", lambda found: rf"{found[1]}{found[1]}\${{", str(value))
    return f"{key}={quoted(text)}"


def quoted(text: str) -> str:
    """Text as Hydra's grammar has it, in quotes if it needs them; an interpolation stays one."""
    try:
        read: Any = OverridesParser.create().parse_override(f"key={text}").value()
    except HydraException:
        read = None
    return text if read == text else QuotedString(text, Quote.single).with_quotes()
