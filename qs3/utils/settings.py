"""One declaration of a setting: a frozen dataclass whose types and ranges pydantic checks.

    @settings
    class Camera:
        focal_px: Annotated[float, Gt(0)]
        mode: Literal["near", "far"] = "near"

A function, or the `__init__` of a class with a state of its own, is `@checked` instead.
Ranges are those of `annotated_types` (Ge, Gt, Le, Lt, Interval). `qs3.config.hydra.build` turns a
pydantic error into a ConfigError that names the place in the config; elsewhere it is a ValueError.
"""

import dataclasses
from collections.abc import Callable
from typing import Annotated, Any, TypeVar, dataclass_transform

from annotated_types import Ge, Gt, Interval, Predicate
from pydantic import ConfigDict, ValidationError, validate_call
from pydantic.dataclasses import dataclass as _dataclass

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])

Positive = Annotated[float, Gt(0)]
NotNegative = Annotated[float, Ge(0)]
Share = Annotated[float, Interval(ge=0, le=1)]
Count = Annotated[int, Ge(1)]


IsOdd = Predicate(lambda value: value % 2 == 1)

_CONFIG = ConfigDict(arbitrary_types_allowed=True, extra="forbid", allow_inf_nan=False)


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def settings(cls: type[T]) -> type[T]:
    """A frozen dataclass that checks its fields when it is made; unknown arguments are errors."""
    made: type[T] = _dataclass(frozen=True, config=_CONFIG)(cls)  # type: ignore[assignment]
    return made


def checked(function: F) -> F:
    """A function that checks the types and ranges of its arguments."""
    return validate_call(config=_CONFIG)(function)


def problems(error: ValidationError, place: str = "") -> str:
    """A pydantic ValidationError in a line: each key with what is wrong."""
    lines = []
    for one in error.errors(include_url=False):
        where = ".".join([place] * bool(place) + [str(p) for p in one["loc"] if isinstance(p, str)])
        if one["type"].startswith("missing"):
            lines.append(f"{where}= is missing")
        elif one["type"] == "assertion_error":  # of several fields together
            lines.append(f"{where}: {one['msg'].removeprefix('Assertion failed, ')}")
        else:
            lines.append(f"{where}: {one['msg']}, got {one['input']!r}")
    return "; ".join(lines)
