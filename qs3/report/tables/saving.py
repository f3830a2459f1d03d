"""A table's files: written together, and whether another table lay there is said.

Their names know of columns and overrides (`overrides.file_name`), and nothing of where the results
come from (`kept=`) or what they are compared with (`base=`): files of one name may hold others.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from qs3.utils.files import write_text


def save(at: str | Path, texts: Mapping[str, str]) -> str:
    """Write the texts, by suffix, beside each other; returns what to say of it.

    Args:
        at: path without suffix.
        texts: such as {".md": ..., ".csv": ...}.
    """
    files = {Path(f"{at}{suffix}"): text for suffix, text in texts.items()}
    other = any(_differs(path, text) for path, text in files.items())
    for path, text in files.items():
        write_text(path, text)
    first, *more = texts
    replaced = " (replaced what was there; out=FOLDER would keep both)" if other else ""
    return f"saved {', '.join([f'{at}{first}', *more])}{replaced}"


def _differs(path: Path, text: str) -> bool:
    """Whether a file lies there that says something else."""
    return path.exists() and (not path.is_file() or path.read_bytes() != text.encode())
