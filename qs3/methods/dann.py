"""DANN: features from which a second head cannot tell the domain.

Ganin et al., "Domain-Adversarial Training of Neural Networks", JMLR 2016. Gradient reversal is the
identity forward, and minus alpha times the gradient backward (section 3.3, eq. 16-18).
"""

import math
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from qs3.kernels.norms import use_domain
from qs3.methods.base import Batch, Method, Terms, Weight, class_loss, feature_dims
from qs3.models.base import ClassHead
from qs3.utils.settings import checked


class _Reverse(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, alpha: float) -> Tensor:
        ctx.alpha = alpha
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return -ctx.alpha * grad, None


def reverse_gradient(x: Float[Tensor, "*shape"], alpha: float) -> Float[Tensor, "*shape"]:
    """R(x) = x with dR/dx = -alpha I; alpha >= 0."""
    return _Reverse.apply(x, alpha)


def dann_alpha(progress: float) -> float:
    """2 / (1 + exp(-10 p)) - 1: from 0 to 1 as p does (section 5.2.2); 0.5 at p = 0.11."""
    return 2.0 / (1.0 + math.exp(-10.0 * progress)) - 1.0


def sine_alpha(progress: float) -> float:
    """sin(p pi / 2): PointDAN's (its code: with p = (epoch + 1) / epochs), from 0 to 1."""
    return math.sin(progress * math.pi / 2)


class Dann(Method):
    r"""L = w_c CE(net(x_s), y_s) + w_d [CE(d(R(f(x_s))), 0) + CE(d(R(f(x_t))), 1)].

    f: the backbone's vector of a cloud [B, D]; R: gradient reversal by
    alpha = 2 / (1 + exp(-10 p)) - 1, p the progress of the warm-up; d: an MLP D-512-256-2 with
    batch norm and LeakyReLU 0.2 (of GAST and QS3, for D = 2048 of DGCNN).

    The domains are passed through the net one after the other, so that its batch norm uses the
    statistics of one domain at a time, and its running ones are of both. The head d sees both
    domains in one batch. In the code of GAST and QS3 it does not: its batch norm then takes away
    the mean by which the domains differ, before d can see it.

    Args:
        class_weight: w_c. The paper has 1; the code of GAST and QS3 has 0.5.
        domain_weight: w_d, likewise: the same ratio.
        domain_batches: of d: "together", or "apart" as in the code of GAST and QS3.
    """

    uses_target: ClassVar[bool] = True

    @checked
    def __init__(
        self,
        class_weight: Weight = 1.0,
        domain_weight: Weight = 1.0,
        domain_batches: Literal["together", "apart"] = "together",
    ) -> None:
        super().__init__()
        self.class_weight, self.domain_weight = class_weight, domain_weight
        self.domain_batches = domain_batches
        self.domain_head: nn.Module | None = None

    def prepare(self, net: nn.Module) -> None:
        """The domain head."""
        self.domain_head = ClassHead(feature_dims(net)[0], 2, dropout=0.0)

    def loss(self, net: Any, batch: Batch, generator: torch.Generator) -> Terms:
        """Terms "ce" and "domain", each >= 0; "domain" is 2 w_d ln 2 where d knows nothing."""
        alpha = dann_alpha(batch["progress"])
        source = net.features(batch["source"]["points"]).global_  # [B, D]
        with use_domain(net, "target"):
            target = net.features(batch["target"]["points"]).global_
        ce = class_loss(net.head(source), batch["source"]["y_source"], self.smoothing)
        domain = self._domain_loss(source, target, alpha)
        return {"ce": self.class_weight * ce, "domain": self.domain_weight * domain}

    def _domain_loss(self, source: Tensor, target: Tensor, alpha: float) -> Tensor:
        """Sum of both domains' cross-entropies."""
        assert self.domain_head is not None, "prepare() comes first"
        source, target = reverse_gradient(source, alpha), reverse_gradient(target, alpha)
        if self.domain_batches == "together":
            both = self.domain_head(torch.cat([source, target]))  # [2 B, 2]
            of_source, of_target = both[: len(source)], both[len(source) :]
        else:
            of_source, of_target = self.domain_head(source), self.domain_head(target)
        zeros = torch.zeros(len(source), dtype=torch.int64, device=source.device)
        ones = torch.ones(len(target), dtype=torch.int64, device=target.device)
        return F.cross_entropy(of_source, zeros) + F.cross_entropy(of_target, ones)
