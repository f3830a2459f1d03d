"""Values as words of Hydra's command line: quoted where Hydra would read something else. Light.

Unquoted, a comma makes a sweep of a word, brackets a list, digits a number, and `${` an
interpolation, whoever named the folder; letters such as umlauts, and ~, it refuses.
"""

from __future__ import annotations

import os
import re
import shlex
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException

from qs3.errors import ConfigError

_PLAIN = re.compile(r"[A-Za-z_./][\w./@%?|+-]*", re.ASCII)  # Hydra takes it, as text
_GRAMMAR = frozenset(",[]{}()'\"=:$\\")  # means something to Hydra: not for us to guess
_PLACE = re.compile(r"\+*(paths\.\w+|([\w.@]+\.)?(folder|path|meshes|mesh|poses|file))")


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


def as_text(word: str) -> str:
    """A word as it was typed, with its value in quotes where that can be nothing but text.

    That is what Hydra's grammar refuses for its letters alone (folder=Räume), and a number where a
    file or folder is asked for (folder=2024). `~/` is the home folder: shells leave it behind `=`.
    """
    key, _, value = word.partition("=")
    if not value or key.startswith("-") or _PLAIN.fullmatch(value) or _GRAMMAR & set(value):
        return word
    text = os.path.expanduser(value) if value == "~" or value.startswith("~/") else value
    try:
        read: Any = OverridesParser.create().parse_override(f"key={text}").value()
    except HydraException:
        read = text
    number = isinstance(read, int | float) and not isinstance(read, bool)
    if number and not _PLACE.fullmatch(key):
        return word
    if number:
        return f"{key}={QuotedString(text, Quote.single).with_quotes()}"
    return f"{key}={quoted(text)}" if read == text else word


def words_of(key: str, line: str) -> list[str]:
    """The words of a line of overrides, as a shell takes it apart; `key`: whose value it is.

    Raises:
        ConfigError: a quotation mark or a backslash has no end.
    """
    try:
        return shlex.split(line)
    except ValueError as error:
        raise ConfigError(
            f"{key}={line}: {str(error).lower()}; a value with a quotation mark goes into others, "
            "and so does one with spaces"
        ) from error
