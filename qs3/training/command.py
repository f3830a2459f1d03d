"""The story of the train command, top to bottom."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import sys
from collections.abc import Iterator

from omegaconf import DictConfig, OmegaConf

from qs3.config.hydra import build, is_given
from qs3.datasets.ensure_source import check_or_make
from qs3.errors import ConfigError
from qs3.evaluation.estimates_text import in_words
from qs3.evaluation.selection_rules import chosen_in_words
from qs3.runs.folder import read_code
from qs3.runs.metrics import METRICS, RunMetrics, read_metrics, write_metrics
from qs3.runs.predictions import OF_FILES
from qs3.training.code import changed_files
from qs3.training.reuse import refuse_changed
from qs3.training.run import Run, run_of
from qs3.training.settings import check_run, check_settings
from qs3.utils.locks import owned

log = logging.getLogger(__name__)


def train(cfg: DictConfig) -> RunMetrics:
    """Train, continue or skip the run that `cfg` describes; returns what `metrics.json` holds.

    Everything that can be wrong with the settings or the data is found before torch is imported.
    """
    check_settings(cfg)
    run = run_of(cfg)
    check_run(run)
    if int(os.environ.get("LOCAL_RANK", 0)) > 0:  # DDP: the first process owns the folder
        with _wandb_forgotten():
            return _fit(run)

    _warn_of_one_domain(run)
    _warn_of_epochs(run)
    _warn_of_a_warmup_for_nothing(run)
    with owned(run.folder):
        # What `force` begins anew stays until its data are open (`note_start`).
        metrics = None if cfg.force else read_metrics(run.folder)
        if metrics is None:
            run.target.tell_of_judging("data.target.")
            with _wandb_forgotten():
                metrics = _fit(run)
                write_metrics(run.folder, metrics)
                _report(run)
        else:
            refuse_changed(run, metrics)
            log.info("already finished%s (force=true repeats it)", _by_other_code(run))
    log.info("%s", headline(metrics) if cfg.objective is None else judged(cfg, metrics))
    if (run.folder / OF_FILES).is_file():
        log.info("the class of each file: %s", run.folder / OF_FILES)
    log.info("see %s", run.folder / METRICS)
    return metrics


def _by_other_code(run: Run) -> str:
    """Whether code that a finished run ran has been edited since, as far as anybody knows."""
    edited = changed_files(read_code(run.folder))
    return f", before an edit of {' and '.join(edited)}" if edited else ""


def objective_of(cfg: DictConfig, metrics: RunMetrics) -> float | None:
    """What a search over hyper-parameters looks at; None if there is no search.

    NaN for a run that has diverged: it is finished, and would diverge again.

    Raises:
        ConfigError: the finished run has no such figure.
    """
    if cfg.objective is None:
        return None
    if cfg.objective not in metrics.validators:
        raise ConfigError(
            f"objective={cfg.objective} needs a target with two training clouds or more"
        )
    value = metrics.validators[cfg.objective]
    return math.nan if value is None else value


def judged(cfg: DictConfig, metrics: RunMetrics) -> str:
    """The result of a search's trial in one line: no accuracy, it would be nothing to choose by."""
    value = metrics.validators.get(cfg.objective)
    text = "none: the net has diverged" if value is None else f"{value:.4f}"
    return f"{metrics.experiment}, seed {metrics.seed}: objective={cfg.objective} {text}"


def headline(metrics: RunMetrics) -> str:
    """The result in one line; says what the data are made of, and when the target is simulated."""
    final, run = metrics.final, f"{metrics.experiment}, seed {metrics.seed}: "
    if metrics.diverged:
        run += "the net has diverged, its predictions are no numbers; "
    target = metrics.target_text
    if final.accuracy is None:
        counts = ", ".join(f"{name} {count}" for name, count in final.predicted.items() if count)
        estimate = in_words(metrics.quality)
        return (
            f"{run}no labels to judge {target} by; predicted {counts}"
            f"{f'; {estimate}' if estimate else ''}; data: {metrics.data_text}{_chosen(metrics)}"
        )
    return (
        f"{run}accuracy {final.accuracy:.1%}, balanced {final.balanced_accuracy:.1%} "
        f"on {target}, majority rate {final.majority_rate:.1%}{_told(metrics)}; "
        f"data: {metrics.data_text}"
        f"{_chosen(metrics)}"
    )


def _told(metrics: RunMetrics) -> str:
    """That predictions were told how common classes are."""
    return "; with evaluation.prior" if metrics.evaluation.prior else ""


def _chosen(metrics: RunMetrics) -> str:
    """How teacher and student were selected, for the end of the headline."""
    teacher, student = map(chosen_in_words, (metrics.selection.teacher, metrics.selection.student))
    if teacher == student:  # no rounds
        return f"; selected by {teacher}"
    return f"; teacher selected by {teacher}; student by {student}"


def _fit(run: Run) -> RunMetrics:
    if run.cfg.ckpt_path is not None:  # before hours are spent on making the source
        from qs3.training.resume import checkpoint_asked_for

        checkpoint_asked_for(run)
    check_or_make(run.source, run.target, run.cfg.data.make_source)
    from qs3.training.fit import fit  # torch and Lightning from here on

    return fit(run)


def _report(run: Run) -> None:
    """Hand the finished run to what `report` names, e.g. its pictures: training imports none."""
    build(run.cfg.report)(run.folder, OmegaConf.to_container(run.cfg, resolve=False))


@contextlib.contextmanager
def _wandb_forgotten() -> Iterator[None]:
    """End wandb's run after the block: it would live on into the next job of a multirun."""
    try:
        yield
    finally:
        if "wandb" in sys.modules:
            sys.modules["wandb"].finish()
            os.environ.pop("WANDB_MODE", None)  # set by Lightning's logger when offline


def _warn_of_epochs(run: Run) -> None:
    """Of epochs that somebody asked for, of a phase whose budget in steps a file of conf/ sets."""
    budgets = {"protocol": run.phases.warmup_steps}
    if run.scheme.rounds:
        budgets["selftraining"] = run.phases.round_steps
    for group, steps in budgets.items():
        if steps is not None and is_given(f"{group}.epochs") and not is_given(f"{group}.steps"):
            log.warning(
                "%s.epochs=%s trains neither longer nor shorter: it divides the %d batches of "
                "%s.steps, which %s.steps=null takes away",
                group,
                run.cfg[group].epochs,
                steps,
                group,
                group,
            )


def _warn_of_a_warmup_for_nothing(run: Run) -> None:
    """Of steps before the rounds, which begin with a classifier that was given."""
    if run.cfg.selection.teacher == "given" and run.scheme.rounds and run.phases.warmup_steps != 1:
        log.warning(
            "selection.teacher=given: the classifier of weights= labels the target as it is, and "
            "what the warm-up trains is used for nothing; protocol.epochs=1 protocol.steps=1 is "
            "the shortest"
        )


def _warn_of_one_domain(run: Run) -> None:
    if run.source.folder == run.target.folder and not run.is_upper_bound:
        log.warning(
            "data.source (%s) and data.target (%s) are the same dataset: the target's training "
            "labels are used, so this is not adaptation",
            run.source.name,
            run.target.name,
        )
