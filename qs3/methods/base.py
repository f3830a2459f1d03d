"""What a method is: a loss on a batch, and perhaps heads of its own.

A batch is `{"source": {"points": [B, N, 3], "y_source": [B]}, "target": {"points": ...}}`, with
only the domains that the method asks for. Labels carry their owner's name, so reading a label
that one must not see is a KeyError.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn


class Method(nn.Module):
    """Loss of the warm-up. Subclasses may own parameters: they are optimised, too.

    Attributes:
        labels: whose labels it trains on: "source", or "target_train" (the upper bound only).
        uses_target: whether its batches hold unlabelled target clouds.
    """

    labels: ClassVar[str] = "source"
    uses_target: ClassVar[bool] = False

    def loss(
        self, net: nn.Module, batch: dict[str, Any], generator: torch.Generator
    ) -> dict[str, Float[Tensor, ""]]:
        """Terms of the loss by name; their sum is minimised.

        Args:
            net: [B, N, 3] to logits [B, C].
            batch: augmented, on the device of `net`.
            generator: all randomness of this step comes from it; on the same device.
        """
        raise NotImplementedError
