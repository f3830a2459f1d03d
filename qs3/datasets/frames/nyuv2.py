"""`nyu_depth_v2_labeled.mat` and `splits.mat` of NYU Depth V2, one frame at a time.

Silberman, Hoiem, Kohli, Fergus, "Indoor Segmentation and Support Inference from RGBD Images",
ECCV 2012. The file is MATLAB's version 7.3, that is HDF5 with all axes in reverse order:

    rawDepths     float32 [N, W, H]  metres, projected onto the colour image and not filled in;
                                     0 where nothing was measured
    labels        uint16 [N, W, H]   number of the name from 1; 0: nobody labelled it
    instances     uint8 [N, W, H]    counts the things of one name within a frame from 1
    names         cells of text      by the numbers of `labels`
    scenes        cells of text      the room of each frame, e.g. kitchen_0004
    accelData     float32 [4, N]     readings of the accelerometer, then the tilt

The page calls the columns of `accelData` roll, yaw, pitch and tilt; Kinect's driver gives the
acceleration along three axes. `vertical.mounting` finds out whether the first three tell up.

The raw depth lies in the colour camera's image, so its intrinsics are the colour camera's, from
camera_params.m of the authors' toolbox (there with pixels counted from 1). Depth is projected to
rows 45 to 471 and columns 41 to 601 at most (get_projection_mask.m), which is the border that cuts
an object off. `splits.mat` (MATLAB's version 5) holds trainNdxs and testNdxs, counted from 1.
"""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from qs3.datasets.clouds.hdf5 import HDF5_DAMAGE, open_hdf5
from qs3.datasets.frames.images import MAX_SIDE_PX, Pinhole
from qs3.datasets.frames.matlab import AGAIN, load_v5, own_array, variable, words
from qs3.errors import DataError, MissingDataError

CAMERA = Pinhole(518.857901, 519.469611, 325.582449 - 1, 253.736166 - 1)
"""The colour camera, whose image the depth lies in; (0, 0) is the first pixel's centre."""

AREA = (44, 471, 40, 601)
"""Rows from, to and columns from, to of the depth that was projected; of pictures of 640 x 480."""

_SIZE = (480, 640)
_MOST_FRAMES = 100_000
_FARTHEST_M = 9.99
_KINDS = {"rawDepths": "f", "labels": "u", "instances": "u"}


class LabelledFrames:
    """The open .mat; a context manager.

    Attributes:
        path: of the file.
        names: by number of label; names[0] is the first name, whose number is 1.
        scenes: the room of each frame; empty strings if the file does not tell.
        accelerations: [N, 3] float64 readings; NaN where there are none.
    """

    def __init__(self, path: Path) -> None:
        """Open and check the file; images are read when they are asked for.

        Raises:
            MissingDataError: there is no such file.
            DataError: it is broken off, damaged, or something else.
        """
        self.path = path
        if not path.is_file():
            raise MissingDataError(f"there is no {path}")
        try:
            self._file: Any = open_hdf5(path)
        except OSError as error:
            raise DataError(
                f"{path} cannot be opened as HDF5, which nyu_depth_v2_labeled.mat is: it is broken "
                f"off or another file ({error}); {AGAIN}"
            ) from error
        try:
            self._images = {key: self._image(key) for key in _KINDS}
            self.names = words(self._file, "names", path)
            self.scenes = self._scenes()
            self.accelerations = self._accelerations()
        except HDF5_DAMAGE as error:
            self._file.close()
            raise DataError(f"{path} is damaged ({error}); {AGAIN}") from error
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> LabelledFrames:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def __len__(self) -> int:
        """N, the frames."""
        return int(self._images["rawDepths"].shape[0])

    @property
    def area(self) -> tuple[int, int, int, int] | None:
        """Where depth was projected to; None if the pictures have not the published size."""
        return AREA if self._images["rawDepths"].shape[:0:-1] == _SIZE else None

    def depth_m(self, frame: int) -> np.ndarray:
        """[h, w] float64, 0 where nothing was measured (the toolbox cuts depths off at 10 m)."""
        depth = self._read("rawDepths", frame).astype(np.float64)
        return np.where(depth < _FARTHEST_M, depth, 0)

    def labels(self, frame: int) -> np.ndarray:
        """[h, w] number of each pixel's name from 1; 0 for none.

        Raises:
            DataError: a number without a name.
        """
        labels = self._read("labels", frame)
        if labels.max(initial=0) > len(self.names):
            raise DataError(
                f"{self.path}, frame {frame + 1}: label {labels.max()}, but there are "
                f"{len(self.names)} names; {AGAIN}"
            )
        return labels

    def instances(self, frame: int) -> np.ndarray:
        """[h, w] which thing of its name a pixel shows, from 1; 0 for none."""
        return self._read("instances", frame)

    def _read(self, key: str, frame: int) -> np.ndarray:
        """One image, its axes put right."""
        try:
            found: np.ndarray = self._images[key][frame].T
        except (OSError, RuntimeError, MemoryError) as error:
            raise DataError(
                f"{self.path}, frame {frame + 1}: {key} cannot be read ({error}); {AGAIN}"
            ) from error
        return found

    def _image(self, key: str) -> Any:
        found = own_array(self._file, key, self.path)
        shape = found.shape
        fits = len(shape) == 3 and found.dtype.kind == _KINDS[key] and found.dtype.itemsize <= 4
        if not fits or not (1 <= shape[0] <= _MOST_FRAMES and max(shape[1:]) <= MAX_SIDE_PX):
            raise DataError(
                f"{self.path}: {key} is {found.dtype} {shape}, not [frames, width, height] of a "
                "labelled NYU Depth V2"
            )
        if "rawDepths" in self._file and shape != self._file["rawDepths"].shape:
            raise DataError(
                f"{self.path}: {key} is {shape}, rawDepths {self._file['rawDepths'].shape}; {AGAIN}"
            )
        return found

    def _scenes(self) -> list[str]:
        if "scenes" not in self._file:
            return [""] * len(self)
        found = words(self._file, "scenes", self.path)
        if len(found) != len(self):
            raise DataError(f"{self.path}: {len(found)} scenes of {len(self)} frames; {AGAIN}")
        return found

    def _accelerations(self) -> np.ndarray:
        if "accelData" not in self._file:
            return np.full((len(self), 3), np.nan)
        found = own_array(self._file, "accelData", self.path)
        if found.shape != (4, len(self)) or found.dtype.kind != "f":
            raise DataError(
                f"{self.path}: accelData is {found.dtype} {found.shape}, not [4, {len(self)}]"
            )
        return np.asarray(found[:3].T, dtype=np.float64)


def read_splits(path: Path, frames: int) -> list[str]:
    """The split of each frame: "train", "test", or "" if it is in neither list.

    Raises:
        MissingDataError: there is no such file.
        DataError: it is damaged, or names frames that there are not, or one twice.
    """
    found = load_v5(path)
    splits = [""] * frames
    for name, split in (("trainNdxs", "train"), ("testNdxs", "test")):
        numbers = np.atleast_1d(np.asarray(variable(found, name, path))).ravel()
        if numbers.dtype.kind not in "uif" or not np.array_equal(numbers, np.floor(numbers)):
            raise DataError(f"{path}: {name} is not a list of frames")
        for number in numbers.astype(np.int64).tolist():
            if not 1 <= number <= frames:
                raise DataError(f"{path}: {name} names frame {number}, there are {frames}")
            if splits[number - 1]:
                raise DataError(f"{path} names frame {number} twice")
            splits[number - 1] = split
    return splits
