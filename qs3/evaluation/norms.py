"""Batch norms that follow the target after training: AdaBN, alpha-BN and TENT (`evaluation.norms`).

Controls: no other weight is trained, and no source cloud is needed.
"""

from collections.abc import Iterator
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.distributions import Categorical

from qs3.kernels.norms import adapt_batchnorm, check_has_norms, running_norms, use_trained

RATE = 1e-3
"""Adam's learning rate, as in the paper; without weight decay."""


def adapt_norms(
    net: nn.Module,
    points: Float[Tensor, "n p 3"],
    batch_size: int,
    seed: int,
    device: Any = "cpu",
    *,
    kept: float = 0.0,
) -> None:
    """AdaBN: give the net's batch norms the statistics of the target's training clouds (n >= 2).

    Li et al., "Revisiting Batch Normalization For Practical Domain Adaptation", ICLR Workshop 2017.
    `kept`: the share of the statistics of training in the new ones, above 0 for alpha-BN.
    """
    with use_trained(net, "target"):
        batches = _even_batches(points, batch_size, seed)
        adapt_batchnorm(net, (batch.to(device) for batch in batches), kept)


def _even_batches(
    points: Float[Tensor, "n p 3"], batch_size: int, seed: int
) -> Iterator[Float[Tensor, "b p 3"]]:
    """All clouds in random order, in batches of about `batch_size`, as equal as they can be.

    Of at least two clouds, if there are two: batch norm cannot use a single one.
    """
    n = len(points)
    order = torch.randperm(n, generator=torch.Generator().manual_seed(seed))
    for index in torch.tensor_split(order, max(1, min(round(n / batch_size), n // 2))):
        yield points[index]


def minimise_entropy(
    net: nn.Module,
    points: Float[Tensor, "n p 3"],
    batch_size: int,
    seed: int,
    device: Any = "cpu",
) -> None:
    """TENT: train the norms' affine weights to be sure of the target's clouds (n >= 2), then AdaBN.

    Wang et al., "Tent: Fully Test-Time Adaptation by Entropy Minimization", ICLR 2021. In batches
    as `adapt_norms` has them, each a step on its mean entropy, normalised by its own statistics.
    There the paper predicts, too; here the test clouds come later, so statistics of all training
    clouds are left behind.
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
            for batch in _even_batches(points, batch_size, seed):
                optimizer.zero_grad()
                logits = net(batch.to(device))
                Categorical(logits=logits, validate_args=False).entropy().mean().backward()
                optimizer.step()
    finally:
        for parameter, want in zip(parameters, wanted, strict=True):
            parameter.requires_grad_(want).grad = None
        for module, mode in modes.items():
            module.training = mode
    adapt_norms(net, points, batch_size, seed, device)
