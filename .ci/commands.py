"""Puts the help of every command, which its declaration gives, under docs/reference/commands.md."""

import contextlib
import io

from qs3.__main__ import COMMANDS
from qs3.utils.commands import run


def on_page_markdown(markdown, page, **_):
    """See mkdocs' hooks."""
    if page.file.src_path != "reference/commands.md":
        return None
    names = [[name] for name, where in COMMANDS.items() if isinstance(where, str)]
    names += [["report", name] for name in COMMANDS["report"] if name]
    parts = [markdown]
    for words in sorted(names):
        with contextlib.redirect_stdout(io.StringIO()) as shown:
            run(COMMANDS, [*words, "--help"])
        parts.append(f"\n## qs3 {' '.join(words)}\n\n```text\n{shown.getvalue().strip()}\n```\n")
    return "".join(parts)
