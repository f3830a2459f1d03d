"""Tables and pictures from the command line.

    python -m qs3.report table=uda [log_dir=logs] [out=logs/tables] [target=kinectsim10]
                                   [overrides="trainer=gpu data.points=512"]
    python -m qs3.report run table=cad10 [seeds=0,1,2] [rows=gast,pcm] [jobs=1] [log_dir=logs]
                                 [target=...] [overrides=...]
    python -m qs3.report compare table=cad10 base="source only" [log_dir=logs] [out=...] [...]
    python -m qs3.report pictures run=PATH [data_dir=data] [out=PATH/pictures]
    python -m qs3.report pictures domains=[modelnet10,specklenet10,kinectsim10]
                                  [data_dir=data] [split=train] [out=data/pictures]

A table is printed as Markdown and saved as .md, .csv, .tex and .html. `overrides` are those that
the runs had beyond the table's. `run` trains what a table lacks, seed by seed, `jobs` at a time;
called again it goes on. `compare` prints the difference of each row to the row `base`, with its
interval.
Pictures of a run, the folder that training names: curves, confusion, pseudo-labels, classes,
calibration, features of both domains (if its data are there), and a page of all, index.html.
Pictures of domains: a contact sheet of each domain, and one that compares them; with out=NAME.png
the latter alone. `paths.log_dir` and `paths.data_dir` are understood as well.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from qs3.errors import ConfigError, Qs3Error
from qs3.report.tables import Table

_TABLE = {"table", "log_dir", "data_dir", "out", "target", "overrides"}
_RUN = {"table", "log_dir", "data_dir", "target", "overrides", "seeds", "rows", "jobs"}
_COMPARE = _TABLE | {"base"}
_PICTURES = {"domains", "run", "data_dir", "out", "split"}


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit status."""
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(__doc__)
        return 0
    try:
        if argv[0] == "pictures":
            _pictures(_options(argv[1:], _PICTURES))
        elif argv[0] == "run":
            return _run(_options(argv[1:], _RUN))
        elif argv[0] == "compare":
            _compare(_options(argv[1:], _COMPARE))
        else:
            _table(_options(argv, _TABLE))
    except Qs3Error as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    return 0


def _options(argv: Sequence[str], known: set[str]) -> dict[str, str]:
    """key=value words as a dict.

    Raises:
        ConfigError: another key, or no `=`.
    """
    found = {}
    for word in argv:
        key, equals, value = word.partition("=")
        key = key.removeprefix("paths.")
        if not equals or key not in known:
            raise ConfigError(f"unknown argument {word!r}; known are {', '.join(sorted(known))}=")
        found[key] = value
    return found


def _built(options: dict[str, str]) -> Table:
    """The table that the options ask for, with our runs."""
    from qs3.report.tables import build_table, table_names

    if "table" not in options:
        raise ConfigError(f"which table? table={'|'.join(table_names())}")
    extra = shlex.split(options.get("overrides", ""))
    extra += [f"paths.data_dir={options['data_dir']}"] if "data_dir" in options else []
    log_dir = options.get("log_dir", "logs")
    return build_table(options["table"], log_dir, extra, options.get("target"))


def _saved_at(table: Table, options: dict[str, str]) -> Path:
    """Where a table's files go, without their suffix."""
    name = "-".join([table.name, *([options["target"]] if "target" in options else [])])
    return Path(options.get("out", Path(options.get("log_dir", "logs")) / "tables")) / name


def _run(options: dict[str, str]) -> int:
    from qs3.report.running import missing, run_all

    seeds = [_whole("seeds", word) for word in options.get("seeds", "0,1,2").split(",")]
    rows = [word.strip() for word in options.get("rows", "").split(",") if word.strip()]
    table, at_once = _built(options), _whole("jobs", options.get("jobs", "1"))
    if at_once < 1:
        raise ConfigError("jobs must be at least 1")
    jobs = missing(table, seeds, rows)
    print(f"table {table.name}: {len(jobs)} runs to do")
    failed = run_all(jobs, at_once, lambda line: print(line, flush=True))
    if failed:
        print(f"{len(failed)} of {len(jobs)} runs failed:")
        for job in failed:
            print(f"  {job.command}")
        return 1
    print(f"next: python -m qs3.report table={table.name}")
    return 0


def _whole(key: str, word: str) -> int:
    try:
        return int(word)
    except ValueError:
        raise ConfigError(f"{key} must be whole numbers, got {word!r}") from None


def _compare(options: dict[str, str]) -> None:
    from qs3.files import write_text
    from qs3.report.comparison import against, text

    table = _built(options)
    if "base" not in options:
        raise ConfigError(f"against which row? base={'|'.join(table.rows)}")
    found = against(table, options["base"])
    at = _saved_at(table, options)
    write_text(f"{at}-compared.md", text(found, options["base"], markdown=True))
    print(text(found, options["base"]))
    print(f"saved {at}-compared.md")


def _table(options: dict[str, str]) -> None:
    from qs3.files import write_text
    from qs3.report.formats import csv_text, latex, markdown
    from qs3.report.table_page import page

    table = _built(options)
    text, at = markdown(table), _saved_at(table, options)
    write_text(f"{at}.md", text)
    for suffix, write in ((".csv", csv_text), (".tex", latex), (".html", page)):
        write_text(f"{at}{suffix}", write(table))
    print(text)
    print(f"saved {at}.md, .csv, .tex, .html")


def _pictures_of_run(options: dict[str, str]) -> None:
    from qs3.report.run_pictures import draw

    for other in ("domains", "split"):
        if other in options:
            raise ConfigError(f"run= and {other}= are two commands; give one of them")
    drawn = draw(options["run"], options.get("out"), data_dir=options.get("data_dir"))
    for note in drawn.notes:
        print(f"note: {note}")
    for name, reason in drawn.skipped.items():
        print(f"no {name}: {reason}")
    for path in (*drawn.pictures.values(), drawn.page):
        print(path)


def _pictures(options: dict[str, str]) -> None:
    if "run" in options:
        return _pictures_of_run(options)
    from hydra.utils import instantiate

    from qs3.report.pictures import contact_sheet, scan_picture
    from qs3.report.tables import composing

    names = [n.strip() for n in options.get("domains", "").strip("[]").split(",") if n.strip()]
    if not names:
        raise ConfigError("of what? run=PATH, or domains=[modelnet10,specklenet10,kinectsim10]")
    data_dir = Path(options.get("data_dir", "data"))
    out, split = Path(options.get("out", data_dir / "pictures")), options.get("split", "train")
    alone = out.suffix == ".png"
    sets, simulated = {}, []
    with composing() as compose:
        for name in names:
            cfg = compose(
                "train", [f"domain@data.source={name}", f"paths.data_dir={data_dir.absolute()}"]
            )
            domain = instantiate(cfg.data.source)
            data = domain.open()
            words = f"{domain.title}{' (simulated)' if domain.simulated else ''}"
            sets[f"{domain.symbol}: {words}"] = data
            simulated += [domain.title] if domain.simulated else []
            if alone:
                continue
            part = data.split(split)
            few = max(1, min(6, *data.counts()[split].values()))  # a row a class
            of_class = [(part.labels == k).nonzero()[0][:few] for k in range(len(data.classes))]
            first = [i for members in of_class for i in members]
            print(
                contact_sheet(
                    [part.points[i] for i in first],
                    [part.ids[i].split("/")[-1] for i in first],
                    out / f"{name}.png",
                    columns=few,
                    heading=f"{domain.label}, {split}",
                )
            )
    note = f"simulated: {', '.join(simulated)}" if simulated else ""
    print(scan_picture(sets, out if alone else out / "domains.png", split=split, note=note))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
