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
    widths = _widths(rows)
    lines = ["  ".join(cells).rstrip() for cells in _padded(rows, widths, numbers)]
    return [lines[0], *["  ".join("-" * width for width in widths)] * rule, *lines[1:]]


def markdown(rows: Rows, *, numbers: bool = False) -> list[str]:
    """Lines of Markdown, which are readable as they are, too; for `numbers` see `aligned`.

    A `|` in a cell is escaped; what else Markdown reads as a sign is kept.
    """
    rows = [[cell.replace("|", r"\|") for cell in row] for row in rows]
    widths = _widths(rows)
    first, *lines = [f"| {' | '.join(cells)} |" for cells in _padded(rows, widths, numbers)]
    end = ":" if numbers else "-"
    rules = ["-" * (widths[0] + 2), *("-" * (width + 1) + end for width in widths[1:])]
    return [first, f"|{'|'.join(rules)}|", *lines]


def csv_text(rows: Iterable[Iterable[Any]]) -> str:
    r"""CSV whose lines end with `\n`; None is an empty cell, a float has all its digits."""
    lines = []
    for row in rows:
        file = io.StringIO(newline="")
        csv.writer(file).writerow(row)  # ended by \r\n it quotes cells with a \r of their own
        lines.append(file.getvalue().removesuffix("\r\n") + "\n")
    return "".join(lines)


def printable(text: str) -> str:
    """One line that a terminal and a table can show: what is not printable becomes escapes."""
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text
    )


def _widths(rows: Rows) -> list[int]:
    return [max(map(len, column)) for column in zip(*rows, strict=True)]


def _padded(rows: Rows, widths: Sequence[int], numbers: bool) -> list[list[str]]:
    right = [numbers and i > 0 for i in range(len(widths))]
    sides = [str.rjust if at_right else str.ljust for at_right in right]
    return [[f(c, w) for f, c, w in zip(sides, row, widths, strict=True)] for row in rows]
