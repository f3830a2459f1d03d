"""The datasets of a run, found again by its config and compared with the hash in its result."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qs3.datasets.domain import Domain
from qs3.errors import DataError, Qs3Error
from qs3.report.figures.canvas import NothingToDrawError
from qs3.report.runs.data import RunFiles
from qs3.runs.predictions import FILE
from qs3.store.store import PointSet, is_finished

_KEYS = tuple(field.name for field in dataclasses.fields(Domain))


def domain_of(run: RunFiles, role: str, data_dir: str | Path | None = None) -> Domain:
    """A domain ("source" or "target") as the run's config describes it; nothing is opened.

    Raises:
        NothingToDrawError: there is no config, or it describes no domain.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    import qs3.config.hydra  # noqa: F401 (registers the resolvers of a config)

    if run.config is None:
        raise NothingToDrawError("the run's folder has no .hydra/config.yaml that names its data")
    try:
        cfg = OmegaConf.create(dict(run.config))
        if data_dir is not None:
            cfg.paths.data_dir = str(Path(data_dir).absolute())
        found: Any = OmegaConf.to_container(cfg.data[role], resolve=True)
        # Not instantiated: the folder may be somebody else's, and a config can name any code.
        about = {key: found[key] for key in _KEYS if key in found}
        return Domain(**{**about, "published": None, "synthesis": None})
    except (OmegaConfBaseException, TypeError, ValueError, Qs3Error) as error:
        raise NothingToDrawError(
            f"data.{role} of the run's .hydra/config.yaml describes no domain ({error})"
        ) from error


def open_domain(run: RunFiles, role: str, data_dir: str | Path | None = None) -> PointSet:
    """A domain's dataset, if it is the one that the run used. Nothing is imported or made.

    Raises:
        NothingToDrawError: the dataset is not there, or is another; says what to do.
        DataError: it is damaged.
    """
    domain = domain_of(run, role, data_dir)
    if run.metrics is None:
        raise NothingToDrawError("the run is not finished")
    if not is_finished(domain.folder):
        raise NothingToDrawError(
            f"its {role}, {domain.name}, is not at {domain.folder}; give data_dir="
        )
    data = domain.open(verify=False)
    if data.sha256 != getattr(run.metrics.data, role):
        raise NothingToDrawError(
            f"{domain.folder} holds another version of {domain.name} than the run used; give "
            "data_dir="
        )
    return data


def positions_in(data: PointSet, run: RunFiles, ids: Sequence[str]) -> list[int]:
    """Where the clouds of a run's predictions are in the dataset that `open_domain` gave.

    Raises:
        DataError: the dataset has no such cloud, although it is the one that the run used.
    """
    place = {id_: i for i, id_ in enumerate(data.ids)}
    if odd := next((id_ for id_ in ids if id_ not in place), ""):
        raise DataError(
            f"{run.folder / FILE} is damaged (no cloud is called {odd!r}); repeat the run with "
            "force=true"
        )
    return [place[id_] for id_ in ids]
