"""What every HTML page of ours begins and ends with. Nothing in it comes from elsewhere."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1d2430; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
table { border-collapse: collapse; }
th, td { text-align: left; vertical-align: top; } th { font-weight: 500; color: #6b7482; }
pre { background: #f7f8fa; padding: .8rem; overflow-x: auto; font-size: 13px; }
"""


def html(title: str, parts: Iterable[str], style: str) -> str:
    """A page that can be sent as it is.

    Args:
        title: plain text, also the heading.
        parts: of the body below it, as HTML.
        style: CSS beyond that of all pages.
    """
    words = escape(title)
    return "\n".join(
        [
            "<!doctype html>",
            '<html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{words}</title><style>{_STYLE}{style.lstrip()}</style></head><body>",
            f"<h1>{words}</h1>",
            *parts,
            "</body></html>",
            "",
        ]
    )
