"""TENT: the affine weights of batch norm for which the net is most confident of the target.

Wang, Shelhamer, Liu, Olshausen, Darrell, "Tent: Fully Test-Time Adaptation by Entropy
Minimization", ICLR 2021. A control: nothing else is trained, and no source cloud is needed.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.evaluation.metrics import adapt_norms, even_batches
from qs3.kernels.norms import check_has_norms, running_norms, use_trained

RATE = 1e-3
"""Adam's learning rate, as in the paper; without weight decay."""


def entropy(logits: Float[Tensor, "b c"]) -> Float[Tensor, ""]:
    """Mean Shannon entropy of the predictions in nats, in [0, ln C]."""
    logs = logits.log_softmax(dim=1)
    return -(logs.exp() * logs).sum(dim=1).mean()


def minimise_entropy(
    net: nn.Module,
    points: Float[Tensor, "n p 3"],
    batch_size: int,
    seed: int,
    device: Any = "cpu",
) -> None:
    """One pass over the target's training clouds (n >= 2), then AdaBN with the weights it found.

    In batches as `adapt_norms` has them, each a step on its mean entropy, normalised by its own
    statistics. There the paper predicts, too; here the target's test clouds come later, one by one
    if need be, so statistics of all training clouds are left behind. Other weights stay.

    Raises:
        ConfigError: the net has no batch norm.
    """
    parameters, modes = list(net.parameters()), {m: m.training for m in net.modules()}
    wanted = [p.requires_grad for p in parameters]
    net.requires_grad_(False)
    net.eval()  # no dropout
    try:
        with use_trained(net, "target"), torch.enable_grad():
            check_has_norms(net, "tent")
            norms = running_norms(net)
            for norm in norms:
                norm.training = True
            affine = [p.requires_grad_() for norm in norms for p in norm.parameters()]
            optimizer = torch.optim.Adam(affine, RATE)
            for batch in even_batches(points, batch_size, seed):
                optimizer.zero_grad()
                entropy(net(batch.to(device))).backward()
                optimizer.step()
    finally:
        for parameter, want in zip(parameters, wanted, strict=True):
            parameter.requires_grad_(want).grad = None
        for module, mode in modes.items():
            module.training = mode
    adapt_norms(net, points, batch_size, seed, device)
