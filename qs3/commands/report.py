"""`qs3 report` and `qs3 leaderboard`: tables of runs, what they lack, comparisons and pictures."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from annotated_types import Ge

from qs3.errors import ConfigError

if TYPE_CHECKING:
    from qs3.report.table import Table

_Out = Annotated[str | None, "where the files go (default LOG_DIR/tables)"]
_Seeds = Annotated[tuple[Annotated[int, Ge(0)], ...], "of each cell (default: the table's)"]
_Jobs = Annotated[int | None, Ge(1), "runs at the same time"]
_Launcher = Literal["joblib", "ray", "slurm"]


def _built(
    *,
    table: Annotated[str, "name of a file in conf/table, or a file NAME.yaml"],
    log_dir: Annotated[str, "paths.log_dir of the runs"] = "logs",
    data_dir: Annotated[str | None, "paths.data_dir of the runs"] = None,
    target: Annotated[str | None, "another target domain for all of the table"] = None,
    overrides: Annotated[str, 'settings "A=B ..." of all runs; COLUMN:A=B of a column\'s'] = "",
    kept: Annotated[Path | None, "results of `qs3 report keep`: shown, not trained"] = None,
    columns: Annotated[tuple[str, ...], "only columns of this name, or with it in theirs"] = (),
    **more: Any,
) -> Table:
    import shlex

    from qs3.config.compose import override
    from qs3.report.table import build_table

    extra = shlex.split(overrides)
    extra += [override("paths.data_dir", data_dir)] if data_dir else []
    return build_table(table, log_dir, extra, target, kept, columns=columns, **more)


def _of_table(command: Callable[..., Any], default: Any = inspect.Parameter.empty) -> Any:
    """Give a command `_built`'s keys, with a default for table=; it is called with the builder."""
    name, *others = list(inspect.signature(_built).parameters.values())[:-1]
    shared = [name.replace(default=default), *others]
    own = list(inspect.signature(command).parameters.values())[1:]

    @functools.wraps(command)
    def wrapped(**given: Any) -> Any:
        build = functools.partial(_built, **{key.name: given.pop(key.name) for key in shared})
        return command(build, **given)

    keys = [*shared, *own]
    wrapped.__signature__ = inspect.Signature(keys)  # type: ignore[attr-defined]
    wrapped.__annotations__ = {key.name: key.annotation for key in keys}
    return wrapped


def _place(table: Table, out: str | None, *more: str) -> Path:
    """Where a table's files go, without suffix."""
    return Path(out or Path(table.log_dir) / "tables") / "-".join((table.file_name, *more))


def _words(settings: Mapping[str, str], begin: str) -> list[str]:
    """Settings as KEY=VALUE; the keys of `**settings` are not checked by their names."""
    for key in settings:
        if not key.lstrip("+").startswith(begin):
            raise ConfigError(f"unknown key {key!r}")
    return [f"{key}={value}" for key, value in settings.items()]


@_of_table
def table(build: Callable[..., Table], *, out: _Out = None) -> None:
    """Print a table of runs, and save it as .md and .csv.

    `qs3 report table=NAME` is short for `qs3 report table table=NAME`. The saved files also have
    what the runs were measured on, and the commands that fill empty cells.

    Example:
        qs3 report table=cad10 kept=docs/results/cad10.csv.gz
        qs3 report table=uda target=kinectsim10 overrides="trainer=gpu data.points=512"
    """
    from qs3.report.formats import csv_text, markdown, save, text

    found = build()
    saved = save(_place(found, out), {".md": markdown(found), ".csv": csv_text(found)})
    print(text(found), f"runs lie in {found.log_dir}; {saved}", sep="\n")


@_of_table
def train(
    build: Callable[..., Table],
    *,
    seeds: _Seeds = (),
    rows: Annotated[tuple[str, ...], "only rows of this name, or with it in theirs"] = (),
    jobs: _Jobs = None,
    launcher: Annotated[_Launcher | None, "of Hydra (default: joblib with jobs)"] = None,
    **settings: Annotated[str, "settings of the launcher, hydra.launcher.NAME"],
) -> int:
    """Train what a table lacks, seed by seed; called again it goes on.

    Example:
        qs3 report train table=self_training rows=qbst columns="S -> D" seeds=0
        qs3 report train table=uda launcher=slurm jobs=16 hydra.launcher.partition=gpu
    """
    from qs3.report.running import launch, missing

    more, found = _words(settings, "hydra.launcher."), build()
    todo = missing(found, seeds, rows)
    print(f"table {found.name}: {len(todo)} runs to do", flush=True)
    return launch(todo, launcher, jobs, found.log_dir, more)


@_of_table
def keep(build: Callable[..., Table], *, into: Annotated[Path, "the file, NAME.csv.gz"]) -> None:
    """Keep the results of a table's finished runs in one small file.

    It holds what tables and paired intervals need, by row, column and seed; with kept= also the
    results of that file.

    Example:
        qs3 report keep table=real into=docs/results/real.csv.gz
    """
    from qs3.report.results import write_kept
    from qs3.report.table import kept_lines

    found = build()
    lines = kept_lines(found)
    write_kept(into, lines)
    print(f"kept {len(lines)} runs of table {found.name} in {into}")


@_of_table
def compare(
    build: Callable[..., Table],
    *,
    base: Annotated[str, "the row to compare with, or a part of its name"] = "",
) -> None:
    """Print differences to one row, or the effects of the factors that rows cross.

    Paired over test clouds and the seeds that both have, two at least; accuracy and balanced
    accuracy, and both of each tier where the target has tiers. Intervals are at 95 %, over seeds
    and what clouds share: meshes, rooms or blocks of frames. Without base= it is the effects.

    Example:
        qs3 report compare table=cad10 base="source only" kept=docs/results/cad10.csv.gz
        qs3 report compare table=cad10 kept=docs/results/cad10.csv.gz
    """
    from qs3.report.comparison import against, effects, row_of, text

    found = build()
    row = row_of(found, base) if base else ""
    differences = against(found, row) if row else effects(found)
    print(text(differences, row, table=found), end="")


def judge(
    *,
    runs: Annotated[tuple[str, ...], "folders of runs, or of seeds"],
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


@functools.partial(_of_table, default="leaderboard")
def leaderboard(
    build: Callable[..., Table],
    *,
    method: Annotated[Path, "Python file with one class derived from Method"],
    name: Annotated[str | None, "of its row (default: the file's)"] = None,
    selftraining: Annotated[str, "of conf/selftraining, after the warm-up"] = "none",
    seeds: _Seeds = (),
    jobs: _Jobs = None,
    out: _Out = None,
    **settings: Annotated[str, "settings of the class, method.NAME"],
) -> int:
    """Train a method of your own and show it by the rules of table=leaderboard.

    The file is imported, which runs it: name one that you trust. Its loss is tried on four random
    clouds before any run begins. An edited file is another row, whose runs begin anew; the same
    command goes on with interrupted runs and trains nothing twice. Rules and an example:
    docs/how-to/leaderboard.md.

    Example:
        qs3 leaderboard method=my_method.py
        qs3 leaderboard method=my_method.py method.weight=0.5 columns="S -> K"
    """
    from qs3.report.formats import csv_text, save
    from qs3.report.running import check_row, first_row, launch, missing, own_row, page

    row = own_row(method, name, selftraining, _words(settings, "method."))
    check_row(build(rows=[row], runs=False), row["name"])
    found = build(rows=[row])
    todo = missing(found, seeds, [row["name"]])
    print(f"{row['name']}: {len(todo)} runs to do", flush=True)
    status = launch(todo, None, jobs, found.log_dir)
    found = first_row(build(rows=[row]), row["name"])
    text = page(found, row["name"])
    place = _place(found, out, "".join(c if c.isalnum() else "-" for c in row["name"]))
    saved = save(place, {".md": text, ".csv": csv_text(found)})
    print(text, saved, sep="\n")
    return status


def page(
    run: Annotated[Path, "the run's folder"],
    *,
    data_dir: Annotated[Path | None, "where its datasets are, if they have moved"] = None,
    out: Annotated[Path | None, "where the files go (default: RUN/pictures)"] = None,
) -> None:
    """Draw the pictures and the page of one run.

    Example:
        qs3 report page run=logs/qs3_s2d/seed0-5f0c2a71 data_dir=data
    """
    from qs3.report.run_page import draw

    drawn = draw(run, out, data_dir=data_dir)
    for name, reason in drawn.skipped.items():
        print(f"no {name}: {reason}")
    print(*drawn.pictures.values(), drawn.page, sep="\n")


def pipeline(
    *,
    domain: Annotated[str, "of conf/domain"],
    object: Annotated[str | None, "its id, or a room's (default: a chair, the first room)"] = None,
    mesh: Annotated[Path | None, "a mesh file to scan in place of the domain's objects"] = None,
    view: Annotated[int, Ge(0), "whose images are shown"] = 0,
    out: Annotated[Path, "the picture"] = Path("pipeline.png"),
    **overrides: Annotated[str, "of generate.py, such as sensor=kinect_v1"],
) -> None:
    """Draw one object from images to residuals, or a room and what is cut from it.

    Example:
        qs3 report pipeline domain=specklenet10 sensor=kinect_v1 mesh=chair.glb out=chair.png
        qs3 report pipeline domain=rooms10 out=room.png
    """
    from qs3.report.pipeline import makes_rooms, pipeline_figure, room_figure, scan_object
    from qs3.utils.pictures import save_png

    words = [f"domain={domain}", *(f"{key}={value}" for key, value in overrides.items())]
    if makes_rooms(words):
        figure = room_figure(words, object)
    else:
        figure = pipeline_figure(scan_object(words, object, mesh), view)
    save_png(figure, out, colours=256)
    print(out)
