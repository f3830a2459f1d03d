"""Further overrides of a table's runs: for all columns, or for those that are named before them.

    report.pictures=false                      all columns
    R->A:data.target.published.file=FILE       the column "R → A" alone
    R->A,R->A0:data.target.published.file=FILE two columns

Columns have targets of their own, and a key that one target's config has another's lacks, or means
another file by. Columns are named as in `columns=`: the one of that name, else all whose names
contain the word; spaces do not count.
"""

from __future__ import annotations

import hashlib
import re
import shlex
from collections.abc import Iterable, Sequence

from qs3.config.hashing import is_hashed
from qs3.errors import ConfigError
from qs3.utils.hints import nearest

ALONE = 'for some columns alone: overrides="COLUMN:KEY=VALUE"'
_ELSEWHERE = {
    "seed": "each cell has several; which of them `qs3 report train` trains, seeds=0,1 says",
    "paths.log_dir": "the table would not look there; log_dir=FOLDER says where runs are",
}
"""What a table says itself of its runs, and how to say it."""
_LONGEST = 80


def by_column(words: Iterable[str], columns: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """The overrides of each column, in the order of `words`.

    Raises:
        ConfigError: a word is for columns of which there are none.
    """
    found: dict[str, list[str]] = {column: [] for column in columns}
    for word in words:
        named, override = _split(word)
        meant = chosen(columns, named)
        if lost := unknown(columns, named):
            raise ConfigError(
                f"overrides: {word}: no column has {' or '.join(map(repr, lost))} in its name; "
                f"columns are {', '.join(columns)}"
            )
        for column in columns:
            found[column] += [override] if column in meant else []
    return {column: tuple(own) for column, own in found.items()}


def check_words(words: Iterable[str]) -> None:
    """Raise ConfigError for what a table says itself of its runs: it would be passed over.

    Args:
        words: as a user gave them.
    """
    for word in words:
        if instead := _ELSEWHERE.get(_key(_split(word)[1])):
            raise ConfigError(f"overrides: {word}: {instead}")


def chosen(names: Iterable[str], words: Sequence[str]) -> set[str]:
    """Names that are meant by the words: the one that is the word, else all that contain it.

    Case and spaces do not count, unless two names differ in nothing else, and an arrow may be typed
    as "->"; words that commas have cut out of one name are that name again. No words mean all.
    """
    names = list(names)
    return set(names) if not words else set().union(*_meant(names, words).values())


def unknown(names: Iterable[str], words: Sequence[str]) -> list[str]:
    """The words that mean no name."""
    return [word for word, meant in _meant(list(names), words).items() if not meant]


def row_of(rows: Iterable[str], word: str, table: str) -> str:
    """The one row that `base=` means, by its words as `chosen` takes them.

    Raises:
        ConfigError: there is none, or there are several; says which.
    """
    rows = list(rows)
    if not word:
        raise ConfigError(f"against which row? give base=; rows are {', '.join(map(repr, rows))}")
    meant = [row for row in rows if row in chosen(rows, [word])]
    if len(meant) > 1:
        several = ", ".join(map(repr, meant))
        raise ConfigError(f"base={word} may be several rows of table {table}: {several}")
    if not meant:
        hint = f" (did you mean {near!r}?)" if (near := nearest(word, rows)) else ""
        named = ", ".join(map(repr, rows))
        raise ConfigError(f"table {table} has no row {word!r}{hint}; rows are {named}")
    return meant[0]


def file_name(*parts: str | None, columns: Sequence[str], overrides: str) -> str:
    """The name, without suffix, of the files of a table: of other runs it is another one.

    Args:
        parts: it begins with.
        columns: that were asked for.
        overrides: of its runs; of those that change no result the name says nothing.

    Raises:
        ConfigError: a quotation mark in `overrides` has no end.
    """
    matter = [w for w in shlex.split(overrides) if is_hashed(_key(_split(w)[1]))]
    settings = "-".join(re.sub(r"[^\w.=]+", "-", word).strip("-") for word in matter)
    if len(settings) > _LONGEST:
        settings = hashlib.sha256(settings.encode()).hexdigest()[:8]
    shown = (re.sub(r"\W+", "-", column).strip("-") for column in columns)
    return "-".join(part for part in (*parts, *shown, settings) if part)


def _meant(names: Sequence[str], words: Sequence[str]) -> dict[str, set[str]]:
    typed = {name: _typed(name) for name in names}
    found: dict[str, set[str]] = {}
    left = list(words)
    while left:
        many = range(len(left), 1, -1)
        n = next((n for n in many if _typed(",".join(left[:n])) in typed.values()), 1)
        word, left = ", ".join(left[:n]), left[n:]
        own = _typed(word)
        exact = {word} & {*typed} or {name for name, text in typed.items() if text == own}
        found[word] = exact or {name for name, text in typed.items() if own in text}
    return found


def _key(override: str) -> str:
    return override.lstrip("+~").partition("=")[0].partition("@")[0]


def _typed(name: str) -> str:
    return "".join(name.lower().replace("→", "->").split())


def _split(word: str) -> tuple[list[str], str]:
    """Names of columns before a colon, if any, and Hydra's override."""
    named, colon, override = word.partition(":")
    if not colon or "=" in named:  # a colon of a value
        return [], word
    return [name for name in named.split(",") if name.strip()], override
