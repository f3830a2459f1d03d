"""All pictures of one run, as files in `<run>/pictures`, and a page that shows them.

A picture that has nothing to show is left out, and the reason is said.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from qs3.config.hydra import in_multirun
from qs3.errors import Qs3Error
from qs3.report.figures.canvas import NothingToDrawError
from qs3.report.runs import figures as run_figures
from qs3.report.runs.clouds import cloud_pictures
from qs3.report.runs.data import RunFiles, read_run
from qs3.report.runs.page import page
from qs3.report.runs.viewed import part_of_run, worst_first
from qs3.report.viewer.page import page as turnable_page
from qs3.runs.metrics import RunMetrics, read_metrics
from qs3.utils.files import write_text
from qs3.utils.plotting import save_png

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)

FOLDER = "pictures"
PAGE = "index.html"
CLOUDS = "clouds.html"
_CLOUDS, _POINTS = 30, 1024  # on the page of clouds: a quarter of a megabyte a run


@dataclass(frozen=True)
class Drawn:
    """What became of a run's pictures.

    Attributes:
        pictures: PNG by name, such as "curves".
        skipped: why a picture is not there, by name.
        notes: what the run's folder lacks, as text.
        page: the HTML page.
        clouds: the page with clouds that can be turned, the most confident errors first; None if
            the target's data are not there.
    """

    pictures: Mapping[str, Path]
    skipped: Mapping[str, str]
    notes: tuple[str, ...]
    page: Path
    clouds: Path | None


def draw(
    folder: str | Path,
    out: str | Path | None = None,
    *,
    data_dir: str | Path | None = None,
    embed: bool = True,
    config: Mapping[str, Any] | None = None,
    packages: Sequence[str] = (),
) -> Drawn:
    """Draw a run's pictures; those of an earlier call are replaced.

    Args:
        out: folder for the files; None: `pictures` in the run's.
        data_dir: where the datasets lie; None: where the run's config says.
        embed: also lay out the features of both domains; takes a minute.
        config: of the run; None: what Hydra wrote into its folder.
        packages: where a net of one's own is defined, beside those of qs3; the code there is run.

    Raises:
        MissingDataError, DataError: see `qs3.report.runs.data.read_run`.
    """
    run = read_run(folder)
    if config is not None:
        run = dataclasses.replace(run, config=config)
    out = run.folder / FOLDER if out is None else Path(out)
    pictures, skipped = {}, {}
    for name, make in _makers(run, data_dir, embed, packages).items():
        path = out / f"{name}.png"
        try:
            make(path)
            pictures[name] = path
        except (NothingToDrawError, Qs3Error) as reason:  # damaged data cost their pictures alone
            skipped[name] = str(reason)
            path.unlink(missing_ok=True)
    try:
        clouds = _write_clouds(run, out / CLOUDS, data_dir)
    except Qs3Error as reason:
        clouds, skipped["clouds"] = None, str(reason)
        (out / CLOUDS).unlink(missing_ok=True)
    write_text(out / PAGE, page(run, pictures, skipped, CLOUDS if clouds else ""))
    return Drawn(pictures, skipped, run.notes, out / PAGE, clouds)


def _write_clouds(run: RunFiles, path: Path, data_dir: str | Path | None) -> Path:
    part = part_of_run(run, worst_first(run)[:_CLOUDS], data_dir, residuals=False)
    write_text(path, turnable_page(run.title, [part], points=_POINTS))
    return path


def _makers(
    run: RunFiles, data_dir: str | Path | None, embed: bool, packages: Sequence[str]
) -> dict[str, Callable[[Path], object]]:
    """What writes each picture, in the order of the page."""

    def classes() -> Figure:
        return run_figures.classes(run, _train_labels(run, data_dir))

    def embedding() -> Figure:
        from qs3.inference.model_file import PACKAGES  # torch
        from qs3.report.runs.embedding import draw_embedding

        return draw_embedding(run, data_dir, packages=(*PACKAGES, *packages))

    figures: dict[str, Callable[[], Figure]] = {
        "curves": lambda: run_figures.curves(run),
        "confusion": lambda: run_figures.confusion(run),
        "pseudo_labels": lambda: run_figures.pseudo_labels(run),
        "classes": classes,
        "calibration": lambda: run_figures.calibration(run),
    }
    if embed:
        figures["embedding"] = embedding
    saving = {name: partial(_save, make) for name, make in figures.items()}
    return {**saving, **cloud_pictures(run, data_dir)}


def _train_labels(run: RunFiles, data_dir: str | Path | None) -> np.ndarray | None:
    """[n] labels of the target's training split, if the run's dataset is there and has some."""
    from qs3.report.runs.domains import open_domain

    try:
        data = open_domain(run, "target", data_dir)
    except (Qs3Error, NothingToDrawError):
        return None  # the picture is complete without them
    return np.array(data.labels[data.indices("train")]) if data.labelled else None


def _save(make: Callable[[], Figure], path: Path) -> None:
    save_png(make(), path)


@dataclass(frozen=True)
class AfterTraining:
    """Draws a finished run's pictures, and logs them to wandb's active run, if there is one.

    A picture that cannot be made is a warning: the result is saved already.

    Attributes:
        pictures: False draws nothing, "auto" nothing in a sweep: they would take as long as many a
            run, and the sweep draws its first run's (`of_sweep`).
    """

    pictures: bool | Literal["auto"] = "auto"

    def __call__(self, folder: Path, config: Mapping[str, Any] | None = None) -> None:
        """Draw those of the run in `folder`, by its composed config or the one that lies there."""
        if not self.pictures or (self.pictures == "auto" and in_multirun()):
            return
        try:
            drawn = draw(folder, embed=False, config=config)
            _log_to_wandb(drawn, read_metrics(folder))
            log.info("pictures: %s", drawn.page)
        except Exception as error:
            log.warning(
                "the run is finished, but its pictures failed (%s: %s); qs3 report page "
                "run=%s draws them again",
                type(error).__name__,
                error,
                folder,
            )


def of_sweep(folders: Sequence[Path]) -> str:
    """Draw the first finished run's pictures, unless it has some; what is said of it.

    Args:
        folders: of the runs that left their pictures to the sweep, in order.

    Returns:
        A line with the page, and how to draw another run's; "" if no run is finished, or where a
        warning has said that its pictures failed.
    """
    first = next((folder for folder in folders if read_metrics(folder) is not None), None)
    if first is None:
        return ""
    path = first / FOLDER / PAGE
    if not path.is_file():
        AfterTraining(pictures=True)(first)
    if not path.is_file():
        return ""
    more = "; of another run: qs3 report page run=PATH" if len(folders) > 1 else ""
    return f"pictures: {path}{more}\n"


def _log_to_wandb(drawn: Drawn, metrics: RunMetrics | None) -> None:
    import sys

    wandb: Any = sys.modules.get("wandb")  # not imported: there is no such logger
    if wandb is None or wandb.run is None or metrics is None:
        return
    content: dict[str, Any] = {
        f"pictures/{name}": wandb.Image(str(path)) for name, path in drawn.pictures.items()
    }
    final = metrics.final
    if final.confusion is not None:
        names = list(final.predicted)
        content["confusion"] = wandb.Table(
            columns=["true class", *names],
            data=[[name, *row] for name, row in zip(names, final.confusion, strict=True)],
        )
    wandb.run.log(content)
    wandb.run.summary.update(
        {
            f"final/{key}": value
            for key, value in vars(final).items()
            if isinstance(value, int | float) and not isinstance(value, bool)
        }
    )
