"""What counts as an object that can be used, and which of those are clean.

The values and their reasons are in conf/cutting; the defaults here are the same, without the limits
of the ten classes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from qs3.config.checks import check_bool, check_float, check_int
from qs3.errors import ConfigError


@dataclass(frozen=True)
class Limits:
    """What an object of one class must be like.

    Attributes:
        pixels: an object has at least so many with depth.
        least_m, most_m: its largest extent along x, y or z is between these.
        thin: its things are thin by nature, so that being flat makes none of them hard.
    """

    pixels: int = 700
    least_m: float = 0.1
    most_m: float = 3.5
    thin: bool = False

    def __post_init__(self) -> None:
        check_int("pixels", self.pixels, 1)
        check_bool("thin", self.thin)
        least, most = check_float("least_m", self.least_m), check_float("most_m", self.most_m)
        if not 0 < least < most:
            raise ConfigError(f"least_m={least} and most_m={most}: 0 < least_m < most_m must hold")


@dataclass(frozen=True)
class Rules:
    """How an object is cut, and when it is refused.

    Attributes:
        near_m, far_m: depths outside do not count as measured.
        erode_px: taken off a mask all round; a box has no such edge.
        jump_m, jump_share: neighbouring pixels belong together if their depths differ by no more
            than the larger of the two, the second a share of the depth.
        bridge_px: pixels on both sides of a hole of up to so many pixels count as neighbours.
        join_m: pieces of one object that are this near to each other are put together.
        most_holes: refused above this share of the mask without depth.
        least_kept: hard below this share of the measured pixels in the object's own pieces.
        border_px: an outline so near to the picture's border is cut off by it.
        clean_rim, most_rim: share of the outline that the border cuts off: clean up to the first,
            refused above the second.
        reach_px: how far from an outline something nearer is looked for.
        clean_occ, most_occ: share of the outline that something nearer covers, likewise.
        flat_m: hard if its points lie within so thick a plate.
        neighbours, outlier_sds: a point is an outlier if its mean distance to so many neighbours
            is above the mean by so many standard deviations.
        drop_outliers: whether outliers are left out; else they are only counted.
        box_margin_m: a box is so much larger on all sides.
        floor_m, floor_share: of a box, points so near above the floor are the floor's; the larger
            of the two, the second a share of the depth.
        limits: by class; "default" for the others.
    """

    near_m: float = 0.5
    far_m: float = 6.0
    erode_px: int = 1
    jump_m: float = 0.05
    jump_share: float = 0.03
    bridge_px: int = 8
    join_m: float = 0.15
    most_holes: float = 0.6
    least_kept: float = 0.7
    border_px: int = 2
    clean_rim: float = 0.02
    most_rim: float = 0.12
    reach_px: int = 3
    clean_occ: float = 0.2
    most_occ: float = 0.5
    flat_m: float = 0.03
    neighbours: int = 12
    outlier_sds: float = 2.0
    drop_outliers: bool = False
    box_margin_m: float = 0.02
    floor_m: float = 0.03
    floor_share: float = 0.01
    limits: Mapping[str, Limits] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for key in ("erode_px", "bridge_px", "border_px", "reach_px"):
            check_int(key, getattr(self, key), 0)
        check_int("neighbours", self.neighbours, 1)
        check_bool("drop_outliers", self.drop_outliers)
        for one in dataclasses.fields(self):
            if one.type == "float" and check_float(one.name, getattr(self, one.name)) < 0:
                raise ConfigError(f"rules.{one.name} is {getattr(self, one.name)}, must be >= 0")
        for low, high in (
            ("near_m", "far_m"), ("clean_rim", "most_rim"), ("clean_occ", "most_occ"),
        ):  # fmt: skip
            if not getattr(self, low) <= getattr(self, high):
                raise ConfigError(f"rules.{low} must not be above rules.{high}")

    @staticmethod
    def of(values: Mapping[str, Any] | None) -> Rules:
        """From a config's mapping.

        Raises:
            ConfigError: a key that there is not, or a value that cannot be.
        """
        given = dict(values or {})
        limits = dict(given.pop("limits", None) or {})
        try:
            return Rules(**given, limits={cls: Limits(**one) for cls, one in limits.items()})
        except TypeError as error:
            raise ConfigError(f"published.rules: {error}") from error

    def limits_of(self, cls: str) -> Limits:
        """Limits of a class: its own, or the default ones."""
        return self.limits.get(cls) or self.limits.get("default") or Limits()
