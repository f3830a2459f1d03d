"""GraspNetPC-10 (Shen et al., CVPR 2022): ten objects of GraspNet-1Billion seen by two sensors.

    {train,test}/{Real,Synthetic}/{kinect,realsense}/<0-9>/scene_XXXX_FFFF.xyz

1024 rows of x y z, in the frame of the camera, already in the unit ball; there is no gravity axis.
The classes are the objects 0, 2, 5, 8, 9, 15, 46, 48, 60, 66 of GraspNet, called 0 to 9. The test
split is one scene an object, so its frames are highly correlated.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from qs3.config.checks import check_choice
from qs3.datasets.clouds.files import parse_cloud
from qs3.datasets.importers.base import Importer, Item, by_class, file_item, files_in, folders_in
from qs3.errors import ConfigError, DataError

_SENSORS = ("kinect", "realsense")


@dataclass(frozen=True)
class GraspNetPC(Importer):
    """See the module.

    Attributes:
        reality: "Real" or "Synthetic".
        sensors: whose clouds; the benchmark's synthetic domain takes both.
    """

    points: int = 1024
    reality: str = "Real"
    sensors: Sequence[str] = _SENSORS

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "sensors", list(self.sensors))
        check_choice("published.reality", self.reality, ("Real", "Synthetic"))
        if not self.sensors or set(self.sensors) - set(_SENSORS):
            raise ConfigError(f"sensors are {self.sensors}, expected some of {_SENSORS}")

    def looks_for(self) -> list[str]:
        """See `Importer`."""
        sensors = ",".join(self.sensors)
        return [f"{self.root}/{{train,test}}/{self.reality}/{{{sensors}}}/<0-9>/*.xyz"]

    def is_there(self) -> bool:
        """See `Importer`: whether the training part of a sensor is there."""
        return any(self._folder("train", sensor).is_dir() for sensor in self.sensors)

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`. By split, class, sensor and name.

        Raises:
            DataError: a folder that is not a class, or a link that leads out of the folder.
        """
        found = []
        for split, sensor in itertools.product(("train", "test"), self.sensors):
            folder = self._folder(split, sensor)
            if not folder.is_dir():
                continue  # the synthetic domain has no test split
            for class_folder in folders_in(folder, self.root):
                if (cls := class_folder.name) not in classes:
                    raise DataError(
                        f"{class_folder}: unknown class; known are {', '.join(classes)}"
                    )
                for path in files_in(class_folder, self.root, ".xyz"):
                    name = f"{sensor}_{path.stem}"
                    found.append(file_item(path, self.root, cls, split, parse_cloud, name))
        return by_class(found, classes)

    def object_of(self, id_: str) -> str:
        """See `Importer`: each class is one object."""
        return id_.split("/")[0]

    def _folder(self, split: str, sensor: str) -> Path:
        return self.root / split / self.reality / sensor
