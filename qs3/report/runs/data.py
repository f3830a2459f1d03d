"""What a run's folder says about the run, read for its pictures. Needs neither torch nor data.

Everything is read from the files that training writes (see `qs3.runs.folder`); what an unfinished
run does not have is None, and what is damaged is refused by the name of its file.
"""

from __future__ import annotations

import csv
import io
import math
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped

from qs3.errors import DataError, MissingDataError
from qs3.runs import folder as runs
from qs3.runs.metrics import METRICS, RoundRecord, RunMetrics, Scores, read_metrics
from qs3.runs.predictions import FILE as PREDICTIONS
from qs3.runs.predictions import Predictions, read_predictions
from qs3.runs.pseudo_labels import PseudoLabel, path_of, read_pseudo_labels
from qs3.utils.memory import TABLE_PEAK, YAML_PEAK, read_whole
from qs3.utils.yamls import check_yaml

HISTORY = "history.csv"

_ROUND = re.compile(r"round_(\d+)")


@dataclass(frozen=True, eq=False)
class History:
    """`history.csv`, one entry an epoch.

    Attributes:
        epoch: [n] counted from 0.
        phase: [n] 0 in the warm-up, r + 1 in round r.
        learning_rate: [n].
        loss: [n] by column; NaN where an epoch has none.
        accuracy: [n] in [0, 1] likewise, of held-out labelled clouds, such as "source_val/acc".
    """

    epoch: Int[np.ndarray, " n"]
    phase: Int[np.ndarray, " n"]
    learning_rate: Float[np.ndarray, " n"]
    loss: Mapping[str, Float[np.ndarray, " n"]]
    accuracy: Mapping[str, Float[np.ndarray, " n"]]

    def spans(self) -> list[tuple[int, int, int]]:
        """Phase, its first and its last epoch, in order."""
        return [
            (int(p), int(self.epoch[self.phase == p].min()), int(self.epoch[self.phase == p].max()))
            for p in np.unique(self.phase)
        ]


@dataclass(frozen=True, eq=False)
class Round:
    """One round of self-training.

    Attributes:
        number: from 0.
        record: what metrics.json says; None in an unfinished run.
        labels: its pseudo_labels.csv; None if that is gone.
    """

    number: int
    record: RoundRecord | None
    labels: list[PseudoLabel] | None

    def named(self, classes: tuple[str, ...]) -> Int[np.ndarray, " c"] | None:
        """How many target clouds the teacher gave to each class; None if not known."""
        return None if self.labels is None else _count([row.label for row in self.labels], classes)

    def selected(self, classes: tuple[str, ...]) -> Int[np.ndarray, " c"] | None:
        """How many of them are trained on: from the table, else from metrics.json."""
        if self.labels is not None:
            return _count([row.label for row in self.labels if row.selected], classes)
        return self.of_class("selected", classes)

    def confident(self, classes: tuple[str, ...]) -> Int[np.ndarray, " c"] | None:
        """How many were sure enough to be candidates."""
        return self.of_class("confident", classes)

    def of_class(self, key: str, classes: tuple[str, ...]) -> Shaped[np.ndarray, " c"] | None:
        """What the record says by class: "confident", "selected", "mu" or "thresholds"."""
        values = None if self.record is None else getattr(self.record, key)
        return None if values is None else np.array([values.get(name, 0) for name in classes])


@dataclass(frozen=True, eq=False)
class RunFiles:
    """A run, read.

    Attributes:
        folder: of the run.
        metrics: contents of metrics.json; None if the run is not finished.
        history: None if not one epoch is done.
        rounds: in order.
        predictions: None if there are none yet.
        classes: names in label order.
        config: as composed, not resolved; None if Hydra did not write it.
        command: that started the run; None likewise.
        notes: what is missing, as text.
    """

    folder: Path
    metrics: RunMetrics | None
    history: History | None
    rounds: tuple[Round, ...]
    predictions: Predictions | None
    classes: tuple[str, ...]
    config: Mapping[str, Any] | None
    command: str | None
    notes: tuple[str, ...]

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

    @property
    def final(self) -> Scores | None:
        """The reported figures; None in an unfinished run."""
        return None if self.metrics is None else self.metrics.final


def is_run(folder: Path) -> bool:
    """Whether it is the folder of a run, finished or not."""
    return any((folder / name).exists() for name in (METRICS, runs.STARTED, HISTORY))


def read_run(folder: str | Path) -> RunFiles:
    """Read a run's folder.

    Raises:
        MissingDataError: it is not a run's folder.
        DataError: one of its files is damaged.
    """
    folder = Path(folder).expanduser()
    if not is_run(folder):
        raise MissingDataError(
            f"{folder} is not the folder of a run: it has no {METRICS} and no {HISTORY}; give "
            "<paths.log_dir>/<experiment_name>/seed<seed>-<hash>"
        )
    metrics, notes = read_metrics(folder), []
    if metrics is None:
        notes.append("the run is not finished: the same command continues it")
    predictions = None
    if (folder / PREDICTIONS).is_file():
        predictions = read_predictions(folder / PREDICTIONS)
    elif metrics is not None:
        notes.append(f"{PREDICTIONS} is gone")
    rounds = _rounds(folder, metrics, notes)
    typed = _yaml(folder / ".hydra" / "overrides.yaml", list)
    return RunFiles(
        folder=folder,
        metrics=metrics,
        history=_history(folder / HISTORY),
        rounds=rounds,
        predictions=predictions,
        classes=_classes(metrics, predictions, rounds),
        config=_yaml(folder / ".hydra" / "config.yaml", dict),
        command=None if typed is None else shlex.join(["python", "train.py", *map(str, typed)]),
        notes=tuple(notes),
    )


def _history(path: Path) -> History | None:
    if not path.is_file():
        return None
    try:
        text = read_whole(path, TABLE_PEAK).decode()
        rows = list(csv.DictReader(io.StringIO(text, newline="")))
        if not rows:
            return None

        def column(name: str) -> np.ndarray:
            cells = [row[name] for row in rows]
            return np.array([float(cell) if cell else math.nan for cell in cells])

        names = [name for name in rows[0] if name]
        return History(
            epoch=np.array([int(row["epoch"]) for row in rows]),
            phase=np.array([int(row["phase"]) for row in rows]),
            learning_rate=column("lr"),
            loss={name: column(name) for name in names if "loss" in name},
            accuracy={name: column(name) for name in names if name.endswith("_val/acc")},
        )
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise _damaged(path, error) from error


def _rounds(folder: Path, metrics: RunMetrics | None, notes: list[str]) -> tuple[Round, ...]:
    records = {record.round: record for record in (metrics.rounds if metrics else [])}
    there = {
        int(match[1])
        for path in folder.glob("round_*")
        if (match := _ROUND.fullmatch(path.name)) and path_of(folder, int(match[1])).is_file()
    }
    found = []
    for number in sorted({*records, *there}):
        path, labels = path_of(folder, number), None
        if number in there:
            labels = read_pseudo_labels(path)
        else:
            notes.append(f"{path.relative_to(folder)} is gone: counts are those of {METRICS}")
        found.append(Round(number, records.get(number), labels))
    return tuple(found)


def _classes(
    metrics: RunMetrics | None, predictions: Predictions | None, rounds: tuple[Round, ...]
) -> tuple[str, ...]:
    """In label order, where anything says what that is; else the names found, sorted."""
    if predictions is not None:
        return predictions.classes
    if metrics is not None:
        return tuple(metrics.final.predicted)
    return tuple(sorted({row.label for round_ in rounds for row in round_.labels or []}))


def _yaml(path: Path, kind: type) -> Any:
    """What a file of Hydra's holds, not resolved; None if it is not there, or not of that kind."""
    from omegaconf import OmegaConf

    if not path.is_file():
        return None
    try:
        check_yaml(text := read_whole(path, YAML_PEAK).decode(), "its text")
        found: Any = OmegaConf.to_container(OmegaConf.create(text), resolve=False)
    except Exception as error:  # yaml's and omegaconf's kinds have nothing else in common
        raise _damaged(path, error) from error
    return found if isinstance(found, kind) else None


def _count(names: list[str], classes: tuple[str, ...]) -> np.ndarray:
    return np.array([names.count(name) for name in classes])


def _damaged(path: Path, error: Exception) -> DataError:
    what = str(error).splitlines()[0] if str(error) else type(error).__name__
    return DataError(
        f"{path} is damaged ({type(error).__name__}: {what}); repeat the run with force=true"
    )


def settings_of(run: RunFiles) -> str | None:
    """The composed config as YAML, sorted; None if it is not there."""
    from omegaconf import OmegaConf

    return None if run.config is None else OmegaConf.to_yaml(dict(run.config), sort_keys=True)
