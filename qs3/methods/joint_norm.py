"""Joint norms: the target's clouds stand beside the source's in every batch norm, without a loss.

Carlucci, Porzi, Caputo, Ricci, Rota Bulò, "AutoDIAL: Automatic DomaIn Alignment Layers", ICCV 2017,
with its share of the statistics at 1/2, where both domains have the same, and without its entropy.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from qs3.errors import ConfigError
from qs3.methods.base import Method, class_loss
from qs3.models.norms import DomainNorm


class JointNorm(Method):
    """L = CE(net([x_s, x_t])_s, y_s): both domains in one pass, the loss of the source alone.

    As many clouds of each. What the net says of the target has no loss; the target's clouds are in
    the mean and variance by which each batch norm divides, in training and in the running ones, so
    that the classes are learnt under them. Other methods pass the domains one after the other.
    """

    uses_target: ClassVar[bool] = True

    def prepare(self, net: nn.Module) -> None:
        """Nothing is made.

        Raises:
            ConfigError: the net has norms of each domain, which have nothing in common.
        """
        if any(isinstance(module, DomainNorm) for module in net.modules()):
            raise ConfigError(
                "method=joint_norm puts both domains into one batch norm, and model.norm=domain "
                "keeps them apart: choose model.norm=batch, or another method"
            )

    def loss(
        self, net: nn.Module, batch: dict[str, Any], generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Cross-entropy of the source's clouds, >= 0."""
        source = batch["source"]
        logits = net(torch.cat([source["points"], batch["target"]["points"]]))
        of_source = logits[: len(source["points"])]
        return {"ce": class_loss(of_source, source["y_source"], self.smoothing)}
