"""The stories of the two commands, top to bottom."""

from __future__ import annotations

import logging
import os
from typing import Any

from omegaconf import DictConfig

from qs3 import runs
from qs3.data.domain import check_all
from qs3.data.store import is_finished
from qs3.errors import ConfigError
from qs3.hydra_glue import build, in_multirun
from qs3.runs import Run
from qs3.selftraining.scheme import Phases, Scheme

log = logging.getLogger(__name__)

TEACHERS = ("source_val", "last")


def train(cfg: DictConfig) -> dict[str, Any]:
    """Train, continue or skip the run that `cfg` describes; returns what `metrics.json` holds.

    Everything that can be wrong with the settings or the data is found before torch is imported.
    """
    scheme: Scheme = build(cfg.selftraining)
    run = Run(
        cfg=cfg,
        seed=runs.check_seed(cfg.seed),
        folder=runs.run_folder(cfg),
        scheme=scheme,
        phases=Phases(cfg.protocol.epochs, scheme.rounds, scheme.epochs),
        source=build(cfg.data.source),
        target=build(cfg.data.target),
    )
    if cfg.selection.teacher not in TEACHERS:
        raise ConfigError(
            f"selection.teacher must be one of {TEACHERS}, got {cfg.selection.teacher!r}"
        )
    _refuse_ddp_in_multirun(cfg)
    if int(os.environ.get("LOCAL_RANK", 0)) > 0:  # DDP: the first process owns the folder
        return _fit(run)

    with runs.locked(run.folder):
        if cfg.force:
            runs.clear(run.folder)
        metrics = runs.read_metrics(run.folder)
        if metrics is None:
            metrics = _fit(run)
            runs.write_metrics(run.folder, metrics)
        else:
            _refuse_other_data(run, metrics["data"])
            log.info("already finished (force=true repeats it)")
    log.info("%s", headline(metrics))
    log.info("see %s", run.folder / runs.METRICS)
    return metrics


def headline(metrics: dict[str, Any]) -> str:
    """The result in one line; says when the target is simulated."""
    final = metrics["final"]
    return (
        f"{metrics['experiment']}, seed {metrics['seed']}: accuracy {final['accuracy']:.1%}, "
        f"balanced {final['balanced_accuracy']:.1%} on {metrics['target']}"
        f"{' (simulated)' if metrics['simulated'] else ''}, "
        f"majority rate {final['majority_rate']:.1%}"
    )


def _fit(run: Run) -> dict[str, Any]:
    check_all(run.source, run.target)
    from qs3.training import fit  # torch and Lightning from here on

    return fit(run)


def _refuse_other_data(run: Run, hashes: dict[str, str]) -> None:
    """Raise if a dataset is there and is not the one that the finished run used."""
    for role, domain in (("source", run.source), ("target", run.target)):
        if is_finished(domain.folder):  # else it was put away since, and the result stands
            runs.check_data(run.folder, domain.name, hashes[role], domain.open(verify=False).sha256)


def _refuse_ddp_in_multirun(cfg: DictConfig) -> None:
    """Lightning would start each further process with the whole sweep's command line."""
    several = str(cfg.trainer.get("devices", 1)) not in ("1", "[0]") or (
        cfg.trainer.get("num_nodes", 1) > 1
    )
    if several and in_multirun():
        raise ConfigError(
            "trainer uses several processes (DDP), which cannot be swept with -m; run each seed by "
            "itself, or sweep one-process runs with hydra/launcher=joblib"
        )
