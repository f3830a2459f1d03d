"""Pictures of datasets: sheets of a class or a split, one object of each class, class balance."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from qs3.store.manifest import ManifestRow
from qs3.store.store import PointSet
from qs3.utils.pictures import AZIMUTH_DEG, Image, cloud_image, save_png, sheet, turn_deg

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


def sheets_by_class(
    data: PointSet,
    rows: Sequence[ManifestRow],
    folder: Path,
    split: str,
    most: int,
    metres: bool,
    heading: str,
    seed: int = 0,
) -> list[Path]:
    """Save FOLDER/CLASS.png of each class that a split has; of unlabelled data all.png.

    Below each cloud stand the end of its id, its tier if it has one, and its longest side.

    Args:
        data: the dataset.
        rows: of its manifest, one a cloud.
        folder: is made.
        split: whose clouds.
        most: clouds of a class; of more these are drawn at random.
        metres: whether its unit is known.
        heading: what is above, behind the class and its number of clouds.
        seed: of the draw.
    """
    here = data.indices(split)
    labels = data.labels[here]
    members = {cls: here[labels == k] for k, cls in enumerate(data.classes)}
    members = {cls: own for cls, own in members.items() if len(own)} or {"all": here}
    saved: list[Path] = []
    for number, (cls, own) in enumerate(members.items()):
        positions = drawn(own, most, seed)
        titles = []
        for i in positions:
            side = f"{np.ptp(data.points[i], axis=0).max():.2f} m" if metres else ""
            words = ", ".join(filter(None, (rows[i].more.get("tier", ""), side)))
            titles.append(f"{_short(data.ids[i])}\n{words}")
        name = re.sub(r"[^\w-]+", "_", cls)[:60] or "_"
        if name.lower() in {path.stem.lower() for path in saved}:
            name += f"_{number}"
        title = f"{cls}: {len(positions)} of {len(own)} of {heading}"
        clouds = [data.points[i] for i in positions]
        saved.append(folder / f"{name}.png")
        save_png(contact_sheet(clouds, titles, 8, heading=title), saved[-1], colours=256)
    return saved


def scan_picture(domains: Mapping[str, PointSet], split: str = "train", note: str = "") -> Figure:
    """One object of each class as each domain has it, two classes a row.

    Where domains share ids (a cloud and its clean twin, surface samples of the same mesh) the
    object is the same; else it is the domain's first of that class.

    Args:
        domains: by column title, such as "S: SpeckleNet10".
        split: which split the objects come from.
        note: a line below all.
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
    return contact_sheet(clouds, titles, 2 * len(sets), heads=[*domains] * 2, note=note)


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
