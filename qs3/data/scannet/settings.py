"""What can be chosen about the extraction; the defaults are the paper's where it says something."""

from __future__ import annotations

from dataclasses import dataclass

from qs3.config.checks import check_bool, check_choice, check_float, check_int
from qs3.data.scannet.labels import COLUMNS
from qs3.errors import ConfigError


@dataclass(frozen=True)
class Extraction:
    """Settings of the extraction.

    Attributes:
        points: of a cloud (paper: 2,048).
        min_points: a frame counts if it gives more than this of an object (paper: 1,000).
        views: frames that are fused, fewer if there are fewer (paper: 10).
        stride: every how many frames of the recording are looked at. The paper names none.
        depth_min_m, depth_max_m: depths outside are left out.
        margin_px: mask pixels around the one that a depth pixel falls on which must be of the
            same object; see `qs3.data.scannet.registration.agreed`.
        align: turn each scene about z by its `axisAlignment`, so that walls follow x and y.
        column: of the label map, compared with the ten names: "category" or "raw_category".
    """

    points: int = 2048
    min_points: int = 1000
    views: int = 10
    stride: int = 1
    depth_min_m: float = 0.1
    depth_max_m: float = 10.0
    margin_px: int = 1
    align: bool = False
    column: str = "category"

    def __post_init__(self) -> None:
        for key, least in (
            ("points", 1), ("min_points", 0), ("views", 1), ("stride", 1), ("margin_px", 0),
        ):  # fmt: skip
            check_int(key, getattr(self, key), least)
        near = check_float("depth_min_m", self.depth_min_m)
        far = check_float("depth_max_m", self.depth_max_m)
        if not 0 < near < far < float("inf"):
            raise ConfigError(
                f"0 < depth_min_m < depth_max_m must hold, got {self.depth_min_m} and "
                f"{self.depth_max_m}"
            )
        check_bool("align", self.align)
        check_choice("column", self.column, COLUMNS)
