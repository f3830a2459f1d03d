"""Checks of single settings: each error names the key as it stands on the command line. Light."""

from __future__ import annotations

import difflib
import math
import operator
from collections.abc import Iterable, Sequence
from numbers import Integral, Real
from typing import Any

from qs3.errors import ConfigError

_COMPARE = {">": operator.gt, ">=": operator.ge}


def check_int(key: str, value: Any, least: int) -> int:
    """The value; ConfigError unless it is a whole number, numpy's too, not below `least`."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise ConfigError(f"{key} must be a whole number >= {least}, got {value!r}")
    return int(value)


def check_float(key: str, value: Any, allowed: str = "") -> float:
    """The value; ConfigError unless it is a finite number, `allowed` if given (`check_ranges`)."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(f"{key} must be a number, got {value!r}")
    if allowed:
        _check_range(key, value, allowed)
    elif not math.isfinite(value):
        raise ConfigError(f"{key} must be a finite number, got {value}")
    return value


def check_bool(key: str, value: Any) -> bool:
    """The value; ConfigError unless it is true or false."""
    if not isinstance(value, bool):
        raise ConfigError(f"{key} must be true or false, got {value!r}")
    return value


def check_words(key: str, value: Any) -> list[str]:
    """A list of words; ConfigError for a word where the list is meant, which is one of letters."""
    if isinstance(value, str):
        raise ConfigError(f"{key}={value}: give a list, [{value}]")
    return [str(word) for word in value]


def check_choice(key: str, value: Any, allowed: Sequence[str]) -> str:
    """The value; ConfigError unless it is one of the allowed ones."""
    if value not in allowed:
        raise ConfigError(f"{key} must be one of {tuple(allowed)}, got {value!r}")
    return value


def check_of_use(key: str, value: object, usual: object, used: object, instead: str) -> None:
    """Refuse a setting that nothing reads, as the others are: its run would be another's copy.

    Args:
        key: as it stands on the command line.
        value, usual: as it is given, and what it is by itself: a value that nobody gave.
        used: whether something reads it.
        instead: what to set, so that something does.

    Raises:
        ConfigError: it is not `usual`, and nothing reads it.
    """
    if not used and value != usual:
        raise ConfigError(f"{key}={value} would have no effect; {instead}, or leave it at {usual}")


def check_keys(prefix: str, found: Iterable[str], known: Sequence[str]) -> None:
    """Raise ConfigError for the first key after `prefix` that nothing would read: +KEY adds any."""
    for key in found:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            hint = f"did you mean {prefix}{near[0]}?" if near else f"there are {', '.join(known)}"
            raise ConfigError(f"{prefix}{key} is no setting, nothing reads it; {hint}")


def check_ranges(settings: object, prefix: str = "", /, **ranges: str) -> None:
    """Check numbers of an object, e.g. `check_ranges(self, "sensor.", fill_px=">= 0")`.

    A range is as a message says it: "> 0", ">= 1", "odd >= 3", an interval such as "[0, 1)", or
    "odd [3, 15]". None passes; NaN, infinity and what is not a number do not.

    Raises:
        ConfigError: names the first that is outside, after `prefix`.
    """
    for name, allowed in ranges.items():
        if (value := getattr(settings, name)) is not None:
            _check_range(f"{prefix}{name}", value, allowed)


def check_order(settings: object, prefix: str, /, *names: str) -> None:
    """Raise ConfigError unless `min_NAME` is not above `max_NAME`, for each name."""
    for name in names:
        low, high = getattr(settings, f"min_{name}"), getattr(settings, f"max_{name}")
        if low > high:
            raise ConfigError(f"{prefix}min_{name}={low} is above {prefix}max_{name}={high}")


def _check_range(key: str, value: Any, allowed: str) -> None:
    if not _inside(value, allowed):
        word = "in " if allowed[0] in "[(" else ""
        raise ConfigError(f"{key} must be {word}{allowed}, got {value!r}")
    if math.isinf(value):
        raise ConfigError(f"{key} must be a finite number, got {value!r}")


def _inside(value: Any, allowed: str) -> bool:
    if isinstance(value, bool) or not isinstance(value, Real):
        return False
    value = float(value)
    if allowed.startswith("odd "):
        return bool(value % 2 == 1) and _inside(value, allowed.removeprefix("odd "))
    if allowed[0] in "[(":
        low, high = (float(end) for end in allowed[1:-1].split(","))
        above = value >= low if allowed[0] == "[" else value > low
        below = value <= high if allowed[-1] == "]" else value < high
        return bool(above and below)
    sign, bound = allowed.split()
    return bool(_COMPARE[sign](value, float(bound)))
