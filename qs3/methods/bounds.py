"""The bounds of every table: source only, and supervised on the target's training labels."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from qs3.methods.base import Method, class_loss


class SourceOnly(Method):
    """L = CE(net(x_s), y_s), the lower bound; the target is never looked at."""

    def loss(
        self, net: nn.Module, batch: dict[str, Any], generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Cross-entropy, >= 0."""
        source = batch["source"]
        return {"ce": class_loss(net(source["points"]), source["y_source"], self.smoothing)}


class Supervised(Method):
    """L = CE(net(x_t), y_t) on the target's training split, the upper bound.

    It alone asks for the target's training labels. The batch's labelled part stands at "source", as
    for all methods; its labels carry the name of their true owner.
    """

    labels: ClassVar[str] = "target_train"

    def loss(
        self, net: nn.Module, batch: dict[str, Any], generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Cross-entropy, >= 0."""
        labelled = batch["source"]
        return {
            "ce": class_loss(net(labelled["points"]), labelled["y_target_train"], self.smoothing)
        }
