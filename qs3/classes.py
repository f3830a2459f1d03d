"""The ten classes of the Sim2Real benchmark and their published order.

PointDA-10 (Qin et al., NeurIPS 2019) fixed the order; DefRec, GAST and QS3 kept it.
`cabinet` holds ModelNet's `night_stand` and ScanNet's cabinets.
"""

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
