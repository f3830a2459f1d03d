"""`predictions.csv`: what a run's result says of each evaluated cloud of the target, one row each.

Columns: id; mesh (hash of the object's mesh: scans of one mesh are no independent samples; the id
where no mesh is known); label (empty if nobody knows it); predicted; and a probability per class.
"""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from qs3.errors import DataError
from qs3.files import write_text

FILE = "predictions.csv"
_FIRST = ("id", "mesh", "label", "predicted")


@dataclass(frozen=True, eq=False)
class Predictions:
    """Of n clouds.

    Attributes:
        classes: names in label order.
        ids: unique.
        meshes: cluster of each cloud.
        labels: [n] true classes; -1 where unknown.
        probabilities: [n, C] in [0, 1].
    """

    classes: tuple[str, ...]
    ids: tuple[str, ...]
    meshes: tuple[str, ...]
    labels: Int[np.ndarray, " n"]
    probabilities: Float[np.ndarray, "n c"]

    @property
    def predicted(self) -> Int[np.ndarray, " n"]:
        """The likeliest class of each, the first one on ties."""
        return self.probabilities.argmax(axis=1)


def write_predictions(path: Path, predictions: Predictions) -> None:
    """Write the table, atomically; probabilities with all their digits."""
    p, text = predictions, io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*_FIRST, *(f"p_{name}" for name in p.classes)])
    rows = zip(p.ids, p.meshes, p.labels, p.predicted, p.probabilities, strict=True)
    for id_, mesh, label, predicted, row in rows:
        name = "" if label < 0 else p.classes[label]
        writer.writerow([id_, mesh, name, p.classes[predicted], *map(repr, row.tolist())])
    write_text(path, text.getvalue())


def read_predictions(path: Path) -> Predictions:
    """Read the table.

    Raises:
        DataError: it is not there, or not as `write_predictions` writes it.
    """
    try:
        with open(path, encoding="utf-8", newline="") as file:
            header, *rows = list(csv.reader(file))
        classes = tuple(name.removeprefix("p_") for name in header[len(_FIRST) :])
        if tuple(header[: len(_FIRST)]) != _FIRST or not classes or not rows:
            raise ValueError("it has other columns, or no rows")
        return Predictions(
            classes,
            tuple(row[0] for row in rows),
            tuple(row[1] for row in rows),
            np.array([classes.index(row[2]) if row[2] else -1 for row in rows]),
            np.array([[float(cell) for cell in row[len(_FIRST) :]] for row in rows]),
        )
    except (OSError, ValueError) as error:
        raise DataError(f"{path} cannot be read ({error}); repeat the run with force=true") from (
            error
        )
