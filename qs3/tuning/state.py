"""How far a search is, in a file that it goes on from."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from qs3.errors import ConfigError, DataError
from qs3.utils.files import write_json
from qs3.utils.memory import JSON_PEAK, read_whole


@dataclass
class State:
    """Of a search by Adam (Kingma and Ba, ICLR 2015, algorithm 1).

    Attributes:
        settings: text of all that decides the search; another one does not go on from here.
        numbers: the free numbers, see `parameters.free`.
        mean, square: Adam's moments of their slopes.
        distances: before each step, of that step's objects by the ordinary sensor.
        path: the free numbers before each step.
    """

    settings: str
    numbers: list[float]
    mean: list[float]
    square: list[float]
    distances: list[float] = field(default_factory=list)
    path: list[list[float]] = field(default_factory=list)

    @property
    def steps(self) -> int:
        """Steps that are done."""
        return len(self.distances)

    def write(self, path: Path) -> None:
        """Replace the file, whole or not at all."""
        write_json(path, asdict(self))


def read_state(path: Path, settings: str) -> State | None:
    """The state in a file, None without one.

    Raises:
        DataError: it cannot be read.
        ConfigError: it is of other settings.
    """
    if not path.exists():
        return None
    try:
        found = json.loads(read_whole(path, JSON_PEAK))
        state = State(**found)
        _check(state)
    except (OSError, ValueError, TypeError, RecursionError, OverflowError) as error:
        raise DataError(f"{path} is no search of qs3 tune ({error}): delete it") from error
    if state.settings != settings:
        raise ConfigError(
            f"{path} is a search with other settings: give another out=, or delete it to start over"
        )
    return state


def _check(state: State) -> None:
    count = len(state.numbers)
    rows: list[Any] = [state.numbers, state.mean, state.square, state.distances, *state.path]
    if not isinstance(state.settings, str) or not isinstance(state.path, list):
        raise ValueError("wrong kinds of values")
    for row in rows:
        if not isinstance(row, list) or not all(
            type(value) is float and math.isfinite(value) for value in row
        ):
            raise ValueError("lists of numbers are expected")
    if any(len(row) != count for row in (state.mean, state.square, *state.path)):
        raise ValueError("lists of different lengths")
    if len(state.path) != len(state.distances) or min(state.square, default=0.0) < 0:
        raise ValueError("steps that do not fit each other")
