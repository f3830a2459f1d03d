"""Checkpoints that survive a kill at any moment: written to another file, flushed, renamed.

They hold weights and plain values only and are read with `weights_only=True`.
"""

from __future__ import annotations

import os
from typing import Any

import torch
from torch import nn

from qs3.errors import DataError
from qs3.utils.files import atomic_path

LAST = "last.ckpt"


def save(value: Any, path: str | os.PathLike[str]) -> None:
    """Save tensors and plain values to `path`, atomically."""
    with atomic_path(path) as temporary:
        torch.save(value, temporary)


def load(path: str | os.PathLike[str], device: Any = "cpu") -> Any:
    """Read what `save` wrote.

    Raises:
        DataError: the file is missing or damaged.
    """
    try:
        return torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # torch raises many kinds for a damaged file
        raise DataError(
            f"{path} cannot be read ({type(error).__name__}); start again with force=true"
        ) from error


def copy_weights(net: nn.Module) -> dict[str, torch.Tensor]:
    """The net's parameters and buffers, copied to the CPU."""
    return {name: value.detach().cpu().clone() for name, value in net.state_dict().items()}
