"""A finished run is the result of its command, unless what it was trained on has changed since."""

from __future__ import annotations

import contextlib

from omegaconf import DictConfig

from qs3.config import hashing
from qs3.errors import MissingDataError
from qs3.runs import folder as runs
from qs3.runs.metrics import RunMetrics, read_metrics
from qs3.store.store import is_finished
from qs3.training.run import Run, run_of


def check_finished(cfg: DictConfig, instead: str = runs.ANEW) -> bool:
    """Whether the run that `cfg` describes is finished.

    `instead`: of bringing the old data back, for people.

    Raises:
        DataError, ConfigError: it is, and its data, its classifier or its settings have changed.
    """
    run = run_of(cfg)
    metrics = read_metrics(run.folder)
    if metrics is not None:
        refuse_changed(run, metrics, instead)
    return metrics is not None


def refuse_changed(run: Run, metrics: RunMetrics, instead: str = runs.ANEW) -> None:
    """Raise if what is there is not what the finished run used; datasets may have been put away.

    Raises:
        DataError, ConfigError: names what it is.
    """
    now = hashing.config_sha256(run.cfg)
    runs.check_config(run.folder, metrics.config_sha256, now, instead)
    used = {"source": run.source, "target": run.target}
    if run.is_upper_bound:
        del used["source"]
    for role, domain in used.items():
        if is_finished(domain.folder):
            was, now = getattr(metrics.data, role), domain.open(verify=False).sha256
            runs.check_data(run.folder, domain.name, was, now, instead)
    if run.cfg.weights is not None:
        from qs3.training.given import read_given  # and torch with it

        name, _, sha256 = metrics.versions.get("weights", "").rpartition(" ")
        with contextlib.suppress(MissingDataError):
            given = read_given(run.cfg)
            assert given is not None
            runs.check_data(run.folder, f"the classifier {name}", sha256, given.sha256, instead)
