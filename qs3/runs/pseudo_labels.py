"""A round's pseudo-labels on disk: `round_03/pseudo_labels.csv`, one row a target sample."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from qs3.errors import DataError
from qs3.utils.files import write_text
from qs3.utils.memory import TABLE_PEAK, read_whole
from qs3.utils.text_table import csv_text

_COLUMNS = ("id", "label", "confidence", "selected")


@dataclass(frozen=True)
class PseudoLabel:
    """One row: the predicted class's name and probability, and whether it is trained on."""

    id: str
    label: str
    confidence: float
    selected: bool


def path_of(folder: Path, round_: int) -> Path:
    """Where the table of a round lies in a run's folder."""
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
    write_text(path, csv_text([_COLUMNS, *lines]))


def read_pseudo_labels(path: Path) -> list[PseudoLabel]:
    """Read the table.

    Raises:
        DataError: it is not there, or not as `write_pseudo_labels` writes it.
    """
    try:
        text = read_whole(path, TABLE_PEAK).decode()
        header, *rows = csv.reader(io.StringIO(text, newline=""), strict=True)
        if tuple(header) != _COLUMNS or not rows:
            raise ValueError("it has other columns, or no rows")
        return [
            PseudoLabel(id_, label, float(confidence), {"0": False, "1": True}[selected])
            for id_, label, confidence, selected in rows
        ]
    except (OSError, ValueError, KeyError, csv.Error) as error:
        raise DataError(f"{path} is damaged ({error}); repeat the run with force=true") from error
