"""What can be chosen about the extraction; the defaults are the paper's where it says something."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from qs3.config.checks import check_choice, check_float, check_int
from qs3.datasets.scannet.labels import COLUMNS
from qs3.errors import ConfigError


def _setting(default: Any, says: str) -> Any:
    return field(default=default, metadata={"help": says})


@dataclass(frozen=True)
class Extraction:
    """Settings of the extraction, as `qs3 scannet --help` explains them.

    The paper names points, min_points and views. For margin_px see
    `qs3.datasets.scannet.registration.agreed`.
    """

    points: int = _setting(2048, "of a cloud (farthest point sampling)")
    min_points: int = _setting(
        1000, "a frame counts if it shows more points of the object than this"
    )
    views: int = _setting(
        10, "frames fused, far from each other in direction; fewer if there are fewer"
    )
    stride: int = _setting(1, "look at every n-th frame only; 10 takes a tenth of the time")
    depth_min_m: float = _setting(0.1, "nearer depths are left out")
    depth_max_m: float = _setting(10.0, "farther depths are left out")
    margin_px: int = _setting(1, "pixels about a mask's pixel that must show the same object, too")
    column: str = _setting(
        "category", "of the label map; or raw_category: the annotators' very words"
    )

    def __post_init__(self) -> None:
        for key in ("points", "views", "stride"):
            check_int(key, getattr(self, key), 1)
        for key in ("min_points", "margin_px"):
            check_int(key, getattr(self, key), 0)
        near = check_float("depth_min_m", self.depth_min_m)
        far = check_float("depth_max_m", self.depth_max_m)
        if not 0 < near < far < float("inf"):
            raise ConfigError(f"0 < depth_min_m < depth_max_m must hold, got {near} and {far}")
        check_choice("column", self.column, COLUMNS)
