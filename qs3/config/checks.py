"""Checks of single settings: each error names the key as it stands on the command line. Light."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from qs3.errors import ConfigError


def whole(key: str, value: Any, least: int) -> int:
    """The value, if it is a whole number not below `least`.

    Raises:
        ConfigError: it is not.
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ConfigError(f"{key} must be a whole number >= {least}, got {value!r}")
    return value


def number(key: str, value: Any) -> float:
    """The value, if it is a number.

    Raises:
        ConfigError: it is not.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(f"{key} must be a number, got {value!r}")
    return value


def one_of(key: str, value: Any, allowed: Sequence[str]) -> str:
    """The value, if it is one of the allowed ones.

    Raises:
        ConfigError: it is not.
    """
    if value not in allowed:
        raise ConfigError(f"{key} must be one of {tuple(allowed)}, got {value!r}")
    return value
