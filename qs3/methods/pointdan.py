"""PointDAN: align domains by the discrepancy of two classifiers, and by the features of nodes.

Qin et al., "PointDAN: A Multi-Scale 3D Domain Adaption Network for Point Cloud Representation",
NeurIPS 2019; the discrepancy is that of Saito et al., "Maximum Classifier Discrepancy", CVPR 2018,
that of nodes of Gretton et al., "A Kernel Two-Sample Test", JMLR 2012, eq. 5 (the biased estimate).
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.kernels.device import exact_products
from qs3.kernels.norms import use_domain
from qs3.methods.base import Batch, Method, Terms, Weight, class_loss
from qs3.methods.dann import reverse_gradient, sine_alpha
from qs3.models.base import check_points
from qs3.utils.settings import checked


def mmd2(
    x: Float[Tensor, "m d"], y: Float[Tensor, "n d"], sigmas: Sequence[float]
) -> Float[Tensor, ""]:
    """Mean k(x, x') + mean k(y, y') - 2 mean k(x, y), all pairs, a sample with itself included.

    k(a, b) = sum over sigmas of exp(-|a - b|^2 / (2 sigma^2)). In [0, 2 len(sigmas)]; 0 for equal
    samples. float32 at least, also under autocast.
    """
    with torch.autocast(x.device.type, enabled=False), exact_products():
        x, y = (z.float() if z.dtype in (torch.float16, torch.bfloat16) else z for z in (x, y))
        both = torch.cat([x, y])
        both = both - both.mean(0).detach()  # nearer to 0: squares lose fewer digits
        norms = both.square().sum(1)
        squares = (norms[:, None] + norms[None] - 2 * both @ both.T).clamp_min(0)
        # Rounding would leave a sample at some distance from itself: far, for a sigma of 0.01.
        itself = torch.eye(len(both), dtype=torch.bool, device=both.device)
        squares = squares.masked_fill(itself, 0.0)
        kernel = torch.stack([torch.exp(squares / (-2 * sigma**2)) for sigma in sigmas]).sum(0)
        m = len(x)
        return kernel[:m, :m].mean() + kernel[m:, m:].mean() - 2 * kernel[:m, m:].mean()


SIGMAS = (0.01, 0.1, 1.0, 10.0, 100.0)


class PointDan(Method):
    r"""L = w_c [CE(c_1(f_s), y_s) + CE(c_2(f_s), y_s)] - w_a D(R(f_t)) + w_n MMD^2(a_s, a_t).

    f: vectors of clouds; a = A(n): features of their nodes (64 x 64, in a row), weighted by an
    attention of each domain. D = mean |softmax c_1 - softmax c_2|, in [0, 2/C]: the classifiers
    enlarge it, and R, gradient reversal by sin(p pi / 2), lets the generator lower it.

    One step for all losses. The released code takes two steps a batch, with three optimisers: one
    for the first two terms, then, after new forward passes, one for the third. Adam makes the size
    of a step independent of the size of a loss, so there the third term weighs as much as the
    others whatever its size; here its gradient is added.

    Args:
        class_weight: w_c; 1, in the authors' scripts 0.5 for three of the six pairs.
        discrepancy_weight: w_a.
        node_weight: w_n.
        classifier_rate: factor on the learning rate of both classifiers; 2 in the released code.
    """

    uses_target: ClassVar[bool] = True

    @checked
    def __init__(
        self,
        class_weight: Weight = 1.0,
        discrepancy_weight: Weight = 1.0,
        node_weight: Weight = 1.0,
        classifier_rate: Weight = 2.0,
    ) -> None:
        super().__init__()
        self.class_weight, self.discrepancy_weight = class_weight, discrepancy_weight
        self.node_weight, self.classifier_rate = node_weight, classifier_rate
        self.attention: nn.ModuleDict | None = None

    def prepare(self, net: Any) -> None:
        """An attention of each domain."""
        module = net.backbone.node_module  # of model=pointdan alone
        width = module.nodes * module.offset.in_features
        self.attention = nn.ModuleDict(
            {domain: NodeAttention(width) for domain in ("source", "target")}
        )

    def learning_rates(self, net: Any) -> Sequence[tuple[nn.Module, float]]:
        """The classifiers learn faster."""
        return ((net.head, self.classifier_rate),)

    def loss(self, net: Any, batch: Batch, generator: torch.Generator) -> Terms:
        """Terms "ce" >= 0, "discrepancy" in [-2 w_a / C, 0], "nodes" in [0, 10 w_n]."""
        assert self.attention is not None, "prepare() comes first"
        features, attended = {}, {}
        for domain in ("source", "target"):
            points = batch[domain]["points"]
            check_points(points)
            with use_domain(net, domain):
                found, nodes = net.backbone.with_nodes(points)
            features[domain] = found.global_  # [B, 1024]
            attended[domain] = self.attention[domain](nodes.features.flatten(1))  # [B, M C]
        labels = batch["source"]["y_source"]
        ce = class_loss(net.head.first(features["source"]), labels, self.smoothing) + class_loss(
            net.head.second(features["source"]), labels, self.smoothing
        )
        reversed_ = reverse_gradient(features["target"], sine_alpha(batch["progress"]))
        apart = discrepancy(net.head.first(reversed_), net.head.second(reversed_))
        return {
            "ce": self.class_weight * ce,
            "discrepancy": -self.discrepancy_weight * apart,
            "nodes": self.node_weight * mmd2(attended["source"], attended["target"], SIGMAS),
        }


class NodeAttention(nn.Module):
    """BN(x y + x) with y = sigmoid(W_2 relu(W_1 x)) in (0, 1), W_1 to an eighth of the width."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gate = nn.Sequential(
            nn.Linear(width, width // 8), nn.ReLU(), nn.Linear(width // 8, width), nn.Sigmoid()
        )
        self.norm = nn.BatchNorm1d(width)

    def forward(self, x: Float[Tensor, "b w"]) -> Float[Tensor, "b w"]:
        """Each feature weighted by 1 to 2, as the others ask for, then normalised."""
        return self.norm(x * self.gate(x) + x)


def discrepancy(first: Float[Tensor, "b c"], second: Float[Tensor, "b c"]) -> Float[Tensor, ""]:
    """Mean of |softmax(first) - softmax(second)| over clouds and classes, in [0, 2/C]."""
    return (first.softmax(1) - second.softmax(1)).abs().mean()
