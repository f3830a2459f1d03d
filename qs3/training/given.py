"""`weights`: a trained classifier that a run begins with, and that may be its first teacher."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from qs3.errors import ConfigError
from qs3.inference.model_file import read_result


@dataclass(frozen=True, eq=False)
class Given:
    """A classifier that somebody trained.

    Attributes:
        name: of its folder or file, for people.
        classes: in the order of its logits.
        weights: of its net, float32 where they are floats.
        sha256: of them.
        learnt: [C] shares of the classes in its training; None: nobody knows.
    """

    name: str
    classes: tuple[str, ...]
    weights: dict[str, Tensor]
    sha256: str
    learnt: Float[np.ndarray, " c"] | None = None


def read_given(cfg: DictConfig) -> Given | None:
    """What `weights` names; None where it names nothing.

    Raises:
        MissingDataError, DataError: it is not there, or damaged.
        ConfigError: its net or its clouds are not those of the config.
    """
    if cfg.weights is None:
        return None
    result = read_result(cfg.weights)
    name = Path(cfg.weights).name
    model: Any = OmegaConf.to_container(cfg.model, resolve=True)
    for key in sorted({*model, *result.model} - ({"file"} if "sha256" in model else set())):
        if (was := result.model.get(key)) != model.get(key):
            raise ConfigError(f"weights={name} has model.{key}={was}, not {model.get(key)}")
    if result.scale != cfg.data.scale:
        raise ConfigError(f"weights={name} has data.scale={result.scale}, not {cfg.data.scale}")
    weights = {
        key: value.float() if value.is_floating_point() else value
        for key, value in result.weights.items()
    }
    return Given(name, result.classes, weights, _sha256(weights), result.shares)


def _sha256(weights: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256()
    for key in sorted(weights):
        digest.update(key.encode())
        digest.update(np.ascontiguousarray(weights[key].cpu().numpy()).tobytes())
    return digest.hexdigest()
