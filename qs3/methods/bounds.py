"""The bounds of every table: source only, and supervised on the target's training labels.

Between them lies what a few labels of the target bring.
"""

from typing import ClassVar

import torch
from torch import nn

from qs3.methods.base import Batch, Method, Terms, class_loss


class SourceOnly(Method):
    """L = CE(net(x_s), y_s), the lower bound; the target is never looked at."""

    def loss(self, net: nn.Module, batch: Batch, generator: torch.Generator) -> Terms:
        """Cross-entropy, >= 0."""
        source = batch["source"]
        labels = source[f"y_{self.labels}"]
        return {"ce": class_loss(net(source["points"]), labels, self.smoothing)}


class Supervised(SourceOnly):
    """L = CE(net(x_t), y_t) on the target's training split, the upper bound.

    It alone asks for the target's training labels. The batch's labelled part stands at "source", as
    for all methods; its labels carry the name of their true owner.
    """

    labels: ClassVar[str] = "target_train"


class FewLabels(Supervised):
    """L = CE(net(x_t), y_t) + CE(net(x_s), y_s): a few labels of the target and the source.

    `data.clouds_a_class` says how many of a class.
    """

    beside_source: ClassVar[bool] = True

    def loss(self, net: nn.Module, batch: Batch, generator: torch.Generator) -> Terms:
        """Cross-entropies "ce" of the target's and "source" of the source's clouds, each >= 0."""
        terms, source = super().loss(net, batch, generator), batch["beside"]
        terms["source"] = class_loss(net(source["points"]), source["y_source"], self.smoothing)
        return terms
