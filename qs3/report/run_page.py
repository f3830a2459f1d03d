"""A run's page: its results, charts as files in `<run>/pictures`, and clouds with predictions.

What an unfinished run does not have is None. A chart that has nothing to show is left out, and the
page gives the reason. Labels of the target judge a finished run; nothing is chosen by them.
"""

import dataclasses
import logging
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from omegaconf import OmegaConf

from qs3.config.hydra import in_multirun
from qs3.datasets.domain import Domain
from qs3.errors import MissingDataError, Qs3Error
from qs3.evaluation.validators import chosen_in_words
from qs3.inference.page import confusion_rows
from qs3.report.datasets import opened_domain, part_of
from qs3.report.viewer import Part, viewer
from qs3.runs import folder as runs
from qs3.runs.metrics import METRICS, RoundRecord, RunMetrics, read_metrics
from qs3.runs.predictions import FILE as PREDICTIONS
from qs3.runs.predictions import Predictions, read_predictions
from qs3.store.meta import is_finished
from qs3.store.store import PointSet
from qs3.utils.files import make_folder, reading, write_text
from qs3.utils.page import render
from qs3.utils.pictures import BLUE, GREEN, GRID, ORANGE, RED, SOFT, blank, save_png

log = logging.getLogger(__name__)

FOLDER, PAGE, HISTORY = "pictures", "index.html", "history.csv"
_CLOUDS, _POINTS = 30, 1024  # on the page: a quarter of a megabyte a run
_DOMAIN = tuple(field.name for field in dataclasses.fields(Domain))


@dataclass(frozen=True, eq=False)
class RunFiles:
    """A run's folder, read: what is not there (yet) is None.

    `history` has a row an epoch, `classes` names in label order; `config` is as composed, not
    resolved, and `command` started the run.
    """

    folder: Path
    metrics: RunMetrics | None
    history: pd.DataFrame | None
    predictions: Predictions | None
    classes: tuple[str, ...]
    config: Mapping[str, Any] | None
    command: str

    @property
    def title(self) -> str:
        """Such as "qs3_s2d, seed 0"."""
        if self.metrics is None:
            return f"{self.folder.parent.name}/{self.folder.name} (not finished)"
        return f"{self.metrics.experiment}, seed {self.metrics.seed}"


def is_run(folder: Path) -> bool:
    """Whether it is the folder of a run, finished or not."""
    return any((folder / name).exists() for name in (METRICS, runs.STARTED, HISTORY))


def read_run(folder: str | Path) -> RunFiles:
    """Read a run's folder."""
    folder = Path(folder).expanduser()
    if not is_run(folder):
        raise MissingDataError(f"{folder} is not the folder of a run")
    metrics, predictions, history = read_metrics(folder), None, None
    if (folder / PREDICTIONS).is_file():
        predictions = read_predictions(folder / PREDICTIONS)
    classes = tuple(metrics.final.predicted) if metrics else ()
    hydra: dict[str, Any] = {"config": None, "overrides": ()}
    with reading(f"{folder}: {HISTORY} or .hydra"):
        if (folder / HISTORY).is_file():
            history = pd.read_csv(folder / HISTORY)
            history = history if len(history) else None
        for name in hydra:
            if (path := folder / ".hydra" / f"{name}.yaml").is_file():
                hydra[name] = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
    command = shlex.join(["python", "train.py", *map(str, hydra["overrides"])])
    return RunFiles(folder, metrics, history, predictions, classes, hydra["config"], command)


def _target_of(run: RunFiles, data_dir: str | Path | None) -> tuple[Domain, PointSet]:
    """The target as the run's config describes it, and its dataset, if it is the one that was used.

    Nothing is imported or made.
    """
    if run.config is None:
        raise MissingDataError(f"{run.folder} has no .hydra/config.yaml that names its data")
    cfg = OmegaConf.create(dict(run.config))
    if data_dir is not None:
        cfg.paths.data_dir = str(Path(data_dir).absolute())
    found: Any = OmegaConf.to_container(cfg.data.target, resolve=True)
    # Not instantiated: the folder may be somebody else's, and a config can name any code.
    about = {key: found[key] for key in _DOMAIN if key in found}
    domain = Domain(**{**about, "published": None, "synthesis": None})
    if run.metrics is None or not is_finished(domain.folder):
        raise MissingDataError(f"the run's target, {domain.name}, is not at {domain.folder}")
    data = domain.open(verify=False)
    if data.sha256 != run.metrics.data.target:
        raise MissingDataError(f"{domain.folder} is not the {domain.name} that the run used")
    return domain, data


class Drawn(NamedTuple):
    """What became of a run's pictures: PNG by name, reasons by name, and the page."""

    pictures: dict[str, Path]
    skipped: dict[str, str]
    page: Path


def draw(
    folder: str | Path,
    out: str | Path | None = None,
    *,
    data_dir: str | Path | None = None,
    config: Mapping[str, Any] | None = None,
) -> Drawn:
    """Draw a run's pictures; those of an earlier call are replaced.

    Args:
        folder: of the run.
        out: folder for the files; None: `pictures` in the run's.
        data_dir: where the datasets lie; None: where the run's config says.
        config: of the run; None: what Hydra wrote into its folder.
    """
    run = read_run(folder)
    if config is not None:
        run = dataclasses.replace(run, config=config)
    out = make_folder(run.folder / FOLDER if out is None else Path(out))
    pictures: dict[str, Path] = {}
    skipped: dict[str, str] = {}
    clouds: dict[str, Any] = {"about": (), "notes": (), "data": None}
    if run.history is None:
        skipped["curves"] = "no epoch is done yet"
    else:
        pictures["curves"] = out / "curves.png"
        save_png(_curves(run, run.history), pictures["curves"])
    try:
        clouds = viewer([worst_clouds(run, _CLOUDS, data_dir=data_dir)], points=_POINTS)
    except Qs3Error as error:  # damaged data cost their pictures alone
        skipped["clouds"] = str(error)
    m = run.metrics
    rounds = confusion = None
    if m and m.rounds:
        table = pseudo_labels(m.rounds, run.classes)
        rounds = table.to_html(border=0, float_format="{:.2f}".format, na_rep="")
    if m and m.final.confusion:
        confusion = confusion_rows(np.array(m.final.confusion), run.classes)
    page = render(
        "run.html",
        title=run.title,
        m=m,
        chosen_in_words=chosen_in_words,
        confusion=confusion,
        rounds=rounds,
        command=run.command,
        pictures=[(name, path.read_bytes()) for name, path in pictures.items()],
        skipped=skipped,
        settings=run.config and OmegaConf.to_yaml(dict(run.config), sort_keys=True),
        **clouds,
    )
    write_text(out / PAGE, page)
    return Drawn(pictures, skipped, out / PAGE)


def _curves(run: RunFiles, history: pd.DataFrame) -> Figure:
    """Loss, held-out accuracy in percent and learning rate over the epochs, phases shaded.

    `history` has a row an epoch; the epochs of teacher and student are marked.
    """
    figure = blank(8.5, 7.2, 130, constrained=True)
    figure.suptitle(f"{run.title}: training", fontsize=11)
    axes = figure.subplots(3, sharex=True, gridspec_kw={"height_ratios": (1.0, 1.0, 0.6)})
    epochs = history["epoch"] + 1  # people count from 1
    panels = {
        "training loss": [name for name in history if "loss" in name],
        "held-out accuracy in %": [name for name in history if name.endswith("_val/acc")],
        "learning rate": ["lr"],
    }
    for ax, (label, names) in zip(axes, panels.items(), strict=True):
        for name, colour in zip(names, (BLUE, ORANGE, GREEN, RED), strict=False):
            known = (100 if "acc" in name else 1) * history[name].dropna()
            ax.plot(epochs[known.index], known, ".-", color=colour, label=name, linewidth=1.3,
                    markersize=4)  # fmt: skip
        ax.set_ylabel(label)
        ax.grid(axis="y", color=GRID, linewidth=0.7)
        ax.tick_params(labelsize=9, color=GRID)
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)
        ax.spines[["left", "bottom"]].set_color(GRID)
    axes[1].set_ylim(0, 102)
    axes[2].set(ylim=(0, None), xlabel="epoch")
    for phase, of in history.groupby("phase")["epoch"]:
        for ax in axes[: 3 * (phase % 2 == 0)]:
            ax.axvspan(of.min() + 0.5, of.max() + 1.5, color="#f0f3f7", zorder=0, linewidth=0)
        axes[0].text(of.mean() + 1, 1.02, "warm-up" if phase == 0 else phase - 1, ha="center",
                     transform=axes[0].get_xaxis_transform(), fontsize=8.5,
                     color=SOFT)  # fmt: skip
    # Epochs from 0; -1 where there is none.
    if run.metrics and (epoch := run.metrics.warmup.selected.epoch) >= 0:
        for ax in axes:
            ax.axvline(epoch + 1, color=RED, linestyle="--", linewidth=1.1,
                       label=f"teacher: epoch {epoch + 1}")  # fmt: skip
    for ax in axes[:2]:
        ax.legend(fontsize=8.5, frameon=False)
    return figure


def pseudo_labels(rounds: Sequence[RoundRecord], classes: Sequence[str]) -> pd.DataFrame:
    """A table of each round (column): by class selected/confident and mu or the threshold; theta.

    And what they are worth: precision and recall know the target's labels, which judge alone.
    """
    columns = {}
    for one in rounds:
        kept, by_class = ("thresholds", one.thresholds) if one.mu is None else ("mu", one.mu)
        column: dict[str, Any] = {}
        for name in classes:
            share = f", {kept} {by_class[name]:.2f}" if by_class and name in by_class else ""
            column[name] = f"{one.selected.get(name, 0)}/{one.confident.get(name, 0)}{share}"
        column["theta"] = one.theta
        if one.agreement is not None:
            column["same label as before"] = one.agreement
        if judged := one.with_target_labels:
            column["precision (evaluation only)"] = judged.precision
            column["recall (evaluation only)"] = judged.recall
        columns[f"round {one.round}"] = column
    return pd.DataFrame(columns)


def worst_clouds(
    run: RunFiles, most: int, match: str = "", data_dir: str | Path | None = None
) -> Part:
    """At most so many clouds of a run's target, whose ids hold `match`, with its predictions.

    First the errors, the most confident before the others; then all else, the least confident
    first. `data_dir`: where the datasets lie; None: where the run's config says.
    """
    p, m = run.predictions, run.metrics
    if p is None or m is None:
        raise MissingDataError(f"{run.folder} has no predictions; repeat its command")
    wrong = (p.labels >= 0) & (p.predicted != p.labels)
    sure = p.probabilities.max(axis=1)
    order = np.lexsort((np.where(wrong, -sure, sure), ~wrong))
    chosen = [int(i) for i in order if match in p.ids[i]][:most]
    domain, data = _target_of(run, data_dir)
    place = {id_: i for i, id_ in enumerate(data.ids)}
    part = part_of(opened_domain(domain, data), [place[p.ids[i]] for i in chosen])
    shown = [
        dataclasses.replace(
            one,
            label="" if p.labels[i] < 0 else p.classes[p.labels[i]],
            called=p.classes[p.predicted[i]],
            sure=float(sure[i]) if np.isfinite(sure[i]) else None,  # JSON knows no NaN
        )
        for one, i in zip(part.shown, chosen, strict=True)
    ]
    first = f"{wrong.sum()} are wrong, the most confident" if wrong.any() else "in doubt"
    about = (
        f"{run.title}, target {m.target_text}: {len(shown)} of {len(p.ids)} clouds; {first} first; "
        f"the target is made of: {m.made_of.target}; trained on {m.source} ({m.made_of.source})"
    )
    return dataclasses.replace(part, shown=shown, about=about)


@dataclass(frozen=True)
class AfterTraining:
    """Gives a finished run's scores to wandb, and draws its pictures ("auto": not in a sweep).

    A picture that cannot be made is a warning: the result is saved already.
    """

    pictures: bool | Literal["auto"] = "auto"

    def __call__(self, folder: Path, config: Mapping[str, Any] | None = None) -> None:
        """Draw those of the run in `folder`, by its composed config or the one that lies there."""
        wandb: Any = sys.modules.get("wandb")  # not imported: there is no such logger
        if wandb is not None and wandb.run is not None and (m := read_metrics(folder)):
            final = {f"final/{k}": v for k, v in vars(m.final).items() if isinstance(v, float)}
            wandb.run.summary.update(final)
        if not self.pictures or (self.pictures == "auto" and in_multirun()):
            return
        try:
            log.info("pictures: %s", draw(folder, config=config).page)
        except Exception as error:
            why = f"{type(error).__name__}: {error}"
            again = f"qs3 report page run={folder} draws them again"
            log.warning("the run is finished, but its pictures failed (%s); %s", why, again)
