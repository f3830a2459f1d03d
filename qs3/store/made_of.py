"""What a dataset is made of, in one line: a figure says it wherever it stands."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from qs3.errors import DataError
from qs3.utils.plural import counted

KEY = "made_of"
"""Its key in meta.yaml."""


@dataclass(frozen=True, kw_only=True)
class MadeOf:
    """Whose objects a dataset shows, and what gave the points.

    Attributes:
        objects: "published files", "embedded catalogue", "meshes of cad10", "own clouds of scans".
        published: whether these are the files that were published, and all of them: what papers'
            figures were measured on.
        sensor: name of the simulated one; "surface samples" if nothing looks; "" if the clouds
            were not made here.
        views: of each object; 0 if nothing looks, or nobody knows.
        without: classes of the domain that have no object, such as "lamp, plant".
        benchmark: "kinectsim10 v2", a part of it, or that it is like it, for domains with versions.
        meshes: digits that all datasets made of these very meshes share; "" if nobody knows.
        recipe: digits that datasets made of the same objects by the same settings and code share,
            on any machine; "" if nobody knows.
    """

    objects: str = "not known (meta.yaml does not say)"
    published: bool = False
    sensor: str = ""
    views: int = 0
    without: str = ""
    benchmark: str = ""
    meshes: str = ""
    recipe: str = ""

    # metrics.json holds it, and is read strictly: see qs3.runs.metrics.
    __pydantic_config__: ClassVar[dict[str, Any]] = {"strict": True, "extra": "forbid"}

    @staticmethod
    def of(meta: Mapping[str, Any]) -> MadeOf:
        """As a store's meta.yaml says it.

        Raises:
            DataError: it says something else.
        """
        given, known = meta.get(KEY) or {}, dataclasses.asdict(MadeOf())
        if not isinstance(given, Mapping) or any(
            key not in known or type(value) is not type(known[key]) for key, value in given.items()
        ):
            raise DataError(
                f"meta.yaml of {meta.get('name')!r}: {KEY} is {str(given)[:200]}, not as qs3 "
                "writes it; generate or import the dataset again"
            )
        return MadeOf(**given)

    @property
    def meta(self) -> dict[str, Any]:
        """For meta.yaml."""
        return {KEY: dataclasses.asdict(self)}

    def __str__(self) -> str:
        """Such as "embedded catalogue, speckle_stereo, 5 views"."""
        views = counted(self.views, "view") if self.views else ""
        without = f"without {self.without}" if self.without else ""
        parts = (self.objects, self.sensor, views, without, self.benchmark)
        return ", ".join(filter(None, parts))
