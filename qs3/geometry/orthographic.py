"""Clouds seen from far away: where points appear in a picture without perspective."""

from __future__ import annotations

import numpy as np

AZIMUTH_DEG, ELEVATION_DEG = -55.0, 18.0


def axes_of(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """[3, 3] rows right, up and towards the viewer, who stands at this azimuth; z is up."""
    a, e = np.deg2rad([azimuth_deg, elevation_deg])
    towards = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    return np.stack([right, np.cross(towards, right), towards])


def project(cloud: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the points of a cloud appear, nearest last, from slightly above.

    Args:
        cloud: [P, 3], z up, any unit.

    Returns:
        [P, 2] right and up in the picture, within the unit disc; [P] depth from 0 (far) to 1
        (near), ascending; [P] height from 0 to 1.
    """
    xyz = np.asarray(cloud, dtype=np.float64)
    xyz = xyz - (xyz.min(axis=0) + xyz.max(axis=0)) / 2
    xyz = xyz / max(float(np.linalg.norm(xyz, axis=1).max()), 1e-12)
    right, up, towards = axes_of(AZIMUTH_DEG, ELEVATION_DEG)
    depth = xyz @ towards
    order = np.argsort(depth, kind="stable")
    seen = np.stack([xyz @ right, xyz @ up], axis=1)[order]
    return seen, unit(depth)[order], unit(xyz[:, 2])[order]


def unit(values: np.ndarray) -> np.ndarray:
    """The values stretched to 0..1; all 0 if they are equal."""
    return (values - values.min()) / max(float(np.ptp(values)), 1e-12)
