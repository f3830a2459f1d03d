"""The paper's tables and the field's benchmarks, with our numbers next to theirs.

A table is a file of conf/table/. Each cell names a run by its command line; composing it gives the
config hash by which the runs of its seeds are found under the log folder. This module reads the
file and finds the runs; `formats` prints.
"""

from __future__ import annotations

import difflib
import functools
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from qs3.config.compose import composing, first_line
from qs3.config.location import CONF
from qs3.config.quoting import override
from qs3.errors import ConfigError, DataError
from qs3.report.tables.aggregate import Group, group, load_runs
from qs3.report.tables.cells import SEEDS, Cell, Metric, Published, Table
from qs3.report.tables.keeping import with_kept
from qs3.report.tables.overrides import ALONE, by_column, check_words, chosen, unknown
from qs3.report.tables.row_keys import check_keys
from qs3.utils.memory import YAML_PEAK, read_whole
from qs3.utils.plural import counted
from qs3.utils.yamls import load_yaml

_SUPERVISED = "qs3.methods.bounds.Supervised"


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid"))
class _Column:
    """A column with fewer seeds than its rows have."""

    run: str
    seeds: Annotated[int, Field(ge=1)]


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid"))
class _Spec:
    """A table's file; a row's entries are `_cell`'s business."""

    title: str
    metrics: Annotated[list[Metric], Field(min_length=1)]
    columns: list[str] | dict[str, str | _Column | None]
    rows: list[dict[str, Any]]
    layout: Literal["", "benchmark"] = ""
    notes: list[str] = field(default_factory=list)
    sources: dict[str, str] = field(default_factory=dict)
    costs: bool = False


def table_names() -> list[str]:
    """The tables there are."""
    return sorted(path.stem for path in (CONF / "table").glob("*.yaml"))


def build_table(
    name: str,
    log_dir: str | Path = "logs",
    extra: Sequence[str] = (),
    target: str | None = None,
    kept: str | Path | None = None,
    rows: Sequence[Mapping[str, Any]] = (),
    columns: Sequence[str] = (),
    runs: bool = True,
) -> Table:
    """Read a table's file and find our runs of its cells.

    Args:
        name: of a file in conf/table, or the path of one's own, NAME.yaml.
        log_dir: `paths.log_dir` of the runs.
        extra: overrides of train.py for every cell, as the runs had them, or for the cells of
            some columns (`qs3.report.tables.overrides`).
        target: another target domain for all cells, e.g. "kinectsim10"; the paper's numbers,
            measured on another target, are then left out.
        kept: folder of results of runs that need not be there any more (`keeping.keep`).
        rows: further ones, as in the file.
        columns: only these, as `report train` takes them, and those that are published alone:
            each cell takes a fifth of a second.
        runs: look for them; without, what the file says is there at once.

    Raises:
        ConfigError: no such table, its file or an override is wrong, one of `columns` means none,
            or `target` is given for a table whose columns have targets of their own.
    """
    path = Path(name) if name.endswith(".yaml") else CONF / "table" / f"{name}.yaml"
    if not path.is_file():
        raise ConfigError(
            f"there is no table {name!r}; there are {', '.join(table_names())}; or give a "
            "file of your own, NAME.yaml"
        )
    name, spec = path.stem, _read(path)
    spec.rows.extend(map(dict, rows))
    wanted = chosen(spec.columns, columns)
    if lost := unknown(spec.columns, columns):
        raise ConfigError(
            f"no column of table {name} has {' or '.join(map(repr, lost))} in its name; "
            f"columns are {', '.join(map(repr, spec.columns))}"
        )
    shown = [column for column in spec.columns if column in wanted or _task(spec, column) is None]
    if target is not None:
        check_domain("target=", target)
        if isinstance(spec.columns, dict):
            raise ConfigError(
                f"target={target}: the columns of table {name} have several targets; leave it out"
            )
    check_words(extra)
    more = [*extra, *([f"domain@data.target={target}"] if target else [])]
    place = override("paths.log_dir", log_dir)
    if str(log_dir) != "logs":
        more.append(place)
    own = by_column(more, tuple(spec.columns))
    check_keys(spec.rows, tuple(spec.columns))
    try:
        cells = [
            replace(cell, column=_column(column, target))
            for row in spec.rows
            for i, column in enumerate(spec.columns)
            if column in shown
            and (cell := _cell(spec, row, i, column, own[column], published=not target))
        ]
        names = [row["name"] for row in spec.rows]
        factors = _factors(spec.rows)
        averages = {row["name"]: float(row["average"]) for row in spec.rows if "average" in row}
        if len(shown) < len(spec.columns):
            averages = {}  # published of all of them
    except (LookupError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise ConfigError(f"{path}: missing or wrong entry {error}") from error
    if twice := [one for one in names if names.count(one) > 1]:
        raise ConfigError(f"{path}: two rows are called {twice[0]!r}; give one another name")
    named = tuple(_column(column, target) for column in shown)
    if twice := [one for one in named if named.count(one) > 1]:
        raise ConfigError(
            f"{path}: two columns are called {twice[0]!r}; give one another name, or "
            "choose one of them, columns=WORD"
        )
    if runs:
        groups = {(g.experiment, g.hash): g for g in group(with_kept(load_runs(log_dir), kept))}
        hint = f"; {ALONE}" if extra and len(shown) > 1 else ""
        cells = _fill(cells, groups, target, hint, place, extra)
    filled = {(cell.row, cell.column): cell for cell in cells}
    filled_rows = {
        row["name"]: tuple(filled.get((row["name"], column)) for column in named)
        for row in spec.rows
    }
    title, notes = spec.title, spec.notes
    if target:
        title = f"{title}, on another target: {target}"
        notes = [*notes, f"all cells on the target {target}, which is not the paper's"]
    metrics = tuple(spec.metrics)
    return Table(
        name, title, tuple(notes), metrics, named, filled_rows, bool(spec.layout), averages,
        spec.costs, factors,
    )  # fmt: skip


def _read(path: Path) -> _Spec:
    try:
        spec = load_yaml(read_whole(path, YAML_PEAK).decode(), path)
        found = TypeAdapter(_Spec).validate_python(spec)
        if not all(isinstance(row.get("name"), str) for row in found.rows):
            raise ConfigError(f"{path}: missing or wrong entry 'name'")
        return found
    except DataError as error:
        raise ConfigError(str(error)) from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: {error}") from error
    except ValidationError as error:
        # The deepest: of a column that may be text or more, each kind has its error.
        first = max(error.errors(), key=lambda one: len(one["loc"]))
        text = "; put quotes around it" * (first["type"] == "string_type")
        place = ".".join(map(str, first["loc"])) or "the file"
        raise ConfigError(f"{path}: {place}: {first['msg']}{text}") from error


def _factors(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, str]]:
    """What rows have under `factors`, e.g. {selector: QBST, scheme: scratch}, by their names."""
    found = {row["name"]: dict(row["factors"]) for row in rows if "factors" in row}
    known: dict[tuple[str, ...], str] = {}
    for name, levels in found.items():
        if not all(isinstance(word, str) for pair in levels.items() for word in pair):
            raise ConfigError(f"table row {name!r}: factors: and their levels must be words")
        if levels.keys() != (first := next(iter(found.values()))).keys():
            raise ConfigError(
                f"table row {name!r}: its factors are {', '.join(levels)}, those of the first row "
                f"that has some {', '.join(first)}"
            )
        if (twin := known.setdefault(tuple(levels[key] for key in first), name)) != name:
            raise ConfigError(f"table row {name!r} has the factors of row {twin!r}")
    return found


def _column(name: str, target: str | None) -> str:
    """A column's name with another target: "S → D, DGCNN" becomes "S → kinectsim10, DGCNN"."""
    if not target:
        return name
    return re.sub(r"(?<= → )[^\s,;:(]+", lambda _: target, name, count=1)


def _task(spec: _Spec, column: str) -> str | None:
    """Overrides of a column; None where it is not for runs of ours, "" where rows have them all."""
    if not isinstance(spec.columns, dict):
        return ""
    found = spec.columns[column]
    return found.run if isinstance(found, _Column) else found


def _cell(
    spec: _Spec,
    row: Mapping[str, Any],
    i: int,
    column: str,
    more: Sequence[str],
    published: bool,
) -> Cell | None:
    """The cell of an entry `<column>: {run:, paper:, ...}`, or of what the row has for all columns.

    A row's `run` is followed by the overrides of its columns, of those that its `columns` names if
    it has that; a column without any has published numbers alone. Its `paper` has a number a
    column; `seeds` is how many it should have.
    """
    own = row.get(column, {})
    line = own.get("run")
    if (
        line is None
        and "run" in row
        and column in _meant(spec, row)
        and (task := _task(spec, column)) is not None
    ):
        line = f"{row['run']} {task}"
    numbers = row.get("paper")
    if numbers is not None and len(numbers) != len(spec.columns):
        raise ConfigError(
            f"table row {row['name']!r}: paper: has {counted(len(numbers), 'number')} for "
            f"{counted(len(spec.columns), 'column')}: one for each is needed"
        )
    number = own.get("paper", numbers[i] if numbers else None)
    if line is None and number is None:
        return None
    paper = None
    if published and number is not None:
        mean, sem = number if isinstance(number, list) else (number, None)
        source = own.get("source", row.get("source", ""))
        paper = Published(
            float(mean),
            None if sem is None else float(sem),
            own.get("selected", row.get("selected", "")),
            spec.sources.get(source, source),
        )
    overrides = () if line is None else (*shlex.split(line), *more)
    take = own.get("take", row.get("take", "final"))
    if take not in ("final", "warmup"):
        raise ConfigError(f"table row {row['name']!r}: take: must be final or warmup, got {take!r}")
    seeds = tuple(range(row["seeds"])) if "seeds" in row else SEEDS
    if isinstance(spec.columns, dict) and isinstance(of_all := spec.columns[column], _Column):
        seeds = seeds[: of_all.seeds]
    first = bool(own.get("first", row.get("first", False)))
    return Cell(row["name"], column, overrides, paper, take, seeds=seeds, first=first)


def _meant(spec: _Spec, row: Mapping[str, Any]) -> Sequence[str]:
    """The columns that a row's `run` is for: all, or those that it names."""
    meant = row.get("columns", [*spec.columns])
    wrong = [x for x in meant if x not in spec.columns] if isinstance(meant, list) else [meant]
    if wrong:
        raise ConfigError(
            f"table row {row['name']!r}: columns: {wrong[0]!r} is none of the table's, which are "
            f"{', '.join(map(repr, spec.columns))}"
        )
    return meant


def check_domain(key: str, name: str) -> None:
    """Raise ConfigError, with the names there are, if `name` after `key` is not a domain's."""
    known = sorted(path.stem for path in (CONF / "domain").glob("*.yaml"))
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        meant = f" (did you mean {near[0]}?)" if near else ""
        raise ConfigError(f"{key}{name} is not a domain{meant}; there are {', '.join(known)}")


def _fill(
    cells: Sequence[Cell],
    groups: Mapping[tuple[str, str], Group],
    target: str | None,
    hint: str,
    place: str,
    extra: Sequence[str],
) -> list[Cell]:
    """The cells with their runs, or with the reason why they cannot be run.

    `hint` ends the message about an override that a cell's config does not take; `place` is the
    override that says where runs lie, which changes nothing of what is looked up. What a table's
    own words name and is not there may come later; what `extra` names is a mistake.
    """
    from hydra.errors import (
        ConfigCompositionException,
        MissingConfigException,
        OverrideParseException,
    )

    filled = []
    for cell in cells:
        if not cell.runnable:
            filled.append(cell)
            continue
        try:
            run = _composed(_without(place, cell.overrides))
            if target and run.supervised:
                # The upper bound has labels of its target: the other target is its source too.
                cell = replace(cell, overrides=(*cell.overrides, f"domain@data.source={target}"))
                run = _composed(_without(place, cell.overrides))
        except MissingConfigException as error:
            asked = (error.missing_cfg_file or "").rpartition("/")[2]
            if any(word.endswith(f"={asked}") for word in extra):
                raise ConfigError(_of_cell(cell, error) + hint) from error
            filled.append(replace(cell, missing=first_line(error)))
            continue
        except (ConfigCompositionException, OverrideParseException) as error:
            raise ConfigError(_of_cell(cell, error) + hint) from error
        found = groups.get((run.experiment, run.hash))
        filled.append(replace(cell, group=found, target=run.target, simulated=run.simulated))
    return filled


def _of_cell(cell: Cell, error: Exception) -> str:
    return f"table cell {cell.row!r}, {cell.column!r}: {first_line(error)}"


def _without(word: str, words: Sequence[str]) -> tuple[str, ...]:
    return tuple(one for one in words if one != word)


_Stamp = tuple[int, int] | None


class _Composed(NamedTuple):
    """What a table has to know of a cell's config.

    `files`: those whose content is in the hash (`method.file`), each with its `_stamp`.
    """

    experiment: str
    hash: str
    target: str
    simulated: bool
    supervised: bool
    files: tuple[tuple[str, _Stamp], ...]


def _stamp(file: str) -> _Stamp:
    """When a file was written, in ns, and its bytes; None if it is not there."""
    try:
        found = Path(file).expanduser().stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


def _composed(words: tuple[str, ...]) -> _Composed:
    """A command line of train.py, composed. Kept: `report train` and effects ask for it often.

    Raises:
        HydraException: as Hydra's `compose`.
    """
    kept = _kept(words)
    if any(_stamp(file) != was for file, was in kept.files):  # edited since, in a notebook
        _kept.cache_clear()
        kept = _kept(words)
    return kept


@functools.lru_cache(maxsize=4096)
def _kept(words: tuple[str, ...]) -> _Composed:
    from qs3.config.hashing import config_hash

    with composing() as compose:
        cfg = compose("train", list(words))
        target = cfg.data.target
        supervised = cfg.method.get("_target_") == _SUPERVISED
        files = [str(file) for part in (cfg.method, cfg.model) if (file := part.get("file"))]
        stamps = tuple((file, _stamp(file)) for file in files)  # before they are read
        return _Composed(
            str(cfg.experiment_name),
            config_hash(cfg),
            str(target.name),
            bool(target.simulated),
            supervised,
            stamps,
        )
