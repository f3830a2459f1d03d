"""A run's folder, read for its pictures, and the datasets that the run used.

What an unfinished run does not have is None.
"""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qs3.datasets.domain import Domain
from qs3.errors import DataError, MissingDataError
from qs3.runs import folder as runs
from qs3.runs.metrics import METRICS, RunMetrics, read_metrics
from qs3.runs.predictions import FILE as PREDICTIONS
from qs3.runs.predictions import Predictions, read_predictions
from qs3.store.meta import is_finished
from qs3.store.store import PointSet

if TYPE_CHECKING:
    import pandas as pd

HISTORY = "history.csv"
_DOMAIN = tuple(field.name for field in dataclasses.fields(Domain))


@dataclass(frozen=True, eq=False)
class RunFiles:
    """A run, read.

    Attributes:
        folder: of the run.
        metrics: contents of metrics.json; None if the run is not finished.
        history: history.csv, one row an epoch; None if no epoch is done.
        predictions: None if there are none yet.
        classes: names in label order.
        config: as composed, not resolved; None if Hydra did not write it.
        command: that started the run.
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

    @property
    def target(self) -> str:
        """The target's name, with "(simulated)" where that is so."""
        return "the target" if self.metrics is None else self.metrics.target_text


def is_run(folder: Path) -> bool:
    """Whether it is the folder of a run, finished or not."""
    return any((folder / name).exists() for name in (METRICS, runs.STARTED, HISTORY))


def read_run(folder: str | Path) -> RunFiles:
    """Read a run's folder.

    Raises:
        MissingDataError: it is not a run's folder.
        DataError: one of its files is damaged.
    """
    import pandas as pd
    import yaml  # type: ignore[import-untyped,unused-ignore]
    from omegaconf import OmegaConf

    folder = Path(folder).expanduser()
    if not is_run(folder):
        raise MissingDataError(f"{folder} is not the folder of a run")
    metrics, predictions, history = read_metrics(folder), None, None
    if (folder / PREDICTIONS).is_file():
        predictions = read_predictions(folder / PREDICTIONS)
    classes = tuple(metrics.final.predicted) if metrics else ()
    hydra: dict[str, Any] = {"config": None, "overrides": ()}
    try:
        if (folder / HISTORY).is_file():
            history = pd.read_csv(folder / HISTORY)
            history = history if len(history) else None
        for name in hydra:
            if (path := folder / ".hydra" / f"{name}.yaml").is_file():
                hydra[name] = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
    except (OSError, ValueError, TypeError, yaml.YAMLError) as error:
        raise DataError(f"{folder}: {HISTORY} or .hydra is damaged ({error})") from error
    command = shlex.join(["python", "train.py", *map(str, hydra["overrides"])])
    return RunFiles(folder, metrics, history, predictions, classes, hydra["config"], command)


def domain_of(run: RunFiles, role: str, data_dir: str | Path | None = None) -> Domain:
    """A domain ("source" or "target") as the run's config describes it; nothing is opened.

    Raises:
        MissingDataError: there is no config.
    """
    from omegaconf import OmegaConf

    import qs3.config.hydra  # noqa: F401 (registers the resolvers of a config)

    if run.config is None:
        raise MissingDataError(f"{run.folder} has no .hydra/config.yaml that names its data")
    cfg = OmegaConf.create(dict(run.config))
    if data_dir is not None:
        cfg.paths.data_dir = str(Path(data_dir).absolute())
    found: Any = OmegaConf.to_container(cfg.data[role], resolve=True)
    # Not instantiated: the folder may be somebody else's, and a config can name any code.
    about = {key: found[key] for key in _DOMAIN if key in found}
    return Domain(**{**about, "published": None, "synthesis": None})


def open_domain(run: RunFiles, role: str, data_dir: str | Path | None = None) -> PointSet:
    """A domain's dataset, if it is the one that the run used. Nothing is imported or made.

    Raises:
        MissingDataError: the run is not finished; the dataset is not there, or is another.
        DataError: it is damaged.
    """
    domain = domain_of(run, role, data_dir)
    if run.metrics is None or not is_finished(domain.folder):
        raise MissingDataError(f"the run's {role}, {domain.name}, is not at {domain.folder}")
    data = domain.open(verify=False)
    if data.sha256 != getattr(run.metrics.data, role):
        raise MissingDataError(
            f"{domain.folder} holds another version of {domain.name} than the run used"
        )
    return data
