"""Second draws: the student learns each source cloud from two draws of it.

Ours: a simulation can scan an object again. Of what else it knows (whole objects, clouds without
error) nothing helped on real objects: docs/results/tried.md.
"""

import torch
from torch import nn

from qs3.methods.base import Batch, Method, Terms, Weight, class_loss
from qs3.utils.settings import checked


class Twin(Method):
    """L = CE(f(x), y) + b CE(f(x'), y).

    x: a source cloud, noisy, hidden and cut; x': x drawn again, turned alike, with another cut;
    f: class probabilities of the net.

    Args:
        again_weight: b.
    """

    again = True

    @checked
    def __init__(self, again_weight: Weight = 1.0) -> None:
        super().__init__()
        self.again_weight = again_weight

    def loss(self, net: nn.Module, batch: Batch, generator: torch.Generator) -> Terms:
        """Terms "ce" and "again", each >= 0."""
        source = batch["source"]
        ce, again = (
            class_loss(net(source[draw]), source["y_source"], self.smoothing)
            for draw in ("points", "again")
        )
        return {"ce": ce, "again": self.again_weight * again}
