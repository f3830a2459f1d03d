"""Census strings and how many of their bits differ."""

from __future__ import annotations

import cv2
import numpy as np


def census(image: np.ndarray, window_px: int) -> list[np.ndarray]:
    """Which pixels of the window around a pixel are brighter than it.

    Zabih and Woodfill, Non-parametric local transforms, ECCV 1994, section 3. The border is
    mirrored.

    Args:
        image: [h, w] uint8 or float32.
        window_px: side of the window, odd.

    Returns:
        Arrays [h, w] of unsigned integers, as few and as narrow as hold window_px ** 2 - 1 bits.
    """
    half = window_px // 2
    height, width = image.shape
    padded = cv2.copyMakeBorder(image, half, half, half, half, cv2.BORDER_REFLECT_101)
    around = [divmod(k, window_px) for k in range(window_px**2)]
    around.remove((half, half))
    planes = np.zeros((-(-len(around) // 8), height, width), dtype=np.uint8)
    for bit, (dy, dx) in enumerate(around):
        brighter = padded[dy : dy + height, dx : dx + width] > image
        planes[bit // 8] |= brighter.view(np.uint8) << np.uint8(bit % 8)
    words = []
    while len(planes):
        size = min(8, 1 << (len(planes) - 1).bit_length())
        word = np.zeros((height, width, size), dtype=np.uint8)
        part = planes[:size]
        word[..., : len(part)] = part.transpose(1, 2, 0)
        words.append(word.view(f"u{size}")[..., 0])
        planes = planes[size:]
    return words


def count_ones(words: np.ndarray) -> np.ndarray:
    """Number of set bits of unsigned integers, as uint8.

    Neighbouring bits are added, then pairs, then fours, then all bytes by one multiplication
    (Warren, Hacker's Delight, section 5-1): no table, and vectorised.
    """
    kind = words.dtype.type
    bits = 8 * words.dtype.itemsize
    full = (1 << bits) - 1
    every_second, pairs, fours = (kind(full // d) for d in (3, 5, 17))
    x = words - ((words >> kind(1)) & every_second)
    y = (x >> kind(2)) & pairs
    x &= pairs
    x += y
    np.right_shift(x, kind(4), out=y)
    x += y
    x &= fours
    if bits > 8:
        x *= kind(full // 255)
        x >>= kind(bits - 8)
    return x.astype(np.uint8)
