"""`predictions.csv`: a run's predictions for the target's evaluated clouds, one row each.

Columns: id; mesh (hash of the object's mesh: scans of one mesh are not independent samples; of
objects of frames their room, or their block of frames; the id where neither is known); label (empty
if nobody knows it); predicted; tier ("clean" or "hard", where the dataset has tiers: else there is
no such column); and a probability per class.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.errors import DataError
from qs3.utils.files import write_text
from qs3.utils.memory import TABLE_PEAK, read_whole
from qs3.utils.text_table import csv_text

FILE = "predictions.csv"
OF_FILES = "predictions_of_files.csv"
_FIRST = ("id", "mesh", "label", "predicted")
_TIER = "tier"
_ONE = 1.001  # sums in float32


@dataclass(frozen=True, eq=False)
class Predictions:
    """Predictions of n clouds.

    Attributes:
        classes: names in label order.
        ids: unique.
        meshes: cluster of each cloud.
        labels: [n] true classes; -1 where unknown.
        probabilities: [n, C] in [0, 1].
        tiers: how much of its object each cloud shows; empty where nobody knows.
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
    """A table for whoever owns the files: one row each, in the order of their names.

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
        DataError: it is not there, or not as `write_predictions` writes it.
    """
    try:
        text = read_whole(path, TABLE_PEAK).decode()
        header, *rows = list(csv.reader(io.StringIO(text, newline="")))
        first = len(_FIRST) + (header[len(_FIRST) :][:1] == [_TIER])
        classes = tuple(name.removeprefix("p_") for name in header[first:])
        if tuple(header[: len(_FIRST)]) != _FIRST or not classes or not rows:
            raise ValueError("it has other columns, or no rows")
        if len(set(classes)) < len(classes) or len({row[0] for row in rows}) < len(rows):
            raise ValueError("a class or an id occurs twice")
        if {len(row) for row in rows} != {len(header)}:
            raise ValueError("a row has more or fewer cells than columns")
        found = Predictions(
            classes,
            tuple(row[0] for row in rows),
            tuple(row[1] for row in rows),
            np.array([classes.index(row[2]) if row[2] else -1 for row in rows]),
            np.array([[float(cell) for cell in row[first:]] for row in rows]),
            tuple(row[len(_FIRST)] for row in rows) if first > len(_FIRST) else (),
        )
        unknown = np.isnan(found.probabilities)  # of a net that diverged, whole rows
        shares = (found.probabilities >= 0) & (found.probabilities <= _ONE)
        if not (shares | unknown.all(axis=1, keepdims=True)).all():
            raise ValueError("a probability is not in [0, 1]")
        if [classes.index(row[3]) for row in rows] != found.predicted.tolist():
            raise ValueError("what is predicted is not the most probable class")
        return found
    except (OSError, ValueError, IndexError, csv.Error) as error:
        raise DataError(f"{path} cannot be read ({error}); repeat the run with force=true") from (
            error
        )
