"""Several datasets of qs3 as one: a net learns from all of them, as from scans by several sensors.

Scans of one object, known by its id, stay together in validation (they are called id, id~1, id~2,
as `generate.py scans=N` does). Each is as it is stored: coordinates are not scaled.
"""

import dataclasses
import functools
import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import field
from pathlib import Path
from typing import Any

import numpy as np

from qs3.datasets.importing import Importer, Item, by_class
from qs3.errors import DataError
from qs3.store.meta import FURTHER_SCAN, META, OK, MadeOf, read_manifest
from qs3.store.store import open_pointset
from qs3.utils.settings import settings


@settings
class Joined(Importer):
    """See the module.

    Attributes:
        datasets: folders of finished datasets, in `folder` or by their whole paths; their clouds
            have at most `points` points.
    """

    datasets: list[str] = field(default_factory=list)

    @property
    def stores(self) -> list[Path]:
        """The datasets' folders."""
        return [self.root / name for name in self.datasets]

    def files(self) -> list[Path]:
        """See `Importer`."""
        return [folder / META for folder in self.stores]

    def made_of(self) -> MadeOf:
        """See `Importer`: what differs among the datasets is listed."""
        made = [open_pointset(folder, verify=False).made_of for folder in self.stores]
        views = {one.views for one in made}
        return MadeOf(
            objects=" and ".join(dict.fromkeys(one.objects for one in made)),
            sensor=" and ".join(dict.fromkeys(one.sensor for one in made if one.sensor)),
            views=views.pop() if len(views) == 1 else 0,
            benchmark=f"{len(made)} datasets joined",
        )

    def settings(self) -> dict[str, Any]:
        """See `Importer`; with a digest of what the datasets hold."""
        digest = hashlib.sha256()
        for folder in self.stores if self.is_there() else ():
            digest.update(open_pointset(folder, verify=False).sha256.encode())
        return {**super().settings(), "files": digest.hexdigest()}

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`; sorted by split, class and id."""
        scans: Counter[str] = Counter()
        found = []
        for name, folder in zip(self.datasets, self.stores, strict=True):
            data = open_pointset(folder)
            if data.classes != tuple(classes) or self.stores.count(folder) > 1:
                raise DataError(f"{folder} has other classes, or comes twice in published.datasets")
            kept = (row for row in read_manifest(folder) if row.status == OK)
            for i, row in enumerate(kept):
                object_ = FURTHER_SCAN.sub("", row.id)
                number = scans[object_]
                scans[object_] += 1
                row = dataclasses.replace(
                    row,
                    id=f"{object_}~{number}" if number else object_,
                    origin=f"{name}/{row.id}",
                    index=None,
                    more={**row.more, "dataset": name},
                )
                # Without the repetitions by which a small cloud was filled up.
                load = functools.partial(np.asarray, data.points[i][: row.valid_points])
                found.append(Item(row, load))
        return by_class(found, classes)
