"""A table's file: its rows and columns, published numbers, and the command behind each cell.

A file of conf/table/ has `columns`, a list of names or a mapping from names to overrides (null for
columns of published numbers alone), and `rows`. A row's `run` is a command line of train.py that
is followed by the overrides of each column; its `paper` has a published number a column, in
percent, or [mean, SEM]. An entry under a column's name, `<column>: {run:, paper:, ...}`, is for
that cell alone.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from annotated_types import Ge, Interval, MinLen
from pydantic import ConfigDict, TypeAdapter
from pydantic.dataclasses import dataclass

from qs3.config.location import CONF
from qs3.errors import ConfigError
from qs3.utils.files import reading

_STRICT = ConfigDict(extra="forbid")
_Percent = Annotated[float, Interval(ge=0, le=100)]
_SHARED = ("selected", "source", "take", "first")  # keys of cells that a row may have for all

Metric = Literal[
    "accuracy", "balanced_accuracy",
    "accuracy_clean", "accuracy_hard", "balanced_accuracy_clean", "balanced_accuracy_hard",
]  # fmt: skip
"""What a table can show: scores of all clouds, or of one tier of a dataset that has tiers."""


@dataclass(frozen=True, config=_STRICT)
class Entry:
    """One cell.

    Attributes:
        run: overrides of train.py; None: a published number alone.
        paper: published, in percent; with its SEM if there is one.
        selected: how the epoch of the published number was chosen.
        source: where it was read; a key of the file's `sources`, or text.
        take: "warmup": the run's teacher before self-training, which equals the result of the same
            run with selftraining=none.
        first: its runs are started before those of other cells.
    """

    run: str | None = None
    paper: _Percent | tuple[_Percent, _Percent] | None = None
    selected: str = ""
    source: str = ""
    take: Literal["final", "warmup"] = "final"
    first: bool = False

    @property
    def numbers(self) -> tuple[float, ...]:
        """The published number, and its SEM if it has one; () if there is none."""
        if self.paper is None:
            return ()
        return self.paper if isinstance(self.paper, tuple) else (self.paper,)

    @property
    def published(self) -> str:
        """Such as "72.4 ± 0.8"; "" if there is none."""
        return " ± ".join(f"{number:.1f}" for number in self.numbers)


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class _Column:
    """Overrides of a column, and how many seeds it has where rows have more."""

    run: str
    seeds: Annotated[int, Ge(1)] = 1000


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class Row:
    """One row: its cells by column, and how many seeds each should have.

    `factors` has the level of each factor, of rows that cross several, such as two selectors by two
    schemes; `average` is published, where the last digit is not that of the numbers' mean.
    """

    name: str
    cells: dict[str, Entry]
    seeds: Annotated[int, Ge(1)] = 3
    factors: dict[str, str] = field(default_factory=dict)
    average: float | None = None


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class Spec:
    """A table's file; with `averages` it has a column of averages over all others."""

    title: str
    metrics: Annotated[list[Metric], MinLen(1)]
    columns: dict[str, _Column | None]
    rows: list[Row]
    averages: bool = False
    notes: list[str] = field(default_factory=list)
    sources: dict[str, str] = field(default_factory=dict)


def read_spec(name: str, more_rows: Sequence[Mapping[str, Any]] = ()) -> tuple[str, Spec]:
    """A table's name and content, with further rows as in the file.

    `name` is of a file in conf/table, or the path of one's own, NAME.yaml.
    """
    path = Path(name) if name.endswith(".yaml") else CONF / "table" / f"{name}.yaml"
    with reading(path):
        plain = yaml.safe_load(path.read_text(encoding="utf-8"))
        columns = plain["columns"]
        columns = dict.fromkeys(columns, "") if isinstance(columns, list) else columns
        plain["columns"] = {
            name: {"run": run} if isinstance(run, str) else run for name, run in columns.items()
        }
        plain["rows"] = [_row(row, plain) for row in [*plain["rows"], *more_rows]]
        spec = TypeAdapter(Spec).validate_python(plain)
        if twice := [name for name, n in Counter(r.name for r in spec.rows).items() if n > 1]:
            raise ValueError(f"two rows are called {twice[0]!r}")
    return path.stem, spec


def _row(row: Mapping[str, Any], spec: Mapping[str, Any]) -> dict[str, Any]:
    """A row with an entry for each column that it has a run or a published number for."""
    row, columns = dict(row), spec["columns"]
    run, numbers = row.pop("run", None), row.pop("paper", None)
    meant = row.pop("columns", [*columns])
    if lost := {*meant} - {*columns}:
        raise KeyError(f"{row['name']}: columns: {lost.pop()}")
    shared = {key: row.pop(key) for key in _SHARED if key in row}
    cells = {}
    for name, number in zip(columns, numbers or [None] * len(columns), strict=True):
        cell = {"paper": number, **shared, **row.pop(name, {})}
        if run is not None and columns[name] is not None and name in meant:
            cell.setdefault("run", f"{run} {columns[name]['run']}")
        if cell.get("run") is not None or cell["paper"] is not None:
            source = cell.get("source", "")
            cells[name] = {**cell, "source": spec.get("sources", {}).get(source, source)}
    return {**row, "cells": cells}


def by_column(words: Iterable[str], columns: Sequence[str]) -> dict[str, list[str]]:
    """The overrides of each column, in the order of `words`.

    A word such as "R->A,R->A0:data.target.published.file=FILE" is for these columns alone.
    """
    found: dict[str, list[str]] = {column: [] for column in columns}
    for word in words:
        named, colon, override = word.partition(":")
        if not colon or "=" in named:  # a colon of a value
            named, override = "", word
        for column in chosen(columns, named.split(",") if named else []):
            found[column].append(override)
    return found


def chosen(names: Iterable[str], words: Sequence[str]) -> list[str]:
    """Names that are meant by the words: the one that is the word, else all that contain it.

    Case and spaces do not count, and an arrow may be typed as "->". No words mean all names.
    """
    plain = {name: re.sub(r"\s", "", name.lower().replace("→", "->")) for name in names}
    meant: set[str] = set() if words else {*plain}
    for given in words:
        word = re.sub(r"\s", "", given.lower().replace("→", "->"))
        found = [name for name in plain if plain[name] == word]
        found = found or [name for name in plain if word in plain[name]]
        if not found:
            raise ConfigError(f"no name has {given!r}; there are {', '.join(plain)}")
        meant.update(found)
    return [name for name in plain if name in meant]
