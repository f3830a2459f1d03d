"""What one call of `qs3 predict` is asked, and where its clouds come from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from qs3.config.checks import check_choice
from qs3.datasets.importing import UP_AXES
from qs3.errors import ConfigError
from qs3.evaluation.prior import POWER
from qs3.inference.depth_list import check_scale
from qs3.inference.floor import Floor, check_camera_height, check_floor
from qs3.inference.inputs import Unit
from qs3.inference.predictor import Predictor


@dataclass(frozen=True)
class Settings:
    """Settings of one call.

    Attributes:
        ckpt: a run's folder or result.pt, or the name of a classifier that comes with qs3; "": the
            one of these that fits what is known of the clouds.
        second: another classifier that is asked, too, likewise; "none"; "": of those that come with
            qs3 if `ckpt` is "", else none.
        input: a file or folder of clouds, or an archive of cut objects; "" if `depth` is given.
        depth: a depth image, a folder or list of them; "" if `input` is given.
        mask, box, intrinsics: of depth images; see `qs3.inference.depth_list`.
        depth_scale: metres a unit; None: by the kind of numbers.
        up: the axis that points up in clouds (z if ""), or a direction in the depth camera's frame.
        floor: where the floor is in clouds along that axis, in metres; None: not known.
        camera_height: of the depth images' camera above the floor, in metres; likewise.
        prior: how common classes are; "": as in training. See `qs3.evaluation.prior`.
        prior_power: how much of that is believed.
        part: of an archive; "" for what one chooses on, "all" for all: see `archive_units`.
        sample: so many of all clouds or objects, drawn at random; None: all.
        out: .csv or .json.
        page: also write a page beside it.
        batch_size: clouds that the net sees at a time.
        threads: batches that are worked on at the same time.
        device: of the net.
        packages: where nets of one's own may be defined, beside those of qs3; the code there is
            run.
    """

    ckpt: str = ""
    second: str = ""
    input: str = ""
    depth: str = ""
    mask: str = ""
    box: str = ""
    intrinsics: str = ""
    depth_scale: float | None = None
    up: str = ""
    floor: float | None = None
    camera_height: float | None = None
    prior: str = ""
    prior_power: float = POWER
    part: str = ""
    sample: int | None = None
    out: str = "predictions.csv"
    page: bool = True
    batch_size: int = 16
    threads: int = 1
    device: str = "cpu"
    packages: Sequence[str] = ()

    def __post_init__(self) -> None:
        if bool(self.input) == bool(self.depth):
            raise ConfigError("give input=PATH for clouds, or depth=PATH for depth images")
        of_depth = ("box", "camera_height", "depth_scale", "intrinsics", "mask")
        given = [key for key in of_depth if getattr(self, key) not in ("", None)]
        if given and not self.depth:
            raise ConfigError(f"{given[0]}= is for depth images; give depth=IMAGE, not input=")
        if self.depth_scale is not None:
            check_scale(self.depth_scale)
        if self.depth and self.floor is not None:
            raise ConfigError("floor= is for clouds; of depth images give camera_height=METRES")
        if self.camera_height is not None:
            check_camera_height(self.camera_height)
        if self.floor is not None:
            check_floor(self.floor)
        if self.input:
            check_choice("up", self.up or "z", UP_AXES)
        if Path(self.out).suffix.lower() not in (".csv", ".json"):
            raise ConfigError(f"out={self.out} must end in .csv or .json")


class Inputs(NamedTuple):
    """What there is to read, how many files of which ending are passed over, what a unit is called.

    `part` says which part of an archive they are, if it has parts; `sizes` counts the objects of
    each unit, None: each is one.
    """

    units: Sequence[Unit]
    others: Mapping[str, int]
    kind: str
    part: str = ""
    sizes: Callable[[], Sequence[int]] | None = None


class Source(NamedTuple):
    """Where clouds come from.

    `find` gives them for a net; `given`: whether they are in metres, and the height of the floor or
    of the camera was said; `tells` is the option that says it; `floor`: what the clouds themselves
    say, if they were asked.
    """

    find: Callable[[Predictor], Inputs]
    given: bool
    tells: str
    floor: Floor | None = None

    @property
    def floor_known(self) -> bool:
        """Whether somebody said where the floor is, or the clouds do."""
        return self.given or (self.floor is not None and self.floor.z is not None)
