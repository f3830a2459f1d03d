"""The datasets of a run, found again by its config and compared with the hash in its result."""

from __future__ import annotations

from pathlib import Path

from qs3.data.domain import Domain
from qs3.data.store import PointSet, is_finished
from qs3.report.canvas import NothingToDrawError
from qs3.report.run_data import RunFiles


def domain_of(run: RunFiles, role: str, data_dir: str | Path | None = None) -> Domain:
    """A domain as the run's config describes it; nothing is opened.

    Args:
        run: as read.
        role: "source" or "target".
        data_dir: where the datasets lie; None: where the run's config says.

    Raises:
        NothingToDrawError: there is no config.
    """
    from omegaconf import OmegaConf

    from qs3.hydra_glue import build  # also registers the resolvers of a config

    if run.config is None:
        raise NothingToDrawError("the run's folder has no .hydra/config.yaml that names its data")
    cfg = OmegaConf.create(dict(run.config))
    if data_dir is not None:
        cfg.paths.data_dir = str(Path(data_dir).absolute())
    domain: Domain = build(cfg.data[role])
    return domain


def open_domain(run: RunFiles, role: str, data_dir: str | Path | None = None) -> PointSet:
    """A domain's dataset, if it is the one that the run used. Nothing is imported or made.

    Args:
        run: as read.
        role: "source" or "target".
        data_dir: where the datasets lie; None: where the run's config says.

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
    if data.sha256 != run.metrics.get("data", {}).get(role, data.sha256):
        raise NothingToDrawError(
            f"{domain.folder} holds another version of {domain.name} than the run used; give "
            "data_dir="
        )
    return data
