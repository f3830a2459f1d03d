"""Pictures of datasets: sheets of a class or a split, one object of each class, class balance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from qs3.store.store import PointSet
from qs3.utils.pictures import AZIMUTH_DEG, Image, cloud_image, sheet, turn_deg

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SHEET, _ROW = 60, 6  # clouds of a class sheet, and in its rows
_SIDE_PX, _POINTS = 376, 1024


def drawn(positions: np.ndarray, most: int, seed: int = 0) -> list[int]:
    """At most so many of some positions [n], at random, always the same ones, in order."""
    if len(positions) <= most:
        return [int(i) for i in positions]
    return sorted(np.random.default_rng(seed).choice(positions, most, replace=False).tolist())


def contact_sheet(
    clouds: Sequence[np.ndarray | None],
    titles: Sequence[str],
    columns: int = _ROW,
    **words: Any,
) -> Figure:
    """A sheet of clouds [P, 3], z up; `words` as of `qs3.utils.pictures.sheet`.

    What lies beside the origin is seen from there, a little from the side: that is where a single
    view has its camera.
    """
    images: list[Image | None] = []
    for cloud in clouds:
        if cloud is not None:
            cloud = np.asarray(cloud, dtype=np.float64)
            some = cloud[:: max(1, len(cloud) // _POINTS)]
            images.append(cloud_image(some, _SIDE_PX, AZIMUTH_DEG + turn_deg(cloud)))
        else:
            images.append(None)
    return sheet(images, titles, columns=columns, **words)


def class_sheet(data: PointSet, split: str, heading: str = "") -> Figure:
    """A sheet of up to 60 of a split's clouds, a class a row, drawn at random."""
    part, columns = data.split(split), _ROW
    rows: tuple[str, ...] = ()
    shown: list[int | None] = []
    if data.labelled:
        columns = max(2, min(columns, _SHEET // len(part.classes)))
        rows = tuple(cls for cls in part.classes if len(part.members(cls)))
        for cls in rows:
            some = drawn(part.members(cls), columns)
            shown += [*some, *[None] * (columns - len(some))]
    else:
        shown += drawn(np.arange(len(part)), _SHEET)
    return contact_sheet(
        [None if i is None else part.points[i] for i in shown],
        ["" if i is None else _short(part.ids[i]) for i in shown],
        columns,
        heading=heading,
        rows=rows,
    )


def scan_picture(domains: Mapping[str, PointSet], split: str = "train") -> Figure:
    """One object of each class as each domain has it, two classes a row.

    Where domains share ids (a cloud and its clean twin, surface samples of the same mesh) the
    object is the same; else it is the domain's first of that class.

    Args:
        domains: by column title, such as "S: SpeckleNet10".
        split: which split the objects come from.
    """
    sets = [data.split(split) for data in domains.values()]
    classes = sets[0].classes
    half = -(-len(classes) // 2)
    order = [cls for i in range(half) for cls in classes[i::half]]
    clouds, titles = [], []
    for cls in order:
        for cloud in _same_object(sets, cls):
            clouds.append(cloud)
            titles.append(cls if cloud is not None else f"no {cls}")
    return contact_sheet(clouds, titles, 2 * len(sets), heads=[*domains] * 2)


def _same_object(sets: Sequence[PointSet], cls: str) -> list[np.ndarray | None]:
    """A cloud of the class from each set, of the object that most sets have; None if none."""
    ids = [[data.ids[i] for i in data.members(cls)] for data in sets]
    everywhere = {name: sum(name in own for own in ids) for own in ids for name in own}
    best = max(everywhere, key=lambda name: everywhere[name], default=None)
    found: list[np.ndarray | None] = []
    for data, own in zip(sets, ids, strict=True):
        name = best if best in own else next(iter(own), None)
        found.append(None if name is None else np.asarray(data.points[data.ids.index(name)]))
    return found


def _short(id_: str) -> str:
    """The end of an id, as a panel has room for."""
    name = id_.rsplit("/", 1)[-1]
    return name if len(name) <= 22 else f"…{name[-21:]}"
