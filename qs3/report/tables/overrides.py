"""Further overrides of a table's runs: for all columns, or for those that are named before them.

    report.pictures=false                      all columns
    R->A:data.target.published.file=FILE       the column "R → A" alone
    R->A,R->A0:data.target.published.file=FILE two columns

Columns have targets of their own, and a key that one target's config has another's lacks, or means
another file by. Columns are named as in `columns=`: the one of that name, else all whose names
contain the word; spaces do not count.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from qs3.errors import ConfigError

ALONE = 'for some columns alone: overrides="COLUMN:KEY=VALUE"'


def by_column(words: Iterable[str], columns: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """The overrides of each column, in the order of `words`.

    Raises:
        ConfigError: a word is for columns of which there are none.
    """
    found: dict[str, list[str]] = {column: [] for column in columns}
    for word in words:
        named, override = _split(word)
        meant = chosen(columns, named) if named else set(columns)
        if not meant:
            raise ConfigError(
                f"overrides: {word}: no column has {' or '.join(map(repr, named))} in its name; "
                f"columns are {', '.join(columns)}"
            )
        for column in columns:
            found[column] += [override] if column in meant else []
    return {column: tuple(own) for column, own in found.items()}


def chosen(names: Iterable[str], words: Sequence[str]) -> set[str]:
    """Names that are meant by the words: the one that is the word, else all that contain it.

    Case and spaces do not count, unless two names differ in nothing else, and an arrow may be typed
    as "->"; no words mean all.
    """
    typed = {name: _typed(name) for name in names}
    if not words:
        return set(typed)
    found: set[str] = set()
    for word, own in zip(words, map(_typed, words), strict=True):
        exact = {word} & {*typed} or {name for name, text in typed.items() if text == own}
        found |= exact or {name for name, text in typed.items() if own in text}
    return found


def _typed(name: str) -> str:
    return "".join(name.lower().replace("→", "->").split())


def _split(word: str) -> tuple[list[str], str]:
    """Names of columns before a colon, if any, and Hydra's override."""
    named, colon, override = word.partition(":")
    if not colon or "=" in named:  # a colon of a value
        return [], word
    return [name for name in named.split(",") if name.strip()], override
