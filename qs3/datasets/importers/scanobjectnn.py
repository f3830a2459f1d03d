"""ScanObjectNN (Uy et al., ICCV 2019): objects segmented from real scans, 15 classes.

    main_split/{training,test}_objectdataset.h5                             objects as segmented
    main_split/{training,test}_objectdataset_augmentedrot_scale75.h5        PB_T50_RS, the hardest
    main_split_nobg/...                                                     without background

Each file holds `data` [n, 2048, 3] with y up and `label` [n]. Seven of its classes are ours; the
clouds of the others are left out, and how many is logged. bathtub, lamp and plant are not in it.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from qs3.datasets.importers.base import Importer, Item, by_class, turned
from qs3.datasets.importers.pointda_h5 import h5_items
from qs3.utils.plural import counted

log = logging.getLogger(__name__)

NAMES: tuple[str, ...] = (
    *("bag", "bin", "box", "cabinet", "chair", "desk", "display", "door", "shelf", "table"),
    *("bed", "pillow", "sink", "sofa", "toilet"),
)
"""Its classes in the order of its labels."""

OURS = {"display": "monitor", "shelf": "bookshelf"}
"""Its names of our classes where they differ. A desk is not a table: ModelNet40 has both."""


@dataclass(frozen=True)
class ScanObjectNN(Importer):
    """See the module.

    Attributes:
        variant: what follows `_objectdataset` in the files' names, e.g. "_augmentedrot_scale75".
    """

    variant: str = ""
    complete: ClassVar[bool] = False

    def looks_for(self) -> list[str]:
        """See `Importer`."""
        return [str(path) for _, path in self._files()]

    def is_there(self) -> bool:
        """See `Importer`: whether both files are there."""
        return all(path.is_file() for _, path in self._files())

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`; reads the files."""
        names = [OURS.get(name, name) for name in NAMES]
        items = [i for s, path in self._files() for i in h5_items(path, self.root, s, names, 5)]
        ours = [item for item in items if item.row.cls in classes]
        if other := len(items) - len(ours):
            them = counted(other, "cloud of another class is", "clouds of other classes are")
            log.warning("%s: %s left out", self.root, them)
        return by_class(ours, classes)

    def turn(self, cloud: np.ndarray, cls: str) -> np.ndarray:
        """See `Importer`."""
        return turned(cloud, "y")

    def _files(self) -> list[tuple[str, Path]]:
        name = f"objectdataset{self.variant}.h5"
        return [("train", self.root / f"training_{name}"), ("test", self.root / f"test_{name}")]
