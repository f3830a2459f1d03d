"""What clouds are compared by: their roughness, or the features of a net that no longer learns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.errors import ConfigError
from qs3.methods.mmd import mmd2
from qs3.runs.checkpoints import weights_sha256

ROUGHNESS = "roughness"
_NEIGHBOURS = 12
_QUANTILES = (0.1, 0.3, 0.5, 0.7, 0.9)
_WIDTHS = (1.0, 2.0, 4.0, 8.0)  # of the kernels, over the median distance of two target clouds


class Descriptor(Protocol):
    """Maps clouds to vectors, with gradients."""

    def __call__(self, clouds: Float[Tensor, "b n 3"]) -> Float[Tensor, "b d"]:
        """Of clouds in the unit ball."""
        ...


def roughness(clouds: Float[Tensor, "b n 3"]) -> Float[Tensor, "b d"]:
    """Quantiles over each cloud of how far its points lie off the planes of their neighbours.

    Of each point and its 12 nearest, the root of the least eigenvalue of their covariance, as a
    logarithm; and the same of the second: surfaces are thin in one direction, wires in two, and
    noise in none. [B, 10]. Noise shows in it, which class an object is of hardly does.
    """
    parts = []
    for cloud in clouds:
        with torch.no_grad():
            far = torch.cdist(cloud, cloud)
            near = far.topk(_NEIGHBOURS + 1, largest=False).indices
        around = cloud[near]
        around = around - around.mean(dim=1, keepdim=True)
        spread = torch.linalg.eigvalsh(around.transpose(1, 2) @ around / (_NEIGHBOURS + 1))
        logs = 0.5 * torch.log(spread[:, :2].clamp_min(0) + 1e-8)
        wanted = torch.tensor(_QUANTILES, dtype=logs.dtype)
        parts.append(torch.quantile(logs, wanted, dim=0).T.flatten())
    return torch.stack(parts)


class NetFeatures:
    """A frozen classifier's vector of each cloud.

    Args:
        net: with `features(points).global_`; put into eval mode, without gradients of its own.

    Attributes:
        sha256: of its weights.
    """

    def __init__(self, net: nn.Module) -> None:
        if not hasattr(net, "features"):
            raise ConfigError("features= names a net that has no features of clouds; take another")
        self.net = net.eval().requires_grad_(False)
        self.sha256 = weights_sha256(net.state_dict())

    def __call__(self, clouds: Float[Tensor, "b n 3"]) -> Float[Tensor, "b d"]:
        """See `Descriptor`."""
        features: Tensor = self.net.features(clouds.float()).global_  # type: ignore[operator]
        return features.double()


class Distance:
    """Squared maximum mean discrepancy to the target's clouds, of standardised descriptors.

    Mean and spread, and the kernels' widths, are the target's and stay. Wide kernels pull from far.
    """

    def __init__(self, describe: Descriptor, target: Sequence[Float[Tensor, "n 3"]]) -> None:
        self.describe = describe
        with torch.no_grad():
            found = torch.cat([describe(cloud[None]) for cloud in target])
        self.mean, self.spread = found.mean(dim=0), found.std(dim=0) + 1e-6
        self.target = (found - self.mean) / self.spread
        self._apart = torch.pdist(self.target)
        self.sigmas = [max(width * float(self._apart.median()), 1e-3) for width in _WIDTHS]

    def __call__(self, clouds: Sequence[Float[Tensor, "n 3"]]) -> Float[Tensor, ""]:
        """In [0, 8]; of few clouds it is larger, as each of them is also compared with itself."""
        return self.of(torch.cat([self.describe(cloud[None]) for cloud in clouds]))

    def of(self, described: Float[Tensor, "m d"]) -> Float[Tensor, ""]:
        """The same of clouds that have been described."""
        return mmd2((described - self.mean) / self.spread, self.target, self.sigmas)

    def floor(self, count: int) -> float:
        """Mean distance of `count` other clouds of the target: what a perfect source has.

        (1/m + 1/n) (k(x, x) - E k(x, x')), for m clouds and the n that are known: the estimate is
        biased by comparing each cloud of either sample with itself, too. E is over the n's pairs.
        """
        pairs = sum(torch.exp(self._apart.square() / (-2 * s**2)).mean() for s in self.sigmas)
        return float((1 / count + 1 / len(self.target)) * (len(self.sigmas) - pairs))
