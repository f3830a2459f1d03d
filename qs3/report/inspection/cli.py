"""`qs3 inspect` and `qs3 compare`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from qs3.errors import ConfigError
from qs3.utils.cli import Command, Option, path, text, whole

_COMMON = (
    Option(
        "data_dir", text("FOLDER"), "where datasets lie, paths.data_dir of a run (default: data)"
    ),
    Option("sample", whole(), "clouds measured one by one; larger sets are drawn from", 3000),
    Option("seed", whole(0), "of all random draws (default 0)", 0),
)
_KEYS = "of the domain's config, e.g. variant=points_clean path=PATH published.folder=PATH"


def _inspect(
    domain: str,
    data_dir: str | None,
    out: str | None,
    sheets: int,
    more: Sequence[str],
    **given: Any,
) -> None:
    from qs3.report.inspection.command import Bounds, inspect_command

    print(inspect_command(domain, _overrides(data_dir, more), Bounds(**given), out, sheets))


def _compare(
    words: Sequence[str],
    data_dir: str | None,
    out: str | None,
    more: Sequence[str],
    **given: Any,
) -> None:
    if len(words) != 2:
        got = " ".join(words) or "none"
        raise ConfigError(f"compare takes two domains, names or folders: compare A B; got {got}")
    from qs3.report.inspection.command import Bounds, compare_command

    sides: dict[str, dict[str, str]] = {"a": {}, "b": {}}
    for key, value in _overrides(data_dir, more).items():
        side, _, rest = key.partition(".")
        for name in [side] if side in sides else sides:
            sides[name][rest if side in sides else key] = value
    a, b = zip(words, sides.values(), strict=True)
    print(compare_command(a, b, Bounds(**given), out))


def _overrides(data_dir: str | None, more: Sequence[str]) -> dict[str, str]:
    first = {"paths.data_dir": data_dir} if data_dir else {}
    return first | dict(word.split("=", 1) for word in more)


INSPECT = Command(
    "qs3 inspect",
    "what a dataset is like, before training on it",
    _inspect,
    (
        Option(
            "domain",
            text("NAME|FOLDER"),
            "of conf/domain, or a dataset's folder; domain= may be left out",
            required=True,
        ),
        *_COMMON,
        Option("sheets", whole(0), "clouds of each class on its sheet; 0: no sheets", 48),
        Option("out", text("FOLDER"), "where pages and pictures go (default out/inspection/NAME)"),
    ),
    (
        "qs3 inspect modelnet10",
        "qs3 inspect domain=own published.folder=scans",
        "qs3 inspect data/specklenet10 variant=points_clean",
    ),
    about="""
What it is made of, counts by class and split, sizes, which way is up by the shape, spacing,
density, coverage, copies, leaks from train to test, odd objects; a contact sheet of all classes and
one of each (sheets/CLASS.png, with tiers), and a page where clouds can be turned. Published files
are imported first.
""",
    bare="domain",
    others={"": _KEYS},
    interrupted="nothing was saved but frames that an import had cut: the same command goes on",
)

COMPARE = Command(
    "qs3 compare",
    "two datasets and the gap between them",
    _compare,
    (
        *_COMMON,
        Option(
            "meshes",
            path("FOLDER"),
            "meshes that they were generated from (default: the catalogue's)",
        ),
        Option("out", text("FOLDER"), "where text and pictures go (default out/inspection/A-B)"),
    ),
    (
        "qs3 compare modelnet10 specklenet10",
        "qs3 compare specklenet10 specklenet10 a.variant=points_clean",
        "qs3 compare roomscan10 objects b.published.file=FILE b.published.fold=0",
    ),
    about="""
What they are made of, class frequencies, spacing, density, coverage, distance to the true surface
and how much of it was measured (of generated datasets), how well clouds tell their domain;
one object of each class from both, as a picture.
""",
    words="A B",
    others={"": f"{_KEYS}, of both; a.KEY and b.KEY of one"},
    interrupted="nothing was saved but frames that an import had cut: the same command goes on",
)
