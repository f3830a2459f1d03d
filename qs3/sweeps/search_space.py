"""What a search varies: keys that it may vary, ranges that make sense, and words for Hydra."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import (
    ChoiceSweep,
    IntervalSweep,
    Override,
    QuotedString,
    RangeSweep,
)

from qs3.config.quoting import quoted
from qs3.errors import ConfigError

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

VARIED = ("method", "model", "protocol", "selftraining")
"""First words of the keys that may differ between runs of which an objective chooses one."""


def split(
    arguments: Sequence[str], params: Mapping[str, Any], parser: OverridesParser | None = None
) -> tuple[list[str], dict[str, Override]]:
    """Overrides that all runs share, and what is varied, by key.

    `params`: by key a value, or what to vary in Hydra's grammar for sweeps; `arguments` of the
    command line replace those of the same key.
    """
    parser = parser or OverridesParser.create()
    by_key = {one.get_key_element(): one for one in parser.parse_overrides(list(arguments))}
    for one in parser.parse_overrides([f"{key}={value}" for key, value in params.items()]):
        by_key.setdefault(one.get_key_element(), one)
    varied = {key: one for key, one in by_key.items() if one.is_sweep_override()}
    return [str(one.input_line) for key, one in by_key.items() if key not in varied], varied


def check_varied(varied: Iterable[Override]) -> None:
    """Refuse to vary what says how runs are judged, on which data, or what changes no result.

    Raises:
        ConfigError: a key is not below `VARIED`, or a group is put at a place that is not.
    """
    for one in varied:
        places = [one.key_or_group, *([one.package] if one.package else [])]
        if any(place.replace("/", ".").split(".")[0] not in VARIED for place in places):
            raise ConfigError(
                f"{one.input_line}: where objective= chooses among runs, they differ in "
                f"{', '.join(f'{root}.*' for root in VARIED)} alone, so that all are judged in the "
                f"same way; give {one.get_key_element()} one value"
            )


def distribution(one: Override) -> BaseDistribution:
    """What Optuna calls a sweep of Hydra's.

    Raises:
        ConfigError: the sweep is of another kind, or has nothing in it.
    """
    sweep: Any = one.value()
    key, log_scale = one.get_key_element(), "log" in getattr(sweep, "tags", ())
    try:
        if isinstance(sweep, ChoiceSweep):
            return _choice(sweep)
        if isinstance(sweep, IntervalSweep):
            return _numbers(sweep.start, sweep.end, log=log_scale)
        if isinstance(sweep, RangeSweep) and not log_scale:
            return _range(sweep)
    except ValueError as error:
        raise ConfigError(
            f"cannot search {one.input_line}: {error}; write {key}=interval(low,high) with "
            f"low < high, above 0 with tag(log,...), or {key}=range(start,end,step) with "
            "start < end and step > 0"
        ) from error
    raise ConfigError(
        f"cannot search {one.input_line}; write {key}=interval(low,high), "
        "range(start,end,step) or choice(a,b)"
    )


def _choice(sweep: ChoiceSweep) -> BaseDistribution:
    from optuna.distributions import CategoricalDistribution

    plain = [one.text if isinstance(one, QuotedString) else one for one in sweep.list]
    if odd := [one for one in plain if isinstance(one, list | dict)]:
        raise ValueError(f"{odd[0]} is not a word, number, true, false or null")
    return CategoricalDistribution(plain)  # type: ignore[arg-type]


def _range(sweep: RangeSweep) -> BaseDistribution:
    ends = (sweep.start, sweep.stop, sweep.step)
    if not all(math.isfinite(value or 0) for value in ends) or sweep.step <= 0:
        raise ValueError(f"{ends[0]} to {ends[1]} in steps of {ends[2]} does not run up to an end")
    values = list(sweep.range())  # without its end
    if not values:
        raise ValueError(f"{ends[0]} to {ends[1]} is empty")
    return _numbers(values[0], round(values[-1], 10), step=sweep.step)


def _numbers(low: Any, high: Any, **more: Any) -> BaseDistribution:
    """From low to high, whole numbers if both ends are.

    Raises:
        ValueError: an end is not finite, low > high, or a logarithm does not exist.
    """
    from optuna.distributions import FloatDistribution, IntDistribution

    if isinstance(low, int) and isinstance(high, int):
        return IntDistribution(low, high, **more)
    if not (math.isfinite(low) and math.isfinite(high)):
        raise ValueError(f"{low} to {high} is not an interval")
    return FloatDistribution(float(low), float(high), **more)


def words(params: Mapping[str, Any]) -> dict[str, str]:
    """A trial's values in Hydra's grammar: numbers with six digits, text quoted if need be."""
    return {
        key: quoted(one) if isinstance(one, str) else _plain(one) for key, one in params.items()
    }


def overrides(words: Mapping[str, str]) -> list[str]:
    """The words of a command line."""
    return [f"{key}={word}" for key, word in words.items()]


def _plain(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return f"{value:.6g}" if isinstance(value, float) else str(value)
