"""What infrared images are compared by when the pattern of dots itself is not known.

Two pictures of other dots are never alike pixel by pixel; how bright dots are over what is
around them, how far they are blurred and how much noise lies on them is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch

SMOOTH_PX = 12.0
"""Standard deviation of the Gaussian that is taken for shading."""

LAGS = 6
FRAME_PX = math.ceil(2 * SMOOTH_PX)
"""Left out around a picture, where its shading is not known."""


@dataclass(frozen=True)
class Statistics:
    """Of pictures of one camera; all relative to the local mean. Tensors float64.

    Attributes:
        shared: [LAGS] covariance of pixels 1, 2, ... apart, over rows and columns: texture
            alone, because a camera's noise is each pixel's own.
        skewness: third moment of the texture; noise has none.
    """

    shared: torch.Tensor
    skewness: torch.Tensor


def statistics(grey: torch.Tensor, mean: torch.Tensor | None = None) -> Statistics:
    """Of one image [h, w] float64, but for a frame of `FRAME_PX` around it.

    Args:
        grey: grey values.
        mean: [h, w] its shading; None: `smooth(grey)`.
    """
    grey, mean = inner(grey), inner(smooth(grey) if mean is None else mean)
    texture = (grey - mean) / mean.clamp_min(1e-9)
    shared = [
        torch.stack([(one[:, lag:] * one[:, :-lag]).mean() for one in (texture, texture.T)]).mean()
        for lag in range(1, LAGS + 1)
    ]
    return Statistics(torch.stack(shared), texture.pow(3).mean())


def inner(image: torch.Tensor) -> torch.Tensor:
    """[h, w] without the frame."""
    return image[FRAME_PX:-FRAME_PX, FRAME_PX:-FRAME_PX]


def smooth(grey: torch.Tensor) -> torch.Tensor:
    """[h, w] without its dots, mirrored at the edges."""
    reach = math.ceil(3 * SMOOTH_PX)
    kernel = np.exp(-(np.arange(-reach, reach + 1.0) ** 2) / (2 * SMOOTH_PX**2))
    kernel /= kernel.sum()
    found = cv2.sepFilter2D(grey.numpy(), -1, kernel, kernel, borderType=cv2.BORDER_REFLECT_101)
    return torch.from_numpy(found)
