"""What a net says of held-out labelled clouds, as tensors in its file: see `qs3.evaluation.trust`.

probabilities [v, C] float32, labels [v] int64, measures [m, 4] float32, turns [1] float32
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from qs3.evaluation.trust import COMPARED, Known

MOST = 4096
"""Clouds in a file; more is a damaged number."""

_NAMES = ("labels", "measures", "probabilities")
_OPTIONAL = "turns"


def tensors_of(known: Known) -> dict[str, Tensor]:
    """For a file; at most `MOST` clouds, at even steps."""
    v, m = (_even(len(x)) for x in (known.labels, known.measures))
    found = {
        "probabilities": torch.from_numpy(known.probabilities[v].astype(np.float32)),
        "labels": torch.from_numpy(known.labels[v].astype(np.int64)),
        "measures": torch.from_numpy(known.measures[m].astype(np.float32)),
    }
    if known.turns is not None:
        found[_OPTIONAL] = torch.tensor([known.turns], dtype=torch.float32)
    return found


def known_of(tensors: Mapping[str, Tensor]) -> Known:
    """From what `checked_tensors` let through."""
    turns = tensors.get(_OPTIONAL)
    return Known(
        tensors["probabilities"].double().numpy(),
        tensors["labels"].numpy(),
        tensors["measures"].double().numpy(),
        None if turns is None else float(turns),
    )


def checked_tensors(found: dict[str, Tensor]) -> dict[str, Tensor]:
    """The same, if they are what `tensors_of` writes; else a ValueError."""
    if not {*_NAMES} <= set(found) <= {*_NAMES, _OPTIONAL}:
        raise ValueError(f"should be {', '.join(_NAMES)} and perhaps {_OPTIONAL}")
    said, labels, measures = (found[name] for name in ("probabilities", "labels", "measures"))
    turns = found.get(_OPTIONAL, torch.zeros(1))
    kinds = [said.dtype, labels.dtype, measures.dtype, turns.dtype]
    if kinds != [torch.float32, torch.int64, torch.float32, torch.float32]:
        raise ValueError("should be float32, and int64 labels")
    if not all(map(is_plain, (said, labels, measures, turns))):
        raise ValueError("should be plain tensors")
    columns = len(COMPARED)
    whole = labels.ndim == 1 and said.ndim == 2 and said.shape[0] == (v := labels.shape[0])
    shapes = whole and measures.ndim == 2 and measures.shape[1] == columns and turns.shape == (1,)
    if not shapes:
        raise ValueError(f"should be [v, C], [v], [m, {columns}] and [1]")
    if not (0 < v <= MOST and 0 < len(measures) <= MOST):
        raise ValueError(f"should be 1 to {MOST} clouds")
    if int(labels.min()) < 0 or int(labels.max()) >= said.shape[1]:
        raise ValueError("labels should be numbers of classes")
    shares = torch.cat([said.flatten(), turns])
    if not (bool(((shares >= 0) & (shares <= 1.001)).all()) and bool(measures.isfinite().all())):
        raise ValueError("should be shares in [0, 1], and finite measures")
    return found


def is_plain(one: Tensor) -> bool:
    """Neither sparse nor nested, which has no shape to be asked for."""
    return one.layout == torch.strided and not one.is_nested


def _even(count: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, MOST)).astype(int))
