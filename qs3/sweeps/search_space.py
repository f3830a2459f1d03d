"""What a search varies: keys that it may vary, ranges that make sense, and words for Hydra."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hydra.core.config_loader import ConfigLoader
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

_JUDGES = "all trials have to be judged in the same way, which is settled before the search"
_PROBLEM = "scores on other data, or of another problem, say nothing about which setting is better"
_NO_MATTER = "it changes no result, so that there is nothing to choose"
_REFUSED = {
    **dict.fromkeys(("objective", "selection"), _JUDGES),
    **dict.fromkeys(("data", "domain", "experiment", "num_classes", "evaluation"), _PROBLEM),
    "debug": "it belongs to single runs",
    **dict.fromkeys(
        (
            *("paths", "logger", "report", "force", "ckpt_path", "experiment_name"),
            *("hparams_search", "hydra"),
        ),
        _NO_MATTER,
    ),
}
"""By the first word of a key: why no search varies it."""


def split(
    arguments: Sequence[str], params: Mapping[str, Any], loader: ConfigLoader
) -> tuple[list[str], dict[str, Override]]:
    """Overrides that all trials share, and what is searched, by key.

    Args:
        arguments: of the command line; they replace `params` of the same key.
        params: by key a value, or what to search in Hydra's grammar for sweeps.
        loader: Hydra's.

    Raises:
        ConfigError: there is nothing to search, or something that no search may vary.
    """
    parse = OverridesParser.create(config_loader=loader)
    by_key = {o.get_key_element(): o for o in parse.parse_overrides(list(arguments))}
    for one in parse.parse_overrides([f"{key}={value}" for key, value in params.items()]):
        by_key.setdefault(one.get_key_element(), one)  # what was typed counts
    searched = {key: one for key, one in by_key.items() if one.is_sweep_override()}
    for one in searched.values():
        _refuse(one)
    if not searched:
        raise ConfigError(
            "there is nothing to search; set hydra.sweeper.params, or key='interval(low,high)'"
        )
    return [str(o.input_line) for o in by_key.values() if not o.is_sweep_override()], searched


def _refuse(one: Override) -> None:
    """Raise for a key that no search varies, also for a group that is put at such a place."""
    for place in (one.key_or_group, one.package or ""):
        root = place.replace("/", ".").split(".")[0]
        if root == "seed":
            raise ConfigError(
                "a search tries each setting with one seed, because seeds are nothing to choose "
                "by; give one seed, and repeat the best setting with several afterwards"
            )
        if root in _REFUSED:
            raise ConfigError(
                f"{one.input_line} cannot be searched: {_REFUSED[root]}; give "
                f"{one.get_key_element()} one value"
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
            return _interval(sweep, log_scale)
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
        raise ValueError(f"{odd[0]} is no word, number, true, false or null")
    return CategoricalDistribution(plain)  # type: ignore[arg-type]


def _interval(sweep: IntervalSweep, log_scale: bool) -> BaseDistribution:
    from optuna.distributions import FloatDistribution, IntDistribution

    low, high = sweep.start, sweep.end
    assert low is not None
    assert high is not None
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ValueError(f"{low} to {high} is no interval")
    if log_scale and low <= 0:
        raise ValueError(f"{low} has no logarithm")
    if isinstance(low, int) and isinstance(high, int):
        return IntDistribution(low, high, log=log_scale)
    return FloatDistribution(float(low), float(high), log=log_scale)


def _range(sweep: RangeSweep) -> BaseDistribution:
    from optuna.distributions import FloatDistribution, IntDistribution

    ends = (sweep.start, sweep.stop, sweep.step)
    start, stop, step = (float(value or 0) for value in ends)
    if not (all(map(math.isfinite, (start, stop, step))) and start < stop and step > 0):
        raise ValueError(f"{ends[0]} to {ends[1]} in steps of {ends[2]} is empty, or runs down")
    values = list(sweep.range())  # without its end
    if all(isinstance(value, int) for value in values):
        return IntDistribution(int(values[0]), int(values[-1]), step=int(sweep.step))
    return FloatDistribution(float(values[0]), round(float(values[-1]), 10), step=float(sweep.step))


def words(params: Mapping[str, Any]) -> dict[str, str]:
    """A trial's values in Hydra's grammar: numbers with six digits, text quoted if need be."""
    return {
        key: quoted(one) if isinstance(one, str) else _plain(one) for key, one in params.items()
    }


def overrides(words: Mapping[str, str]) -> list[str]:
    """Of the command line."""
    return [f"{key}={word}" for key, word in words.items()]


def _plain(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return f"{value:.6g}" if isinstance(value, float) else str(value)
