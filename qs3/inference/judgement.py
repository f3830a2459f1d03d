"""What `qs3 report judge out=FILE.json` found of one run on real objects, for its card."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field

from qs3.errors import ConfigError
from qs3.utils.json_file import read_json

_Share = Annotated[float, Field(ge=0, le=1)]


def _printable(value: str) -> str:
    if not value.isprintable():
        raise ValueError("should be printable")
    return value


_Word = Annotated[str, Field(max_length=64), AfterValidator(_printable)]


@dataclass(frozen=True)
class Interval:
    """A share and its interval at 95 %; see `qs3.report.intervals`."""

    mean: _Share
    low: _Share | None
    high: _Share | None

    def __str__(self) -> str:
        """Such as "56.4 % [52.3, 60.5]"."""
        ends = (
            ""
            if self.low is None or self.high is None
            else f" [{percent(self.low)}, {percent(self.high)}]"
        )
        return f"{percent(self.mean)} %{ends}"


@dataclass(frozen=True)
class Tier:
    """Figures on the objects of one tier; see `qs3.report.judge.Figures`."""

    tier: _Word
    n: int
    accuracy: Interval
    balanced: Interval
    majority: _Share
    recall: dict[_Word, _Share]
    counts: dict[_Word, int]


@dataclass(frozen=True)
class Judgement:
    """Of one run.

    Attributes:
        data: name of the archive.
        part: of it that was judged on; "" for all.
        tiers: the first is all objects.
    """

    data: str
    part: str
    tiers: tuple[Tier, ...]

    @property
    def sentence(self) -> str:
        """For a terminal."""
        every, part = self.tiers[0], f", part {self.part}" if self.part else ""
        others = "".join(
            f", {one.tier} ones {percent(one.accuracy.mean)} %" for one in self.tiers[1:]
        )
        return (
            f"right about {every.accuracy} of {every.n} real objects ({self.data}{part}){others}; "
            f"balanced over classes {percent(every.balanced.mean)} %; always the commonest class "
            f"{percent(every.majority)} %"
        )


@dataclass(frozen=True)
class _Family:
    runs: tuple[str, ...]
    figures: Annotated[tuple[Tier, ...], Field(min_length=1, max_length=3)]


@dataclass(frozen=True)
class _File:
    data: Annotated[str, AfterValidator(_printable)]
    part: _Word
    families: tuple[_Family, ...]


def read_judgement(path: Path, run: Path) -> Judgement:
    """What the file says of a run, which it must have judged alone.

    Args:
        path: of the file, JSON.
        run: the run's result file.

    Raises:
        DataError: the file cannot be read, or is damaged.
        ConfigError: it does not tell of this run, or of its family only.
    """
    if path.suffix.lower() != ".json":
        raise ConfigError(f"judged={path}: give the .json of `qs3 report judge runs=... out=...`")
    found = read_json(path, _File, "qs3 report judge")
    for family in found.families:
        if run.resolve() in [Path(name).resolve() for name in family.runs]:
            if len(family.runs) > 1:
                raise ConfigError(
                    f"{path} tells of {len(family.runs)} seeds together; judge {run.parent} alone"
                )
            name = Path(found.data).name[:200]
            return Judgement(name, found.part, family.figures)
    raise ConfigError(f"{path} does not tell of {run}; judge it: qs3 report judge runs={run}")


def percent(share: float) -> str:
    """Such as "56.4"."""
    return f"{100 * share:.1f}"
