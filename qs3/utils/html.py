"""What every page in HTML is made of. Pages have all in themselves: style, pictures, scripts."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape


def document(title: str, style: str, parts: Iterable[str], *, policy: str = "") -> str:
    """A page headed by its title, with `style` and `parts` as they are.

    `policy` says what a browser may run and load (Content-Security-Policy), which is all that
    comes behind it; "" leaves that to the browser.
    """
    rule = f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n' if policy else ""
    return "\n".join(
        [
            '<!doctype html><html lang="en"><head><meta charset="utf-8">',
            f'{rule}<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}</title><style>{style}</style></head><body>",
            f"<h1>{escape(title)}</h1>",
            *parts,
            "</body></html>\n",
        ]
    )


def table(rows: Iterable[Sequence[str]], *, head: str = "") -> str:
    """Rows of plain text, headed by the first "row" or "column" if `head` says so."""

    def cell(text: str, row: int, column: int) -> str:
        kind = "th" if (head, 0) in (("row", row), ("column", column)) else "td"
        return f"<{kind}>{escape(text)}</{kind}>"

    lines = ("".join(cell(text, i, j) for j, text in enumerate(row)) for i, row in enumerate(rows))
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"


def image(png: bytes, words: str) -> str:
    """A picture with the words to be read in its place."""
    data = base64.b64encode(png).decode("ascii")
    return f'<img alt="{words}" src="data:image/png;base64,{data}">'
