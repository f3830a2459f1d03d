"""A finished run is the result of its command, unless what it was trained on has changed since."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping

from omegaconf import DictConfig

from qs3.config import hashing
from qs3.datamodules.beside import SOURCE_TWINS, beside_sha256
from qs3.datasets.domain import Domain
from qs3.errors import MissingDataError, Qs3Error
from qs3.runs import folder as runs
from qs3.runs.metrics import DataHashes, RunMetrics, read_metrics
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
    """Raise if what is there is not what the finished run used; what was put away is not asked for.

    Raises:
        DataError, ConfigError: says what it is, and what to do.
    """
    now = hashing.config_sha256(run.cfg)
    runs.check_config(run.folder, metrics.config_sha256, now, instead)
    for what, was, now in (*_data(run, metrics.data), *_weights(run, metrics.versions)):
        runs.check_data(run.folder, what, was, now, instead)


_Hashes = Iterator[tuple[str, str, str]]
"""What it is, its hash in the run, its hash now."""


def _data(run: Run, hashes: DataHashes) -> _Hashes:
    """Of the datasets that are there; one that was put away since lets the result stand."""
    used = {"source": run.source, "target": run.target}
    if run.is_upper_bound:
        del used["source"]
    for role, domain in used.items():
        if is_finished(domain.folder):
            yield domain.name, getattr(hashes, role), domain.open(verify=False).sha256
    if hashes.beside and "source" in used and is_finished(run.source.folder):
        now = _beside(run.source)
        if now and hashes.beside not in now:
            yield runs.beside(run.source.name), hashes.beside, now[0]


def _beside(source: Domain) -> list[str]:
    """Of all that could be trained on beside the source: what was, a method knows, with torch."""
    found = []
    for twin in SOURCE_TWINS:
        with contextlib.suppress(Qs3Error):  # the store lacks it
            found.append(beside_sha256(source, twin, verify=False))
    return [sha256 for sha256 in found if sha256]


def _weights(run: Run, versions: Mapping[str, str]) -> _Hashes:
    """Of the classifier that `weights` names, if it is there."""
    if run.cfg.weights is None:
        return
    from qs3.training.given import read_given  # and torch with it

    name, _, sha256 = versions.get("weights", "").rpartition(" ")
    with contextlib.suppress(MissingDataError):
        given = read_given(run.cfg)
        assert given is not None
        yield f"the classifier {name}", sha256, given.sha256
