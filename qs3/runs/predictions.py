"""A run's predictions on disk, as CSV.

predictions.csv, of the target's evaluated clouds: id; mesh (hash of the object's mesh: scans of one
mesh are not independent samples; of objects of frames their room, or their block of frames; the id
where neither is known); label (empty if it is not known); predicted; tier ("clean" or "hard", where
the dataset has tiers: else there is no such column); and a probability per class.

round_03/pseudo_labels.csv, of a round's target clouds: id, label, confidence, selected.
"""

from __future__ import annotations

import contextlib
import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.errors import DataError
from qs3.utils.files import write_text
from qs3.utils.text_table import csv_text

FILE = "predictions.csv"
OF_FILES = "predictions_of_files.csv"
_FIRST = ("id", "mesh", "label", "predicted")
_TIER = "tier"
_PSEUDO_LABELS = ("id", "label", "confidence", "selected")


@dataclass(frozen=True, eq=False)
class Predictions:
    """Predictions of n clouds.

    Attributes:
        classes: names in label order.
        ids: unique.
        meshes: cluster of each cloud.
        labels: [n] true classes; -1 where unknown.
        probabilities: [n, C] in [0, 1]; nan of a net that has diverged.
        tiers: how much of its object each cloud shows; empty where it is not known.
    """

    classes: tuple[str, ...]
    ids: tuple[str, ...]
    meshes: tuple[str, ...]
    labels: Int[np.ndarray, " n"]
    probabilities: Float[np.ndarray, "n c"]
    tiers: tuple[str, ...] = ()

    def of(self, chosen: Bool[np.ndarray, " n"]) -> Predictions:
        """Those of some clouds."""
        where = np.flatnonzero(chosen)
        return replace(
            self,
            ids=tuple(self.ids[i] for i in where),
            meshes=tuple(self.meshes[i] for i in where),
            labels=self.labels[where],
            probabilities=self.probabilities[where],
            tiers=tuple(self.tiers[i] for i in where) if self.tiers else (),
        )

    @property
    def predicted(self) -> Int[np.ndarray, " n"]:
        """The most probable class of each, the first one on ties."""
        return self.probabilities.argmax(axis=1)


def write_predictions(path: Path, predictions: Predictions) -> None:
    """Write the table, atomically; probabilities with all their digits."""
    p = predictions
    first = (*_FIRST, *([_TIER] if p.tiers else []))
    lines: list[list[str]] = [[*first, *(f"p_{name}" for name in p.classes)]]
    tiers = [[tier] for tier in p.tiers] or [[]] * len(p.ids)
    rows = zip(p.ids, p.meshes, p.labels, p.predicted, tiers, p.probabilities, strict=True)
    for id_, mesh, label, predicted, tier, row in rows:
        name = "" if label < 0 else p.classes[label]
        lines.append([id_, mesh, name, p.classes[predicted], *tier, *map(repr, row.tolist())])
    write_text(path, csv_text(lines))


def write_predictions_of_files(
    path: Path, files: Sequence[str], reasons: Sequence[str], predictions: Predictions
) -> None:
    """A table for the owner of the files: one row each, in the order of their names.

    Columns: file; class; confidence; unlike_source (yes or no), reason (in what it is unlike the
    source's; "" if in nothing); and a probability per class, to four digits.
    """
    p = predictions
    first = ("file", "class", "confidence", "unlike_source", "reason")
    lines: list[list[str]] = [[*first, *(f"p_{name}" for name in p.classes)]]
    rows = zip(files, p.predicted, reasons, p.probabilities, strict=True)
    for file, predicted, reason, row in sorted(rows, key=lambda r: r[0]):
        flag, digits = "yes" if reason else "no", [f"{value:.4f}" for value in row]
        lines.append([file, p.classes[predicted], digits[predicted], flag, reason, *digits])
    write_text(path, csv_text(lines))


def read_predictions(path: Path) -> Predictions:
    """Read the table.

    Raises:
        DataError: it is not there, or damaged.
    """
    with _named(path):
        header, rows = _read(path)
        first = len(_FIRST) + (_TIER in header[: len(_FIRST) + 1])
        classes = tuple(name.removeprefix("p_") for name in header[first:])
        found = Predictions(
            classes,
            tuple(row[0] for row in rows),
            tuple(row[1] for row in rows),
            np.array([classes.index(row[2]) if row[2] else -1 for row in rows]),
            np.array([[float(cell) for cell in row[first:]] for row in rows]),
            tuple(row[len(_FIRST)] for row in rows) if first > len(_FIRST) else (),
        )
        called = [classes.index(row[3]) for row in rows]
        if called != found.predicted.tolist() or len({*found.ids}) < len(rows):
            raise ValueError("an id occurs twice, or a class is not the most probable one")
        return found


@dataclass(frozen=True)
class PseudoLabel:
    """One row: the predicted class's name and probability, and whether it is trained on."""

    id: str
    label: str
    confidence: float
    selected: bool


def pseudo_labels_path(folder: Path, round_: int) -> Path:
    """Where the pseudo-labels of a round lie in a run's folder."""
    return folder / f"round_{round_:02d}" / "pseudo_labels.csv"


def write_pseudo_labels(
    path: Path,
    ids: Sequence[str],
    predicted: np.ndarray,
    confidence: np.ndarray,
    selected: np.ndarray,
    classes: Sequence[str],
) -> None:
    """Write the table, atomically; confidences with all their digits."""
    rows = zip(ids, predicted, confidence, selected, strict=True)
    lines = ([id_, classes[label], float(p), int(kept)] for id_, label, p, kept in rows)
    write_text(path, csv_text([_PSEUDO_LABELS, *lines]))


def read_pseudo_labels(path: Path) -> list[PseudoLabel]:
    """Read the table.

    Raises:
        DataError: it is not there, or damaged.
    """
    with _named(path):
        return [
            PseudoLabel(id_, label, float(confidence), {"0": False, "1": True}[selected])
            for id_, label, confidence, selected in _read(path)[1]
        ]


@contextlib.contextmanager
def _named(path: Path) -> Iterator[None]:
    """Turn what a damaged file raises into a DataError that names it."""
    try:
        yield
    except (OSError, ValueError, KeyError, IndexError, csv.Error) as error:
        raise DataError(f"{path} is damaged ({error}); repeat the run with force=true") from error


def _read(path: Path) -> tuple[list[str], list[list[str]]]:
    """Header and rows of a CSV file, one at least, all of one length."""
    with open(path, newline="", encoding="utf-8") as file:
        header, first, *rows = csv.reader(file, strict=True)
    if any(len(row) != len(header) for row in (first, *rows)):
        raise ValueError("rows have different lengths")
    return header, [first, *rows]
