"""Upright shapes to learn from, and `gravity.json`: what was learnt from the embedded catalogue.

`python -m qs3.data.inspection.upright` learns it again (a minute) and writes the file.
"""

from __future__ import annotations

import json

import numpy as np
from jaxtyping import Float

from qs3.classes import CLASSES
from qs3.data.inspection.gravity import LEARNT, POINTS, UpModel, turned
from qs3.geometry.sampling import surface_sample
from qs3.meshes.catalogue import Catalogue
from qs3.utils.files import write_text

SHAPES = 40
"""Of the catalogue a class, to learn from."""

_DIGITS = 6


def learnt(cls: str) -> dict[str, list[float]]:
    """What `gravity.json` holds of one class: `UpModel`'s arrays, to six digits."""
    model = UpModel.fit({cls: upright_examples(cls, SHAPES)})
    arrays = {"mean": model.mean, "scale": model.scale, "weights": model.weights}
    return {
        name: [float(f"{value:.{_DIGITS}g}") for value in of[cls]] for name, of in arrays.items()
    }


def main() -> None:
    """Write `gravity.json`, a class a line."""
    lines = [f"{json.dumps(cls)}: {json.dumps(learnt(cls))}" for cls in CLASSES]
    write_text(LEARNT, "{\n" + ",\n".join(lines) + "\n}\n")


def upright_examples(cls: str, shapes: int, seed: int = 7) -> Float[np.ndarray, "n 512 3"]:
    """Clouds of the catalogue's objects of a class, z up: four of each shape, two of them scans."""
    rng = np.random.default_rng([seed, CLASSES.index(cls)])
    catalogue = Catalogue(seed=seed, train=shapes, test=0, classes=(cls,), families="all")
    clouds = []
    for item in catalogue.items():
        mesh = item.load()
        for kind in range(4):
            cloud = surface_sample(mesh.vertices, mesh.faces, 4 * POINTS, rng)
            cloud = turned(
                cloud * rng.uniform(0.8, 1.25, 3), rng.uniform(0, 2 * np.pi) * (kind % 2)
            )
            if kind >= 2:
                cloud = seen_from_above(cloud, rng)
                cloud = cloud + rng.normal(0, 0.01 * np.ptp(cloud, axis=0).max(), cloud.shape)
            few = len(cloud) < POINTS
            picked = rng.integers(0, len(cloud), POINTS) if few else rng.permutation(len(cloud))
            clouds.append(cloud[picked[:POINTS]])
    return np.stack(clouds)


def seen_from_above(
    cloud: Float[np.ndarray, "p 3"], rng: np.random.Generator
) -> Float[np.ndarray, "m 3"]:
    """The points that are in front in one of four views, 15 to 45 degrees above the horizon."""
    cells, views = 50, 4
    centred = cloud - cloud.mean(axis=0)
    size = max(float(np.abs(centred).max()), 1e-12)
    kept = np.zeros(len(cloud), dtype=bool)
    first, arc = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 2.6)
    for view in range(views):
        azimuth = first + arc * view / (views - 1)
        elevation = np.deg2rad(rng.uniform(15, 45))
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
        away = np.array([np.cos(azimuth), np.sin(azimuth), 0]) * np.cos(elevation)
        towards = away + np.array([0, 0, np.sin(elevation)])
        picture = centred @ np.stack([right, np.cross(towards, right)], axis=1) / size
        column, row = ((picture + 1.8) / 3.6 * cells).astype(int).T  # corners lie at sqrt(3)
        nearness = centred @ towards / size
        front = np.full(cells * cells, -np.inf)
        np.maximum.at(front, row * cells + column, nearness)
        kept |= nearness > front[row * cells + column] - 0.07
    return cloud[kept]


if __name__ == "__main__":
    main()
