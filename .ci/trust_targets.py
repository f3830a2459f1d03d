"""The targets of `.ci/trust_cases.py`: clouds with their classes, and how nets see them.

Scans of test meshes, which no net has seen, as the stores `data/test_NAME` (docs/results/trust.md
has the commands), the sample of room scans that comes with qs3, and an archive of real objects, of
which only the part `adapt` is looked at. At most `MOST` clouds of each, at even steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from qs3.classes import CLASSES
from qs3.data.importers.arrays import named_arrays
from qs3.data.importers.object_archive import read_archive
from qs3.data.store import open_pointset
from qs3.datamodules.clouds import Clouds
from qs3.datamodules.fps_samples import sample
from qs3.evaluation.trust import compared
from qs3.inference.pretrained import FOLDER

MOST = 150

STORES = {
    "M": "test_modelnet10",
    "S": "test_specklenet10",
    "S_1": "test_specklenet10_view",
    "S_K": "test_specklenet10_kinect",
    "S_tof": "test_specklenet10_tof",
}
ROOMS = {"R": "sample_kinect", "R_d435": "sample_d435", "R_tof": "sample_tof"}
FLOOR = {"real": -1.18, "rooms": 0.0}
"""z of the floor, of targets in metres of which it is known."""


@dataclass(frozen=True, eq=False)
class Target:
    """Clouds with their classes; `left_out` names what is never on both sides of a fit."""

    name: str
    left_out: str
    clouds: list[np.ndarray]
    labels: np.ndarray
    floor: float | None = None

    def few(self, most: int = MOST) -> Target:
        """At most so many, at even steps."""
        take = np.unique(np.linspace(0, len(self.labels) - 1, min(most, len(self.labels))))
        index = take.astype(int)
        some = [self.clouds[i] for i in index]
        return Target(self.name, self.left_out, some, self.labels[index], self.floor)


def targets(data: Path, objects: Path) -> Iterator[Target]:
    """All of them that are there."""
    for name, store in STORES.items():
        if not (data / store / "meta.yaml").is_file():
            print(f"{data / store} is not there: left out")
            continue
        found = open_pointset(data / store, verify=False)
        yield Target(name, name, list(found.points), np.array(found.labels)).few()
    arrays = named_arrays(FOLDER / "source_sample.npz")
    labels = np.array([CLASSES.index(cls) for cls in arrays["cls"].tolist()])
    for name, ending in ROOMS.items():
        rows = [i for i, one in enumerate(arrays["name"].tolist()) if one.endswith(ending)]
        clouds = [arrays["points"][i].astype(np.float32) for i in rows]
        yield Target(name, name, clouds, labels[rows], FLOOR["rooms"]).few()
    archive = read_archive(objects)
    adapt = np.array(archive.of_part("adapt"))
    middle = np.median(archive.frame[adapt])
    for tier in ("clean", "hard"):
        for half, other_rooms in (("a", False), ("b", True)):
            wanted = (archive.tier[adapt] == tier) & (
                (archive.frame[adapt] > middle) == other_rooms
            )
            rows = adapt[wanted].tolist()
            few = Target("", "", rows, np.zeros(len(rows))).few().clouds
            clouds = [archive.cloud(i, inliers_only=True) for i in few]
            of = np.array([CLASSES.index(str(archive.cls[i])) for i in few])
            yield Target(f"real_{tier}_{half}", "real", clouds, of, FLOOR["real"])


class View(NamedTuple):
    """A target's clouds as nets see them."""

    points: torch.Tensor
    measures: np.ndarray


def view(target: Target, points: int, scale: str) -> View:
    """Farthest points of each cloud, in the given scale."""
    stored = np.stack([of_size(cloud) for cloud in target.clouds])
    clouds = Clouds.of(stored, sample(stored, points, 1), scale, target.floor or 0.0)
    return View(clouds.all(), compared(clouds))


def of_size(cloud: np.ndarray, size: int = 2048) -> np.ndarray:
    """Points repeated from the first one on, as a store has them."""
    return np.ascontiguousarray(np.resize(cloud, (max(size, len(cloud)), 3)), dtype=np.float32)[
        :size
    ]
