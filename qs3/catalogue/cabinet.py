"""Cabinets: night stands, chests, wardrobes, sideboards, kitchens, filing, display, hutches."""

from dataclasses import replace

from qs3.catalogue import parts as p
from qs3.catalogue.furniture import Draw, families_of
from qs3.catalogue.joinery import WHOLE, Case, build, families_of_cases, stacked
from qs3.meshes.mesh import Mesh

TRAIN = {
    "night_stand": Case(
        bay=(0.36, 0.6), bays=(1, 1), depth=(0.32, 0.46), height=(0.3, 0.48), lift=(0.04, 0.25),
        layouts=(
            (("drawer", 1.0, (0.13, 0.4)),), (("open", 0.62, WHOLE), ("drawer", 0.38, WHOLE)),
            (("door", 0.62, WHOLE), ("drawer", 0.38, WHOLE)),
        ),
        feet=("plinth", "square", "tapered"),
    ),
    "chest_of_drawers": Case(
        bay=(0.6, 0.85), bays=(1, 2), depth=(0.38, 0.55), height=(0.6, 1.15), lift=(0.03, 0.18),
        layouts=((("drawer", 1.0, (0.15, 0.28)),),), alike=True,
    ),
    "wardrobe": Case(
        bay=(0.42, 0.56), bays=(1, 4), depth=(0.5, 0.65), height=(1.7, 2.2), lift=(0.04, 0.14),
        layouts=(
            (("door", 1.0, WHOLE),), (("drawer", 0.22, (0.2, 0.5)), ("door", 0.78, WHOLE)),
        ),
        alike=True, feet=("plinth", "plinth", "square", "bun"),
    ),
    "sideboard": Case(
        bay=(0.36, 0.6), bays=(3, 4), depth=(0.36, 0.5), height=(0.42, 0.68), lift=(0.08, 0.3),
        layouts=(
            (("door", 1.0, WHOLE),), (("drawer", 1.0, (0.14, 0.3)),), (("open", 1.0, (0.2, 0.35)),),
        ),
        feet=("tapered", "tapered", "square", "plinth"),
    ),
}  # fmt: skip
TEST = {
    "filing": Case(
        bay=(0.38, 0.48), bays=(1, 2), depth=(0.5, 0.65), height=(0.55, 1.35), lift=(0.02, 0.07),
        layouts=((("drawer", 1.0, (0.26, 0.34)),),), alike=True,
        fronts=("flat",), feet=("plinth", "square"), board=(0.014, 0.016),
    ),
    "display": Case(
        bay=(0.4, 0.55), bays=(1, 2), depth=(0.32, 0.45), height=(1.1, 1.9), lift=(0.05, 0.2),
        layouts=(
            (("glass", 1.0, (0.3, 0.42)),), (("door", 0.28, WHOLE), ("glass", 0.72, (0.3, 0.42))),
        ),
        alike=True,
    ),
}  # fmt: skip
BASE_UNITS = Case(
    bay=(0.4, 0.62), bays=(1, 3), depth=(0.55, 0.62), height=(0.68, 0.76), lift=(0.1, 0.15),
    layouts=(
        (("door", 1.0, WHOLE),), (("door", 0.8, WHOLE), ("drawer", 0.2, WHOLE)),
        (("drawer", 1.0, (0.2, 0.3)),),
    ),
    feet=("plinth",),
)  # fmt: skip
WALL_UNITS = replace(
    BASE_UNITS, depth=(0.32, 0.36), height=(0.5, 0.75), lift=(0.0, 0.0), top=False,
    layouts=((("door", 1.0, WHOLE),),),
)  # fmt: skip
BUFFET = Case(
    bay=(0.4, 0.55), bays=(2, 3), depth=(0.42, 0.55), height=(0.65, 0.85), lift=(0.04, 0.12),
    layouts=((("door", 0.76, WHOLE), ("drawer", 0.24, WHOLE)),), alike=True,
    fronts=("raised", "framed", "flat"), feet=("plinth", "bun", "square"),
)  # fmt: skip
BUFFET_TOP = replace(
    BUFFET, depth=(0.26, 0.36), height=(0.8, 1.15), lift=(0.0, 0.0),
    layouts=(
        (("open", 1.0, (0.22, 0.32)),), (("glass", 1.0, (0.22, 0.32)),),
        (("open", 0.28, WHOLE), ("door", 0.72, WHOLE)),
    ),
)  # fmt: skip


def kitchen(draw: Draw) -> list[Mesh]:
    """Base units under a worktop, perhaps wall units above a splashback."""
    width = draw.between(0.45, 1.8)
    bays = max(1, round(width / 0.5))
    parts = build(draw, replace(BASE_UNITS, bays=(bays, bays)), width)
    if draw.chance(0.3):
        upper, rise = build(draw, replace(WALL_UNITS, bays=(bays, bays)), width), 0.5
        tall = max(float(part.bounds[1, 2]) for part in upper) + rise
        back, z = BASE_UNITS.depth[0] / 2, max(float(part.bounds[1, 2]) for part in parts)
        rear = max(float(part.bounds[1, 1]) for part in parts)
        parts = stacked(parts, upper, rise)
        parts.append(p.box((width, 0.015, tall), (0, max(back, rear) + 0.007, z)))
    return parts


def hutch(draw: Draw) -> list[Mesh]:
    """A buffet in two parts: a deep lower cabinet and a shallower upper one, often pedimented."""
    width = draw.between(0.8, 1.5)
    bays = 2 if width < 1.15 else draw.count(2, 3)
    lower, upper = (
        build(draw, replace(case, bays=(bays, bays)), width - narrower)
        for case, narrower in ((BUFFET, 0.0), (BUFFET_TOP, draw.pick(0.0, 0.06)))
    )
    if draw.chance(0.5):
        half, rise, high = width / 2, draw.between(0.05, 0.18), float(upper[-1].bounds[1, 2])
        outline = [(-half, 0), (half, 0), (half, 0.03), (0, rise), (-half, 0.03)]
        upper.append(p.move(p.extrude(outline, 0.26, "y"), (0, -0.13, high)))
    return stacked(lower, upper)


FAMILIES = (
    *families_of_cases("train", TRAIN),
    *families_of_cases("test", TEST),
    *families_of(train=(kitchen,), test=(hutch,)),
)
