"""The story of the train command, top to bottom."""

import contextlib
import logging
import math
import os
import sys
from collections.abc import Iterator

from omegaconf import DictConfig, OmegaConf

from qs3.config.hydra import build
from qs3.datasets.domain import check_or_make
from qs3.evaluation.validators import chosen_in_words
from qs3.runs.folder import read_started
from qs3.runs.metrics import METRICS, RunMetrics, read_metrics, write_metrics
from qs3.runs.predictions import OF_FILES
from qs3.training.provenance import changed_files, refuse_changed
from qs3.training.run import Run, run_of
from qs3.utils.files import owned

log = logging.getLogger(__name__)


def train(cfg: DictConfig) -> RunMetrics:
    """Train, continue or skip the run that `cfg` describes; returns what `metrics.json` holds."""
    run = run_of(cfg)
    if int(os.environ.get("LOCAL_RANK", 0)) > 0:  # DDP: the first process owns the folder
        with _wandb_forgotten():
            return _fit(run)

    if run.source.folder == run.target.folder and not run.is_upper_bound:
        log.warning("data.source and data.target are the same dataset: this is not adaptation")
    with owned(run.folder):
        # What `force` begins anew stays until its data are open (`note_start`).
        metrics = None if cfg.force else read_metrics(run.folder)
        if metrics is None:
            with _wandb_forgotten():
                metrics = _fit(run)
                write_metrics(run.folder, metrics)
                # What `report` names, e.g. its pictures: training imports none.
                build(cfg.report)(run.folder, OmegaConf.to_container(cfg, resolve=False))
        else:
            refuse_changed(run, metrics)
            edited = " and ".join(changed_files((read_started(run.folder) or {}).get("files", {})))
            edited = f", before an edit of {edited}" if edited else ""
            log.info("already finished%s (force=true repeats it)", edited)
    log.info("%s", headline(metrics) if cfg.objective is None else judged(cfg, metrics))
    if (run.folder / OF_FILES).is_file():
        log.info("the class of each file: %s", run.folder / OF_FILES)
        log.info("of other scans: qs3 predict ckpt=%s input=PATH", run.folder)
    log.info("see %s", run.folder / METRICS)
    return metrics


def objective_of(cfg: DictConfig, metrics: RunMetrics) -> float | None:
    """What a search looks at, NaN for a run that has diverged; None without a search."""
    if cfg.objective is None:
        return None
    return math.nan if metrics.infomax is None else metrics.infomax


def judged(cfg: DictConfig, metrics: RunMetrics) -> str:
    """The result of a search's trial in one line: no accuracy, it would be nothing to choose by."""
    value = metrics.infomax
    text = "none: the net has diverged" if value is None else f"{value:.4f}"
    return f"{metrics.experiment}, seed {metrics.seed}: objective={cfg.objective} {text}"


def headline(metrics: RunMetrics) -> str:
    """The result in one line, with what the data are made of and how weights were selected."""
    final, target = metrics.final, metrics.target_text
    text = f"{metrics.experiment}, seed {metrics.seed}: "
    if metrics.diverged:
        text += "the net has diverged, its predictions are no numbers; "
    if final.accuracy is None:
        counts = ", ".join(f"{name} {count}" for name, count in final.predicted.items() if count)
        text += f"no labels to judge {target} by; predicted {counts}"
    else:
        text += f"accuracy {final.accuracy:.1%}, balanced {final.balanced_accuracy:.1%} "
        text += f"on {target}, majority rate {final.majority_rate:.1%}"
        text += "; with evaluation.prior" if metrics.evaluation.prior else ""
    teacher, student = map(chosen_in_words, (metrics.selection.teacher, metrics.selection.student))
    chosen = f"teacher selected by {teacher}; student by {student}"
    if teacher == student:  # no rounds
        chosen = f"selected by {teacher}"
    return f"{text}; data: {metrics.data_text}; {chosen}"


def _fit(run: Run) -> RunMetrics:
    check_or_make(run.source, run.target, run.cfg.data.make_source)
    from qs3.training.evaluate import evaluate  # torch and Lightning from here on
    from qs3.training.fit import fit

    loaded, built = fit(run)
    return evaluate(run, loaded, built)


@contextlib.contextmanager
def _wandb_forgotten() -> Iterator[None]:
    """End wandb's run after the block: it would live on into the next job of a multirun."""
    try:
        yield
    finally:
        if "wandb" in sys.modules:
            sys.modules["wandb"].finish()
            os.environ.pop("WANDB_MODE", None)  # set by Lightning's logger when offline
