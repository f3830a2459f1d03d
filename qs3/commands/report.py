"""`qs3 report` and `qs3 leaderboard`: tables of runs, what they lack, comparisons and pictures."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from annotated_types import Ge

from qs3.errors import ConfigError

if TYPE_CHECKING:
    from qs3.report.tables.comparison import Compared
    from qs3.report.tables.table import Table


_Logs = Annotated[str, "paths.log_dir of the runs"]
_Data = Annotated[str | None, "paths.data_dir of the runs"]
_Overrides = Annotated[str, 'more settings "A=B ..." of all runs; COLUMN:A=B of a column\'s']
_Kept = Annotated[Path | None, "results that `qs3 report keep` has kept: shown, not trained"]
_Columns = Annotated[tuple[str, ...], "only columns of this name, or with it in theirs"]
_Out = Annotated[str | None, "where the files go (default LOG_DIR/tables)"]
_Seeds = Annotated[tuple[Annotated[int, Ge(0)], ...], "of each cell (default: the table's)"]
_Jobs = Annotated[int | None, Ge(1), "runs at the same time"]
_Launcher = Literal["basic", "joblib", "ray", "slurm", "submitit_local", "submitit_slurm"]


def _built(
    *,
    table: Annotated[str, "name of a file in conf/table, or a file NAME.yaml"],
    log_dir: _Logs = "logs",
    data_dir: _Data = None,
    target: Annotated[str | None, "another target domain for all of the table"] = None,
    overrides: _Overrides = "",
    kept: _Kept = None,
    columns: _Columns = (),
    **more: Any,
) -> Table:
    import shlex

    from qs3.config.quoting import override
    from qs3.report.tables.table import build_table

    extra = shlex.split(overrides)
    extra += [override("paths.data_dir", data_dir)] if data_dir else []
    return build_table(table, log_dir, extra, target, kept, columns=columns, **more)


def _of_table(command: Callable[..., Any]) -> Callable[..., Any]:
    """A command with the keys of `_built` and its own, which is called with the built table."""
    shared = list(inspect.signature(_built).parameters.values())[:-1]
    own = list(inspect.signature(command).parameters.values())[1:]

    @functools.wraps(command)
    def wrapped(**given: Any) -> Any:
        found = _built(**{key.name: given.pop(key.name) for key in shared})
        return command(found, **given)

    keys = [*shared, *own]
    wrapped.__signature__ = inspect.Signature(keys)  # type: ignore[attr-defined]
    wrapped.__annotations__ = {key.name: key.annotation for key in keys}
    return wrapped


def _place(table: Table, out: str | None, *more: str) -> Path:
    """Where a table's files go, without suffix."""
    return Path(out or Path(table.log_dir) / "tables") / "-".join((table.file_name, *more))


@_of_table
def table(found: Table, *, out: _Out = None) -> None:
    """Print a table of runs, and save it as .md, .csv and .tex.

    `qs3 report table=NAME` is short for `qs3 report table table=NAME`. The saved files also have
    what the runs were measured on, and the commands that fill empty cells.

    Example:
        qs3 report table=uda
        qs3 report table=headline kept=docs/results/headline.csv.gz
        qs3 report table=leaderboard columns="S -> K"
        qs3 report table=uda target=kinectsim10 overrides="trainer=gpu data.points=512"
    """
    from qs3.report.tables.formats import csv_text, latex, markdown, save, text

    texts = {".md": markdown(found), ".csv": csv_text(found), ".tex": latex(found)}
    said = save(_place(found, out), texts)
    print(text(found), f"runs lie in {found.log_dir}; {said}", sep="\n")


@_of_table
def train(
    found: Table,
    *,
    seeds: _Seeds = (),
    rows: Annotated[tuple[str, ...], "only rows of this name, or with it in theirs"] = (),
    jobs: _Jobs = None,
    launcher: Annotated[_Launcher | None, "of Hydra (default basic; joblib with jobs)"] = None,
    **settings: Annotated[str, "settings of the launcher, hydra.launcher.NAME"],
) -> int:
    """Train what a table lacks, seed by seed; called again it goes on.

    Example:
        qs3 report train table=cad10
        qs3 report train table=self_training rows=qbst columns="S -> D" seeds=0
        qs3 report train table=uda launcher=joblib jobs=4
        qs3 report train table=uda launcher=slurm jobs=16 hydra.launcher.partition=gpu
    """
    from qs3.report.tables.running import launch, missing

    if wrong := [key for key in settings if not key.lstrip("+").startswith("hydra.launcher.")]:
        raise ConfigError(f"unknown key {wrong[0]!r}")
    todo = missing(found, seeds, rows)
    print(f"table {found.name}: {len(todo)} runs to do", flush=True)
    launcher = launcher or ("joblib" if (jobs or 1) > 1 else "basic")
    more = [f"{key}={value}" for key, value in settings.items()]
    return launch(todo, launcher, jobs, found.log_dir, more)


@_of_table
def keep(found: Table, *, into: Annotated[Path, "the file, NAME.csv.gz"]) -> None:
    """Keep the results of a table's finished runs in one small file.

    It holds what tables and paired intervals need, by row, column and seed; with kept= also the
    results of that file.

    Example:
        qs3 report keep table=real into=docs/results/real.csv.gz
        qs3 report table=real kept=docs/results/real.csv.gz
    """
    from qs3.report.tables.results import write_kept
    from qs3.report.tables.table import kept_lines

    lines = kept_lines(found)
    write_kept(into, lines)
    print(f"kept {len(lines)} runs of table {found.name} in {into}")


@_of_table
def compare(
    found: Table,
    *,
    base: Annotated[str, "the row to compare with: its name, or a part of it"],
    out: _Out = None,
) -> None:
    """Print the difference of each row to one row, with its interval.

    Paired over test clouds and the seeds that both have, two at least; accuracy and balanced
    accuracy, and both of each tier where the target has tiers. Intervals are at 95 %, over seeds
    and what clouds share: meshes, rooms or blocks of frames.

    Example:
        qs3 report compare table=cad10 base="source only" kept=docs/results/cad10.csv.gz
    """
    from qs3.report.tables.comparison import against, row_of

    row = row_of(found, base)
    _save(_place(found, out, "compared"), found, against(found, row), row)


@_of_table
def effects(found: Table, *, out: _Out = None) -> None:
    """Print the effects of the factors that a table's rows cross.

    Paired, with intervals, as of `qs3 report compare`.

    Example:
        qs3 report effects table=headline kept=docs/results/headline.csv.gz
    """
    from qs3.report.tables import comparison

    _save(_place(found, out, "effects"), found, comparison.effects(found))


def _save(place: Path, table: Table, found: list[Compared], base: str = "") -> None:
    from qs3.report.tables.comparison import text
    from qs3.report.tables.formats import save

    said = save(place, {".md": text(found, base, markdown=True, table=table)})
    print(text(found, base, table=table), said, sep="\n")


def judge(
    *,
    runs: Annotated[tuple[str, ...], "folders of runs, or of seeds, or patterns"],
    data: Annotated[Path, "the archive, .npz"],
    part: Annotated[str, "part of the archive (default: judge, if it has one)"] = "",
    floor: Annotated[float | None, "its z in metres, minus the camera's height"] = None,
    device: Annotated[str, "cpu, cuda or cuda:1"] = "cpu",
    out: Annotated[Path | None, "a CSV file, with all digits"] = None,
) -> None:
    """Judge saved runs on an archive of real objects that they were not trained on.

    Accuracy, balanced accuracy over the classes that are there, the majority rate and the recall of
    each class, for all objects and for the clean and the hard ones. Runs of one config that saw the
    same data are one row, averaged over their seeds; the other rows are compared with the first,
    paired object by object and seed by seed. Intervals take blocks of 30 frames in a row as
    clusters.

    Example:
        qs3 report judge runs=logs/source_only_s2d,logs/qs3_s2d data=held_back.npz out=judged.csv
        qs3 report judge runs=dgcnn-rooms data=held_back.npz floor=-1.2
    """
    from qs3.report import judge as judging
    from qs3.utils.files import write_text

    verdict = judging.judge(runs, data, part=part, floor=floor, device=device)
    print(judging.text(verdict))
    if out:
        write_text(out, verdict.figures.to_csv(index=False, lineterminator="\n"))
        print(f"saved {out}")


def leaderboard(
    *,
    method: Annotated[Path, "Python file with one class derived from Method"],
    name: Annotated[str | None, "of its row (default: the file's)"] = None,
    selftraining: Annotated[str, "of conf/selftraining, after the warm-up"] = "none",
    table: Annotated[str, "whose rows and columns, all of experiment=leaderboard"] = "leaderboard",
    seeds: _Seeds = (),
    columns: _Columns = (),
    jobs: _Jobs = None,
    log_dir: _Logs = "logs",
    data_dir: _Data = None,
    overrides: _Overrides = "",
    kept: _Kept = None,
    out: _Out = None,
    **settings: Annotated[str, "settings of the class, method.NAME"],
) -> int:
    """Train a method of your own and show it by the rules of table=leaderboard.

    The file is imported, which runs it: name one that you trust. Its loss is tried on four random
    clouds before any run begins; the runs need the data of the chosen columns. An edited file is
    another row, whose runs begin anew; the same command goes on with interrupted runs and trains
    nothing twice. Rules and an example: docs/how-to/leaderboard.md.

    Example:
        qs3 leaderboard method=my_method.py
        qs3 leaderboard method=my_method.py method.weight=0.5 name="Mine, w = 0.5"
        qs3 leaderboard method=my_method.py columns="S -> K" seeds=0 selftraining=qbst
    """
    from qs3.report.leaderboard import check_row, first_row, own_row, page
    from qs3.report.tables.formats import csv_text, latex, save
    from qs3.report.tables.running import launch, missing

    if wrong := [key for key in settings if not key.startswith("method.")]:
        raise ConfigError(f"unknown key {wrong[0]!r}")
    words = [f"{key}={value}" for key, value in settings.items()]
    row = own_row(method, name, selftraining, words)
    build = functools.partial(
        _built, table=table, log_dir=log_dir, data_dir=data_dir, overrides=overrides, kept=kept,
        columns=columns, rows=[row],
    )  # fmt: skip
    check_row(build(runs=False), row["name"])
    todo = missing(build(), seeds, [row["name"]])
    print(f"{row['name']}: {len(todo)} runs to do", flush=True)
    status = launch(todo, "joblib" if (jobs or 1) > 1 else "basic", jobs, log_dir)
    found = first_row(build(), row["name"])
    text = page(found, row["name"])
    place = _place(found, out, "".join(c if c.isalnum() else "-" for c in row["name"]))
    said = save(place, {".md": text, ".csv": csv_text(found), ".tex": latex(found)})
    print(text, said, sep="\n")
    return status


def page(
    run: Annotated[Path, "the run's folder"],
    *,
    data_dir: Annotated[Path | None, "where its datasets are, if they have moved"] = None,
    out: Annotated[Path | None, "where the files go (default: RUN/pictures)"] = None,
    packages: Annotated[tuple[str, ...], "where a net of one's own is defined; run"] = (),
) -> None:
    """Pictures and the page of one run.

    Example:
        qs3 report page run=logs/qs3_s2d/seed0-5f0c2a71 data_dir=data
    """
    from qs3.report.run_page import draw

    drawn = draw(run, out, data_dir=data_dir, packages=packages)
    for name, reason in drawn.skipped.items():
        print(f"no {name}: {reason}")
    print(*drawn.pictures.values(), drawn.page, sep="\n")


def pictures(
    *,
    domains: Annotated[tuple[str, ...], "names of conf/domain"],
    data_dir: Annotated[Path, "where the datasets lie"] = Path("data"),
    split: Annotated[str, "whose clouds"] = "train",
    out: Annotated[Path, "the picture"] = Path("domains.png"),
) -> None:
    """One object of each class as each of several domains has it, as a picture.

    Example:
        qs3 report pictures domains=modelnet10,specklenet10,kinectsim10
    """
    from qs3.datasets.domain import compose_domain
    from qs3.report.sheets import scan_picture
    from qs3.utils.pictures import save_png

    found = [compose_domain(name, {"paths.data_dir": str(data_dir)}) for name in domains]
    save_png(scan_picture({one.label: one.open() for one in found}, split), out, colours=256)
    print(out)


def pipeline(
    *,
    domain: Annotated[str, "of conf/domain"],
    object: Annotated[str | None, "its id (default: a chair)"] = None,
    mesh: Annotated[Path | None, "a mesh file to scan in place of the domain's objects"] = None,
    view: Annotated[int, "whose images are shown"] = 0,
    out: Annotated[Path, "the picture"] = Path("pipeline.png"),
    **overrides: Annotated[str, "of generate.py, such as renderer=mitsuba sensor=kinect_v1"],
) -> None:
    """One object from images to residuals, as a picture.

    Examples:
        qs3 report pipeline domain=specklenet10 renderer=mitsuba object=chair/train/chair_0000
        qs3 report pipeline domain=specklenet10 sensor=kinect_v1 mesh=chair.glb out=chair.png
    """
    from qs3.report.pipeline import pipeline_figure, scan_object
    from qs3.utils.pictures import save_png

    words = [f"domain={domain}", *(f"{key}={value}" for key, value in overrides.items())]
    save_png(pipeline_figure(scan_object(words, object, mesh), view), out, colours=256)
    print(out)
