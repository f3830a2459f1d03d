"""The table of `qs3 predict`, a row for each object, as CSV and as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from qs3.datasets.pointed import Caution
from qs3.utils.text_table import csv_text
from qs3.utils.version import VERSION

COLUMNS = (
    *("file", "status", "class", "confidence", "second", "label", "points", "dropped", "tier"),
    *("caution", "up", "out_of_range", "reason"),
)


class Row(NamedTuple):
    """The prediction for one cloud, or why there is none.

    Attributes:
        file: relative to the input; name[3] is cloud 3 of a file that holds several, or object 3
            of a depth image's mask.
        points: that were used; None if it could not be read.
        dropped: points that were left out: without depth or marked as stray; of a depth image the
            object's pixels without depth. None if it could not be read.
        reason: in what it is out of range, or why it failed; "" otherwise.
        probabilities: [C] float64; None if it failed.
        label: what it is, if that is known: a class of the net's, or another word; "" if not.
        tier: of an object cut from a depth image: "clean", "hard" or "poor"; "" of other clouds.
        cautions: what was wrong when it was cut.
        up: how the vertical is known: "z" or another axis of the file, "given", "planes", "level".
        second: the class that another classifier names; "" without one.
        without_prior: as `probabilities`, with classes as common as in training.
    """

    file: str
    points: int | None
    dropped: int | None
    reason: str
    probabilities: Float[np.ndarray, " c"] | None
    label: str = ""
    tier: str = ""
    cautions: tuple[Caution, ...] = ()
    up: str = ""
    second: str = ""
    without_prior: Float[np.ndarray, " c"] | None = None


def record(row: Row, classes: Sequence[str]) -> dict[str, Any]:
    """A cloud's values in both formats, by `COLUMNS`, and "probabilities"; None where empty."""
    found: dict[str, Any] = {
        **dict.fromkeys(COLUMNS),
        "file": row.file,
        "status": "failed",
        "label": row.label or None,
        "points": row.points,
        "dropped": row.dropped,
        "tier": row.tier or None,
        "caution": "; ".join(caution.words for caution in row.cautions) or None,
        "up": row.up or None,
        "reason": row.reason,
        "probabilities": None,
    }
    if row.probabilities is not None:
        best, each = int(row.probabilities.argmax()), row.probabilities.tolist()
        found |= {
            "status": "ok",
            "class": classes[best],
            "confidence": each[best],
            "second": row.second or None,
            "out_of_range": bool(row.reason),
            "probabilities": dict(zip(classes, each, strict=True)),
        }
    return found


def as_csv(rows: Sequence[Row], classes: Sequence[str]) -> str:
    """A line each, with a column for each class."""
    lines: list[list[Any]] = [[*COLUMNS, *(f"p_{name}" for name in classes)]]
    for cells in (record(row, classes) for row in rows):
        cells["out_of_range"] = {True: "yes", False: "no", None: None}[cells["out_of_range"]]
        each = cells["probabilities"] or dict.fromkeys(classes)
        lines.append([*(cells[key] for key in COLUMNS), *each.values()])
    return csv_text(lines)


def as_json(rows: Sequence[Row], classes: Sequence[str], **about: Any) -> str:
    """One document; `about` are further values at its top."""
    clouds = [record(row, classes) for row in rows]
    document = {"qs3": VERSION, "classes": list(classes), **about, "clouds": clouds}
    return json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
