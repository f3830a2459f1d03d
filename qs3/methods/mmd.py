"""Maximum mean discrepancy with a mixture of Gaussian kernels.

Gretton et al., "A Kernel Two-Sample Test", JMLR 2012, eq. 5 (the biased estimate).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from qs3.geometry.device import exact_products


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
