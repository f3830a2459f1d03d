"""Tables of words, header first, as aligned text, Markdown and CSV."""

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any

Rows = Sequence[Sequence[str]]


def aligned(rows: Rows, *, numbers: bool = False, rule: bool = True) -> list[str]:
    """Lines for a terminal: columns as wide as their widest entry, two spaces between them.

    With `numbers` all columns but the first are flush right; `rule` is dashes below the header.
    """
    padded = _padded(rows, numbers)
    first, *lines = ["  ".join(cells).rstrip() for cells in padded]
    rules = ["  ".join("-" * len(cell) for cell in padded[0])] if rule else []
    return [first, *rules, *lines]


def markdown(rows: Rows) -> list[str]:
    """Lines of Markdown, which are readable as they are, too.

    A `|` in a cell is escaped; what else Markdown reads as a sign is kept.
    """
    rows = [[cell.replace("|", r"\|") for cell in row] for row in rows]
    padded = _padded(rows, numbers=False)
    first, *lines = [f"| {' | '.join(cells)} |" for cells in padded]
    rule = "|".join("-" * (len(cell) + 2) for cell in padded[0])
    return [first, f"|{rule}|", *lines]


def csv_text(rows: Iterable[Iterable[Any]]) -> str:
    r"""CSV whose lines end with `\n`; None is an empty cell, a float has all its digits."""
    file = io.StringIO(newline="")
    csv.writer(file, lineterminator="\n").writerows(rows)
    return file.getvalue()


def printable(text: str) -> str:
    """One line that a terminal and a table can show: what is not printable becomes escapes."""
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text
    )


def _padded(rows: Rows, numbers: bool) -> list[tuple[str, ...]]:
    columns = []
    for i, column in enumerate(zip(*rows, strict=True)):
        width = max(map(len, column))
        pad = str.rjust if numbers and i else str.ljust
        columns.append([pad(cell, width) for cell in column])
    return list(zip(*columns, strict=True))
