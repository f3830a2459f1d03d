"""ModelNet's CAD meshes, `<class>/{train,test}/*.off`, sampled here: P points on each surface.

The folder is that of the unpacked archive, or the root of torch_geometric.datasets.ModelNet, which
keeps the same tree in `raw/`. Points are uniform on the area, as PyG's SamplePoints and PointDA-10
draw them; every object has its own seed, made from the dataset's seed and the object's id, so the
order of reading changes nothing. The files stand on z, in the units of their makers.

The files are read by `qs3.meshes`, not by `torch_geometric.io.read_off`. Both read the same from
files that are as they should be. But PyG's reader (2.8.1) passes over polygons of more than four
corners and takes truncated files, vertices that are not finite and faces with vertices that do not
exist, all without a word; a test shows it.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from qs3.classes import ALIASES
from qs3.config.checks import check_int
from qs3.datasets.importers.base import (
    Importer,
    Item,
    by_class,
    cloud_id,
    file_item,
    folders_in,
    unique,
)
from qs3.datasets.importers.trees import list_tree
from qs3.errors import DataError, MeshError
from qs3.store.meta import MadeOf
from qs3.utils.seeding import derive

_WHERE = ("", "raw", "ModelNet40", "ModelNet10")  # below the folder, the tree may lie here


@dataclass(frozen=True)
class ModelNetMeshes(Importer):
    """See the module. Folders of other classes than the wanted ones are left alone.

    Attributes:
        seed: of the dataset; another one gives other points on the same surfaces.
    """

    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_int("published.seed", self.seed, 0)

    def made_of(self) -> MadeOf:
        """See `Importer`."""
        return MadeOf(objects="ModelNet's published meshes", sensor="surface samples")

    def looks_for(self) -> list[str]:
        """See `Importer`."""
        return [
            f"{self.root}/<class>/{{train,test}}/*.off",
            f"{self.root}/raw/<class>/{{train,test}}/*.off   (root of PyG's ModelNet)",
        ]

    def is_there(self) -> bool:
        """See `Importer`: whether there is a folder with a folder `train`."""
        return self._tree() is not None

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`. By split, in it by class, in it by name.

        Raises:
            DataError: no tree, or as `list_tree`; or two files of one name.
        """
        tree = self._tree()
        if tree is None:
            raise DataError(f"{self.root} holds no folders <class>/{{train,test}}")
        found = list_tree(tree, ".off", functools.partial(wanted_class, classes=classes))
        return by_class(unique(self._item(*one, tree) for one in found), classes)

    def _item(self, path: Path, cls: str, split: str, tree: Path) -> Item:
        seed = derive(self.seed, "modelnet surface", cloud_id(cls, split, path.stem))
        load = functools.partial(sample_file, points=self.points, seed=seed)
        item = file_item(path, tree, cls, split, load)
        return item._replace(row=dataclasses.replace(item.row, seed=seed))

    def _tree(self) -> Path | None:
        for below in _WHERE:
            tree = self.root / below
            if tree.is_dir() and any((f / "train").is_dir() for f in folders_in(tree, self.root)):
                return tree
        return None


def sample_file(path: Path, points: int, seed: int) -> np.ndarray:
    """[points, 3] float32, uniform on the surface in one mesh file, in the file's axes and units.

    Raises:
        MeshError: the file is damaged or has no surface; names the file.
    """
    from qs3.geometry.sampling import surface_sample
    from qs3.meshes.io import load_mesh

    mesh = load_mesh(path)
    try:
        cloud = surface_sample(mesh.vertices, mesh.faces, points, np.random.default_rng(seed))
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error
    return cloud.astype(np.float32)


def wanted_class(folder: str, classes: Sequence[str]) -> str | None:
    """Which of `classes` a folder of ModelNet holds; None if it is none of them.

    A name that is wanted as it is comes before its meaning among the ten: `night_stand` is
    itself in ModelNet40 and `cabinet` in PointDA-10.
    """
    name = folder.casefold()
    return next((c for c in (name, ALIASES.get(name)) if c in classes), None)
