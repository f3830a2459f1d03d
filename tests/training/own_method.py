"""A method as a user would write one, with what a run has to carry on: chance, a buffer, a head."""

import torch
from torch import nn
from torch.nn import functional as F

from qs3.methods.base import Method, class_loss


class Mine(Method):
    """Cross-entropy, and logits of the target near their running mean; a head of its own."""

    uses_target = True

    def __init__(self, weight: float = 0.1) -> None:
        super().__init__()
        self.weight = weight
        self.register_buffer("mean", torch.zeros(3))

    def prepare(self, net: nn.Module) -> None:
        self.head = nn.Linear(3, 3)

    def start_epoch(self, net, data, epoch, epochs):
        with torch.no_grad():
            self.mean.copy_(0.5 * self.mean + 0.5 * net(data.target.points).mean(dim=0))

    def loss(self, net, batch, generator):
        source, points = batch["source"], batch["target"]["points"]
        noise = torch.randn(points.shape, generator=generator)
        logits = self.head(net(points + 0.01 * noise))
        return {
            "class": class_loss(net(source["points"]), source["y_source"], self.smoothing),
            "near": self.weight * F.mse_loss(logits, self.mean.expand_as(logits)),
        }
