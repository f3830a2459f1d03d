"""The loss of a student: on pseudo-labelled target clouds, and on the source's if it takes them."""

from typing import Any

import torch
from torch import Tensor, nn

from qs3.kernels.norms import use_domain
from qs3.methods.base import Method, class_loss
from qs3.methods.pcm import mix, pcm_loss


class Student(Method):
    """L = w [CE(net(x_t), ŷ_t) + m R(net(x_t))], plus w CE on labelled source clouds if any.

    ŷ_t are classes, or probabilities (CRST's LRENT).

    Args:
        pcm: mix the clouds first (QBST does not).
        weight_step: w = 1 - weight_step * (epochs of the rounds so far).
        mrkld: m, weight of R = -1/K sum_k log p_k, the divergence of the prediction from the
            uniform one up to a constant: CRST's MRKLD (Zou et al., "Confidence Regularized
            Self-Training", ICCV 2019, table 1), 0.1 in its code. At least ln K.
        first_epoch: the first epoch of the rounds.
    """

    def __init__(
        self, pcm: bool = False, weight_step: float = 0.0, mrkld: float = 0.0, first_epoch: int = 0
    ) -> None:
        super().__init__()
        self.pcm, self.weight_step, self.mrkld = pcm, weight_step, mrkld
        self.first_epoch = first_epoch

    def loss(
        self, net: nn.Module, batch: dict[str, Any], generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Terms "pseudo" and, if the batch has source clouds, "source"; each >= 0."""
        target = batch["target"]
        with use_domain(net, "target"):
            loss, logits = self._fit(net, target["points"], target["y_pseudo"], generator)
        if self.mrkld:
            loss = loss - self.mrkld * logits.log_softmax(dim=1).mean()
        terms = {"pseudo": loss}
        if "source" in batch:
            source = batch["source"]
            terms["source"], _ = self._fit(net, source["points"], source["y_source"], generator)
        if self.weight_step:
            w = 1 - self.weight_step * (batch["epoch"] - self.first_epoch)
            terms = {name: w * term for name, term in terms.items()}
        return terms

    def _fit(
        self, net: nn.Module, points: Tensor, labels: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Cross-entropy, mixed or not, and logits."""
        if not self.pcm:
            logits = net(points)
            return class_loss(logits, labels, self.smoothing), logits
        mixed, labels_a, labels_b, lam = mix(points, labels, generator)
        logits = net(mixed)
        return pcm_loss(logits, labels_a, labels_b, lam, self.smoothing), logits
