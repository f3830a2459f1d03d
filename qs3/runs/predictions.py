"""A run's predictions on disk, as CSV.

predictions.csv, of the target's evaluated clouds: id; mesh (what clouds have in common, so that
they are not independent samples: the structural family of an object of the catalogue, else the hash
of its mesh; of objects of frames their room, or their block of frames; the id where nothing is
known); label (empty if it is not known); predicted; tier ("clean" or "hard", where the dataset has
tiers: else there is no such column); and a probability per class.

round_03/pseudo_labels.csv, of a round's target clouds: id, label, confidence, selected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from qs3.utils.files import reading, write_text

if TYPE_CHECKING:
    import pandas as pd

FILE = "predictions.csv"
OF_FILES = "predictions_of_files.csv"


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

    @property
    def predicted(self) -> Int[np.ndarray, " n"]:
        """The most probable class of each, the first one on ties."""
        return self.probabilities.argmax(axis=1)


def write_predictions(path: Path, predictions: Predictions) -> None:
    """Write the table, atomically; probabilities with all their digits."""
    p, names = predictions, np.array([*predictions.classes, ""], dtype=object)
    columns = {"id": p.ids, "mesh": p.meshes, "label": names[p.labels]}
    columns |= {"predicted": names[p.predicted], **({"tier": p.tiers} if p.tiers else {})}
    _write(path, columns | _chances(p.classes, p.probabilities))


def write_predictions_of_files(
    path: Path, files: Sequence[str], reasons: Sequence[str], predictions: Predictions
) -> None:
    """A table for the owner of the files: one row each, in the order of their names.

    Columns: file; class; confidence; unlike_source (yes or no), reason (in what it is unlike the
    source's; "" if in nothing); and a probability per class, to four digits.
    """
    p, order = predictions, sorted(range(len(files)), key=files.__getitem__)
    digits = np.array([[f"{value:.4f}" for value in row] for row in p.probabilities[order]])
    called = p.predicted[order]
    columns = {
        "file": [files[i] for i in order],
        "class": np.array(p.classes)[called],
        "confidence": digits[np.arange(len(order)), called],
        "unlike_source": ["yes" if reasons[i] else "no" for i in order],
        "reason": [reasons[i] for i in order],
    }
    _write(path, columns | _chances(p.classes, digits))


def read_predictions(path: Path) -> Predictions:
    """Read the table; it is checked as a whole."""
    with reading(path):
        table = _read(path)
        chances = table.filter(regex="^p_")
        classes = tuple(name.removeprefix("p_") for name in chances)
        found = Predictions(
            classes,
            tuple(table.id),
            tuple(table.mesh),
            np.array([classes.index(label) if label else -1 for label in table.label]),
            chances.to_numpy(dtype=float),
            tuple(table.get("tier", ())),
        )
        called = [classes.index(label) for label in table.predicted]
        if called != found.predicted.tolist() or not table.id.is_unique:
            raise ValueError("an id occurs twice, or a class is not the most probable one")
        return found


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
    columns = {"id": ids, "label": np.array([*classes])[predicted]}
    kept = np.asarray(selected).astype(int)
    _write(path, columns | {"confidence": np.asarray(confidence, dtype=float), "selected": kept})


def read_pseudo_labels(path: Path) -> pd.DataFrame:
    """Read the table: id, label (the predicted class's name), confidence, selected (a bool)."""
    with reading(path):
        table = _read(path)
        kept = [{"0": False, "1": True}[word] for word in table.selected]
        return table.assign(confidence=table.confidence.astype(float), selected=kept)


def _chances(classes: Sequence[str], table: np.ndarray) -> dict[str, np.ndarray]:
    return {f"p_{name}": column for name, column in zip(classes, table.T, strict=True)}


def _write(path: Path, columns: dict[str, Sequence[object]]) -> None:
    import pandas as pd

    write_text(path, pd.DataFrame(columns).to_csv(index=False, lineterminator="\n", na_rep="nan"))


def _read(path: Path) -> pd.DataFrame:
    """A table of words, of one row at least."""
    import pandas as pd

    table = pd.read_csv(path, dtype=str, keep_default_na=False)
    if table.empty or table.isna().to_numpy().any():
        raise ValueError("rows are missing, or have different lengths")
    return table
