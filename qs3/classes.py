"""The ten classes of the Sim2Real benchmark in their published order, and ModelNet40's.

PointDA-10 (Qin et al., NeurIPS 2019) fixed the order; DefRec, GAST and QS3 kept it.
`cabinet` holds ModelNet's `night_stand` and ScanNet's cabinets.
"""

import unicodedata
from collections.abc import Sequence

CLASSES: tuple[str, ...] = (
    "bathtub",
    "bed",
    "bookshelf",
    "cabinet",
    "chair",
    "lamp",
    "monitor",
    "plant",
    "sofa",
    "table",
)

ALIASES: dict[str, str] = {
    "night_stand": "cabinet",  # ModelNet
    "nightstand": "cabinet",
    "shelf": "bookshelf",  # PointDA-10's list of ScanNet names
    "couch": "sofa",
}
"""Names of the same classes in published datasets, mapped to ours."""


MODELNET40: tuple[str, ...] = (
    *("airplane", "bathtub", "bed", "bench", "bookshelf", "bottle", "bowl", "car", "chair", "cone"),
    *("cup", "curtain", "desk", "door", "dresser", "flower_pot", "glass_box", "guitar"),
    *("keyboard", "lamp", "laptop", "mantel", "monitor", "night_stand", "person", "piano", "plant"),
    *("radio", "range_hood", "sink", "sofa", "stairs", "stool", "table", "tent", "toilet"),
    *("tv_stand", "vase", "wardrobe", "xbox"),
)
"""ModelNet40's classes (Wu et al., CVPR 2015) in alphabetical order, the usual one."""


def class_list(classes: str | Sequence[str] | None) -> tuple[str, ...]:
    """What a config says: names, "modelnet40", or nothing (the ten)."""
    if isinstance(classes, str):
        return MODELNET40 if classes == "modelnet40" else (classes,)
    return CLASSES if classes is None else tuple(map(str, classes))


def known_as(name: str, classes: Sequence[str]) -> str | None:
    """Which of `classes` a folder or file calls `name`, whatever its case; None if none."""

    def plain(word: str) -> str:
        whole = unicodedata.normalize("NFC", word)  # macOS writes an umlaut as two characters
        return whole.casefold().replace("-", "_").replace(" ", "_")

    if name in classes:  # before aliases: `night_stand` is a class of ModelNet40
        return name
    names = {plain(known): known for known in classes}
    return next((names[c] for c in (plain(name), ALIASES.get(plain(name))) if c in names), None)
