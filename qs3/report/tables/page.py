"""A table as one HTML page. Nothing in it comes from elsewhere, so it can be sent as it is."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from qs3.report.figures.html_page import html
from qs3.report.tables.cells import INCOMPLETE, Table
from qs3.report.tables.formats import TO_RUN, details, grid, marks, remarks, to_run

_STYLE = """
body { max-width: 76rem; }
.wide { overflow-x: auto; }
table { font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .9rem .25rem 0; }
td { white-space: nowrap; }
tr { border-bottom: 1px solid #e3e6eb; }
tr > :first-child { position: sticky; left: 0; background: #fff; white-space: normal;
  min-width: 8rem; }
li { overflow-wrap: anywhere; }
.mark { background: #fdf3dc; border-left: 4px solid #c98a1b; padding: .4rem .8rem; }
.warn { color: #a4441a; }
.published { color: #6b7482; }
pre { user-select: all; }
"""


def page(table: Table) -> str:
    """Title, what must not be overlooked, table, remarks, each number, commands to copy."""
    notes = [remark for remark in remarks(table) if remark not in marks(table)]
    parts = [
        *(f'<p class="mark">{escape(mark)}</p>' for mark in marks(table)),
        _table(grid(table)),
        "<h2>Remarks</h2><ul>",
        *(f"<li>{escape(note)}</li>" for note in notes),
        "</ul>",
    ]
    if len(behind := details(table)) > 1:
        parts += ["<h2>Behind each number</h2>", _table(behind)]
    if commands := to_run(table):
        parts.append(f"<h2>{TO_RUN}</h2>")
        parts += [f"<pre>{escape(command)}</pre>" for command in commands]
    return html(table.title, parts, _STYLE)


def _table(lines: Sequence[Sequence[str]]) -> str:
    header, *body = lines
    rows = ["<tr>" + "".join(f"<th>{escape(cell)}</th>" for cell in header) + "</tr>"]
    for line in body:
        kind = ' class="published"' if "published" in line[1:2] else ""
        rows.append(f"<tr{kind}>" + "".join(map(_cell, line)) + "</tr>")
    return '<div class="wide"><table>\n' + "\n".join(rows) + "\n</table></div>"


def _cell(text: str) -> str:
    kind = ' class="warn"' if INCOMPLETE in text or text.startswith("not ") else ""
    return f"<td{kind}>{escape(text)}</td>"
