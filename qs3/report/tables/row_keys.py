"""The keys that a row of a table's file may have: a misspelt one would be a cell left empty.

Likewise no seeds at all: nothing would be trained, and a command be shown that cannot be typed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from qs3.errors import ConfigError
from qs3.utils.hints import nearest

CELL = ("run", "paper", "take", "first", "selected", "source")
ROW = ("name", "seeds", "columns", "factors", "average", *CELL)


def check_keys(rows: Iterable[Mapping[str, Any]], columns: Sequence[str]) -> None:
    """Raise ConfigError at the first key that is neither one of a row's nor a column, or a cell's.

    And at a row that wants no seeds.

    Args:
        rows: as in the file; each has a name.
        columns: names of the table's.
    """
    for row in rows:
        place = f"table row {row['name']!r}"
        _check(row, (*columns, *ROW), f"{place}: ", "a column or a key of rows")
        seeds = row.get("seeds", 1)
        if type(seeds) is not int or seeds < 1:
            raise ConfigError(
                f"{place}: seeds: is how many there should be, 1 or more, got {seeds!r}"
            )
        for column in columns:
            if isinstance(cell := row.get(column), Mapping):
                _check(cell, CELL, f"{place}, {column!r}: ", "a key of cells")


def _check(given: Iterable[Any], known: Sequence[str], place: str, what: str) -> None:
    for key in given:
        if key not in known:
            near = nearest(str(key), known)
            hint = f"did you mean {near}?" if near else f"there are {', '.join(known)}"
            raise ConfigError(f"{place}{key} is not {what}; {hint}")
