"""Tables and pictures from the command line.

    python -m qs3.report table=uda [log_dir=logs] [out=logs/tables] [target=kinectsim10]
                                   [overrides="trainer=gpu data.points=512"]
    python -m qs3.report run table=cad10 [seeds=0,1,2] [rows=gast,pcm] [columns=...] [jobs=1]
                                 [log_dir=logs] [target=...] [overrides=...]
                                 [launcher=joblib|submitit_local|slurm]
                                 [hydra.launcher.partition=... and other settings of the launcher]
    python -m qs3.report compare table=cad10 base="source only" [log_dir=logs] [out=...] [...]
    python -m qs3.report effects table=factorial [log_dir=logs] [out=...] [...]
    python -m qs3.report run=PATH [data_dir=data] [out=PATH/pictures]
    python -m qs3.report pictures domains=[modelnet10,specklenet10,kinectsim10]
                                  [data_dir=data] [split=train] [out=data/pictures]
    python -m qs3.report pipeline domain=specklenet10 [object=ID | mesh=FILE] [view=0]
                                  [out=pipeline.png] [renderer=mitsuba sensor=kinect_v1 ...]
    python -m qs3.report pipeline dataset=FOLDER object=ID [meshes=PATH] [view=0] [out=...]

A table is printed as Markdown and saved as .md, .csv and .tex. `overrides` are those that
the runs had beyond the table's. `run` trains what a table lacks, seed by seed, `jobs` at a time;
called again it goes on. `compare` prints the difference of each row to the row `base`, with its
interval; `effects` those between columns averaged over rows, and between rows over columns.
Pictures of a run, the folder that training names: curves, confusion, pseudo-labels, classes,
calibration; if its data are there, features and clouds of both domains, their class balance and
the surest mistakes; if they kept their views, the pipeline; and a page of all, index.html.
Pictures of domains: a contact sheet of each domain, one that compares them, and classes.png, how
many clouds each class has; with out=NAME.png the comparison alone.
`pipeline` draws one object on its way from images to residuals. It scans it now (any override of
generate.py is understood), or reads it from a dataset that was made with keep_views=true.
`paths.log_dir` and `paths.data_dir` are understood as well.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from qs3.config.quoting import override
from qs3.errors import ConfigError, Qs3Error
from qs3.report.tables.table import Table

_TABLE = {"table", "log_dir", "data_dir", "out", "target", "overrides"}
_LAUNCHER = "hydra.launcher."
_RUN = {
    *("table", "log_dir", "data_dir", "target", "overrides", "seeds", "rows", "columns", "jobs"),
    *("launcher", _LAUNCHER),
}
_COMPARE = _TABLE | {"base"}
_PICTURES = {"domains", "run", "data_dir", "out", "split"}


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit status."""
    if not argv or {"-h", "--help", "help"} & set(argv):
        print(__doc__)
        return 0
    try:
        if argv[0] == "pictures":
            _pictures(_options(argv[1:], _PICTURES))
        elif "=" in argv[0] and any(word.startswith("run=") for word in argv):
            _pictures(_options(argv, _PICTURES))
        elif argv[0] == "pipeline":
            _pipeline(argv[1:])
        elif argv[0] == "run":
            return _run(_options(argv[1:], _RUN))
        elif argv[0] == "compare":
            _compare(_options(argv[1:], _COMPARE))
        elif argv[0] == "effects":
            _effects(_options(argv[1:], _TABLE))
        elif "=" not in argv[0]:
            words = "table=NAME, run, compare, effects, run=PATH, pictures or pipeline"
            raise ConfigError(f"unknown command {argv[0]!r}; it begins with {words} (see --help)")
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
        if key.startswith(_LAUNCHER) and _LAUNCHER in known:
            found[key] = value
            continue
        if not equals or key not in known:
            names = sorted("hydra.launcher.KEY=" if k == _LAUNCHER else f"{k}=" for k in known)
            raise ConfigError(f"unknown argument {word!r}; known are {', '.join(names)}")
        found[key] = value
    return found


def _built(options: dict[str, str], runs: bool = True) -> Table:
    """The table that the options ask for, with our runs; `runs`: there are some, one may think."""
    from qs3.report.tables.table import build_table, table_names

    if "table" not in options:
        raise ConfigError(f"which table? table={'|'.join(table_names())}")
    extra = shlex.split(options.get("overrides", ""))
    extra += [override("paths.data_dir", options["data_dir"])] if "data_dir" in options else []
    log_dir = options.get("log_dir", "logs")
    if runs and "log_dir" in options and not Path(log_dir).is_dir():
        raise ConfigError(f"log_dir={log_dir} is not there; it is the paths.log_dir of the runs")
    return build_table(options["table"], log_dir, extra, options.get("target"))


def _saved_at(table: Table, options: dict[str, str]) -> Path:
    """Where a table's files go, without their suffix."""
    name = "-".join([table.name, *([options["target"]] if "target" in options else [])])
    return Path(options.get("out", Path(options.get("log_dir", "logs")) / "tables")) / name


def _run(options: dict[str, str]) -> int:
    from qs3.report.tables.running import LAUNCHERS, launch, missing

    seeds = [_whole("seeds", word) for word in options.get("seeds", "0,1,2").split(",")]
    rows, columns = (
        [word.strip() for word in options.get(key, "").split(",") if word.strip()]
        for key in ("rows", "columns")
    )
    at_once = _whole("jobs", options.get("jobs", "1"))
    if at_once < 1:
        raise ConfigError("jobs must be at least 1")
    launcher = options.get("launcher")
    settings = [f"{key}={value}" for key, value in options.items() if key.startswith(_LAUNCHER)]
    if launcher not in (*LAUNCHERS, None) or (settings and launcher is None):
        what = f"launcher={launcher}" if launcher else f"{settings[0]} needs a launcher"
        raise ConfigError(f"{what}; set launcher={'|'.join(LAUNCHERS)}")
    table = _built(options, runs=False)
    jobs = missing(table, seeds, rows, columns)
    print(f"table {table.name}: {len(jobs)} runs to do", flush=True)
    several = at_once if "jobs" in options else None
    launcher = launcher or ("joblib" if at_once > 1 else "basic")
    status = launch(jobs, launcher, several, options.get("log_dir", "logs"), settings)
    if not status:
        print(f"next: python -m qs3.report table={table.name}")
    return status


def _whole(key: str, word: str) -> int:
    try:
        return int(word)
    except ValueError:
        raise ConfigError(f"{key} must be whole numbers, got {word!r}") from None


def _compare(options: dict[str, str]) -> None:
    from qs3.report.tables.comparison import against, csv_text, text
    from qs3.utils.files import write_text

    table = _built(options)
    if "base" not in options:
        raise ConfigError(f"against which row? base={'|'.join(table.rows)}")
    found = against(table, options["base"])
    at = _saved_at(table, options)
    write_text(f"{at}-compared.md", text(found, options["base"], markdown=True, table=table))
    write_text(f"{at}-compared.csv", csv_text(found, table))
    print(text(found, options["base"], table=table))
    print(f"saved {at}-compared.md, .csv")


def _effects(options: dict[str, str]) -> None:
    from qs3.report.tables.comparison import csv_text, effects, text
    from qs3.utils.files import write_text

    table = _built(options)
    found, at = effects(table), _saved_at(table, options)
    if not found:
        raise ConfigError(f"table {table.name} has no two columns or rows with runs of ours")
    write_text(f"{at}-effects.md", text(found, markdown=True, table=table))
    write_text(f"{at}-effects.csv", csv_text(found, table))
    print(text(found, table=table))
    print(f"saved {at}-effects.md, .csv")


def _table(options: dict[str, str]) -> None:
    from qs3.report.tables.formats import csv_text, latex, markdown
    from qs3.utils.files import write_text

    table = _built(options)
    text, at = markdown(table), _saved_at(table, options)
    write_text(f"{at}.md", text)
    for suffix, write in ((".csv", csv_text), (".tex", latex)):
        write_text(f"{at}{suffix}", write(table))
    print(text)
    print(f"saved {at}.md, .csv, .tex")


def _pictures_of_run(options: dict[str, str]) -> None:
    from qs3.report.runs.pictures import draw

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


def _pipeline(words: Sequence[str]) -> None:
    from qs3.report.figures.pipeline import kept_object, scan_object
    from qs3.report.figures.pipeline_figure import save_pipeline

    if odd := [word for word in words if "=" not in word]:
        raise ConfigError(f"unknown argument {odd[0]!r}; arguments are key=value")
    given = dict(word.split("=", 1) for word in words)
    if "dataset" in given:
        options = _options(words, {"dataset", "object", "meshes", "view", "out"})
        one = kept_object(options["dataset"], options.get("object"), options.get("meshes"))
    elif "domain" in given:
        ours = ("object", "mesh", "view", "out")
        overrides = [word for word in words if word.split("=", 1)[0] not in ours]
        one = scan_object(overrides, given.get("object"), given.get("mesh"))
    else:
        raise ConfigError("of what? domain=NAME scans an object, dataset=FOLDER reads one")
    view = _whole("view", given.get("view", "0"))
    print(save_pipeline(one, given.get("out", "pipeline.png"), view))


def _pictures(options: dict[str, str]) -> None:
    if "run" in options:
        return _pictures_of_run(options)
    from hydra.utils import instantiate

    from qs3.config.compose import composing
    from qs3.data.contact_sheets import class_sheet, scan_picture
    from qs3.report.figures.class_balance import class_picture
    from qs3.report.tables.table import check_domain

    names = [n.strip() for n in options.get("domains", "").strip("[]").split(",") if n.strip()]
    if not names:
        raise ConfigError("of what? run=PATH, or domains=[modelnet10,specklenet10,kinectsim10]")
    for name in names:
        check_domain("domains: ", name)
    data_dir = Path(options.get("data_dir", "data"))
    out, split = Path(options.get("out", data_dir / "pictures")), options.get("split", "train")
    alone = out.suffix == ".png"
    sets, simulated, counts = {}, [], {}
    with composing() as compose:
        for name in names:
            folder = override("paths.data_dir", data_dir.absolute())
            cfg = compose("train", [f"domain@data.source={name}", folder])
            domain = instantiate(cfg.data.source)
            data = domain.open()
            words = f"{domain.title}{' (simulated)' if domain.simulated else ''}"
            sets[f"{domain.symbol}: {words}"] = data
            simulated += [domain.title] if domain.simulated else []
            counts[domain.label] = data
            if alone:
                continue
            heading = f"{domain.label}, {split}"
            print(class_sheet(data, out / f"{name}.png", split=split, heading=heading))
    if not alone:
        print(class_picture(counts, out / "classes.png"))
    note = f"simulated: {', '.join(simulated)}" if simulated else ""
    print(scan_picture(sets, out if alone else out / "domains.png", split=split, note=note))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
