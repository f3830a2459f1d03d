"""Whether a computation may leave torch for numpy, which `torch.export` cannot follow."""

from __future__ import annotations

import torch
from torch import Tensor


def takes_numpy(x: Tensor) -> bool:
    """On the CPU, and not while `torch.export` writes down what is done to `x`.

    Then the way of other devices is taken, which is plain torch and gives the same.
    """
    exporting = getattr(torch.compiler, "is_exporting", None)  # since torch 2.7
    return x.device.type == "cpu" and not (exporting is not None and exporting())
