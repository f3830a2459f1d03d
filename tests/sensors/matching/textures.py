"""Blurred dots that can be moved by fractions of a pixel."""

import cv2
import numpy as np

FINE = 16  # positions a pixel


def dots(height, width, seed):
    """Blurred dots on [h, width * FINE] positions, 0..220."""
    rng = np.random.default_rng(seed)
    lit = (rng.random((height, width * FINE)) < 0.15 / FINE).astype(np.float32)
    soft = cv2.GaussianBlur(lit, (0, 0), sigmaX=0.9 * FINE, sigmaY=0.9)
    return soft / np.quantile(soft, 0.99) * 220


def seen(texture, shift_px, seed=None, noise=2.0):
    """The texture as an image, moved to the right by shift_px."""
    height = len(texture)
    image = np.roll(texture, round(shift_px * FINE), axis=1).reshape(height, -1, FINE).mean(axis=2)
    if seed is not None:
        image = image + np.random.default_rng(seed).normal(0, noise, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)
