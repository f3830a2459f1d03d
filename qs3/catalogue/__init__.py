"""The embedded catalogue: parametric meshes of the ten classes, made from text keys alone.

Which object of which family a catalogue holds; the families are in one module per class.
"""

from functools import cache, partial
from importlib import import_module
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge

from qs3.catalogue.furniture import Draw, Family
from qs3.classes import CLASSES
from qs3.meshes.mesh import Mesh, MeshItem, merge
from qs3.utils.settings import settings

Count = Annotated[int, Ge(0)]
FAMILY = "catalogue:"
"""Before class and family in an object's origin."""


@settings
class Catalogue:
    """Objects made on demand, each from (seed, class, split, index) alone.

    A larger catalogue therefore begins with the objects of a smaller one, and catalogues with
    different seeds share no mesh.

    Attributes:
        seed: of the meshes.
        train, test: objects per class, or a count for every class.
        classes: in any order: that of the items is of `qs3.classes`.
        families: "apart" draws test objects from structural families that training objects never
            come from; "shared" draws both from all families, as scenes of one building do.
    """

    seed: int = 0
    train: Count | dict[str, Count] = 20
    test: Count | dict[str, Count] = 10
    classes: tuple[str, ...] = CLASSES
    families: Literal["apart", "shared"] = "apart"

    def items(self) -> list[MeshItem]:
        """All objects, ordered by class, split (train first) and index; no mesh is made yet."""
        return [
            self._item(cls, split, index)
            for cls in CLASSES
            if cls in self.classes
            for split, counts in (("train", self.train), ("test", self.test))
            for index in range(counts if isinstance(counts, int) else counts[cls])
        ]

    def _item(self, cls: str, split: str, index: int) -> MeshItem:
        shared = self.families == "shared"
        names = tuple(f.name for f in families(cls) if shared or f.split == split)
        family = _shuffled(names, f"{self.seed}/{cls}/{split}")[index % len(names)]
        return MeshItem(
            id=f"{cls}/{split}/{cls}_{index:04d}",
            cls=cls,
            split=split,
            load=partial(make, cls, family, f"{self.seed}/{split}/{index}"),
            origin=f"{FAMILY}{cls}/{family}",
        )


@cache
def families(cls: str) -> tuple[Family, ...]:
    """The structural families of a class, of both splits."""
    found: tuple[Family, ...] = import_module(f"{__package__}.{cls}").FAMILIES
    return found


def make(cls: str, family: str, key: str) -> Mesh:
    """One object as one mesh; equal arguments give equal meshes."""
    return merge(make_parts(cls, family, key))


def make_parts(cls: str, family: str, key: str) -> list[Mesh]:
    """The watertight parts of one object, standing on the floor (z = 0), front along -y."""
    builders = {f.name: f.build for f in families(cls)}
    parts = builders[family](Draw(f"{cls}/{family}/{key}"))
    shift = np.array([0.0, 0.0, min(part.bounds[0, 2] for part in parts)])
    return [Mesh(part.vertices - shift, part.faces) for part in parts]


@cache
def _shuffled(names: tuple[str, ...], key: str) -> list[str]:
    """The names in an order that depends on `key`; going round it uses all equally often."""
    draw = Draw(f"order of families/{key}")
    return [name for _, name in sorted((draw.between(0, 1), name) for name in names)]
