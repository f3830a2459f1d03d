"""Using a trained classifier: `qs3.load(run)(clouds)`, which is `load` here.

A cloud goes the way of the target's clouds in the run: it is brought to as many points as these
were stored with (`resample`); put into the unit ball, or of a net that sees metres only centred, or
of one that sees heights put over the floor, or also turned as its camera saw it; and of it the
farthest `points` points are taken. The test clouds of a run get the probabilities of its
predictions.csv; with `evaluation.prior` if `load` gets the same.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.datamodules.augment import rotate_z
from qs3.datamodules.clouds import Clouds
from qs3.datamodules.fps_samples import sample
from qs3.datasets.clouds import check_shape, checked
from qs3.datasets.depth_images import Intrinsics, Pinhole, camera_of
from qs3.datasets.importing import check_cloud, thinned, turned
from qs3.errors import ConfigError, DataError
from qs3.evaluation.metrics import predict
from qs3.evaluation.ood import measure_one, ood_reasons, other_units, relax_min_points
from qs3.evaluation.prior import POWER, Prior, read_prior
from qs3.inference.inputs import Sample, pointed
from qs3.inference.model_file import PACKAGES, Result, build_net, read_result
from qs3.utils.processor import keep_freed_memory

log = logging.getLogger(__name__)

BATCH = 32  # clouds: more are no faster on a CPU
DIVERGED = "the classifier's answer is not a number: its training has diverged"
_SIDES = 8
HIGHEST_M = 30.0
"""Limit on heights in metres: a floor or a camera beyond it is in another unit."""


class Prepared(NamedTuple):
    """A cloud as the net sees it.

    Attributes:
        points: [m, 3] about the centroid, in the unit ball or in metres; for a net that sees
            heights z is that above the floor.
        strange: how it differs from the clouds of training, as text; see `qs3.evaluation.ood`.
    """

    points: Float[Tensor, "m 3"]
    strange: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Predictor:
    """A trained classifier.

    Attributes:
        net: [B, N, 3] to logits [B, C], in eval mode; it wants prepared clouds.
        result: where it comes from, and how its clouds are prepared.
        device: of the net.
        prior: how common classes are where the clouds come from; None: as in training.
    """

    net: nn.Module
    result: Result
    device: torch.device
    prior: Prior | None = None

    def __repr__(self) -> str:
        """In a line: net, classes, points, scale, target, device."""
        prior = ", with a prior" if self.prior else ""
        return f"Predictor({self.result}{prior}, on {self.device})"

    @property
    def classes(self) -> tuple[str, ...]:
        """Names in the order of the probabilities."""
        return self.result.classes

    @property
    def points(self) -> int:
        """Points of a cloud as the net sees it."""
        return self.result.points

    @property
    def in_metres(self) -> bool:
        """Whether it sees how large clouds are: then they must be in metres."""
        return self.result.scale != "unit_ball"

    @property
    def needs_floor(self) -> bool:
        """Whether it sees how high above the floor clouds are: then it must know where that is."""
        return self.result.floor_m is not None

    @property
    def camera_height(self) -> float | None:
        """Height of the target's camera above the floor, in metres, if it is its clouds' origin.

        None: their floor is at or above the origin, so they do not show a camera's height.
        """
        floor = self.result.floor_m
        return -floor if floor is not None and floor < 0 else None

    def prepare(
        self, cloud: Any, name: str = "the cloud", up: str = "z", floor: float | None = None
    ) -> Prepared:
        """A cloud [n, >= 3] of any n >= 1 as the net sees it.

        Args:
            cloud: x y z in any unit; in metres if the net sees sizes (`in_metres`).
            name: for messages: its file.
            up: the axis that points up in it: x, y, z, -x, -y or -z.
            floor: where the floor is along that axis, in metres: minus the camera's height where
                the camera is the origin. Nets that see heights (`needs_floor`) need it; None:
                as in their target, if that is a camera's (`camera_height`).
        """
        floor = self.floor(floor)
        stored = resample(_given(cloud, name), self.result.stored_points, up)
        whole = stored[None]  # [1, P, 3]
        order = sample(whole, self.points, 1) if self.points < len(stored) else None
        one = Clouds.of(whole, order, self.result.scale, floor)
        usual = relax_min_points(self.result.usual, self.points)
        return Prepared(one.points[0], tuple(ood_reasons(measure_one(one, 0), usual)))

    def floor(self, given: float | None) -> float:
        """Where the floor is in clouds: as given, else as in the target; ConfigError as above."""
        if given is None and self.needs_floor and self.camera_height is None:
            raise ConfigError(
                "the classifier knows heights above the floor: give floor=Z, 0 if objects stand on "
                "z = 0, or camera_height=METRES where the camera is the origin"
            )
        if given is not None and not abs(given) < HIGHEST_M:
            raise ConfigError(f"floor={given:g} is not where a floor is in metres")
        return (self.result.floor_m or 0.0) if given is None else given

    def probabilities(
        self,
        points: Float[Tensor, "n m 3"],
        batch_size: int = BATCH,
        floor: float | None = None,
    ) -> Float[np.ndarray, "n c"]:
        """Class probabilities of prepared clouds, with `prior`; n >= 1. `floor` as in `prepare`."""
        # Where the origin cannot be the camera, averaged over all sides.
        sides = _SIDES if self.result.scale == "seen" and self.floor(floor) >= 0 else 1
        found = []
        for k in range(sides):
            turned = rotate_z(points, torch.full((len(points),), 2 * torch.pi * k / sides))
            found.append(predict(self.net, turned if k else points, batch_size, self.device))
        mean = np.mean(found, axis=0)
        return self.prior(mean) if self.prior else mean

    def __call__(
        self,
        clouds: Float[np.ndarray, "n p 3"] | Float[Tensor, "n p 3"] | Sequence[np.ndarray],
        *,
        names: Sequence[str] | None = None,
        up: str = "z",
        floor: float | None = None,
        batch_size: int = BATCH,
    ) -> Float[np.ndarray, "n c"]:
        """Class probabilities of clouds, float64, a row a cloud; NaN if its training has diverged.

        Warns of clouds that are too large for the net's metres.

        Args:
            clouds: [N, P, 3], or a list of clouds with different numbers of points.
            names: theirs, for messages; None counts them from 0.
            up, floor: as in `prepare`, of all of them. "dgcnn-rooms" needs the floor.
            batch_size: clouds that the net sees at a time.

        Raises:
            DataError: names the cloud that is empty or not finite.
            ConfigError: `floor` is needed.
        """
        arrays = list(clouds)
        if not arrays:
            return np.empty((0, len(self.classes)))
        names = [f"cloud {i}" for i in range(len(arrays))] if names is None else names
        pairs = zip(arrays, names, strict=True)
        ready = [self.prepare(cloud, name, up, floor) for cloud, name in pairs]
        if words := other_units("; ".join(one.strange) for one in ready):
            log.warning("of %d clouds %s", len(ready), words)
        return self.probabilities(torch.stack([one.points for one in ready]), batch_size, floor)

    def predict(self, samples: Sequence[Sample], floor: float | None = None) -> None:
        """Fill in what the net makes of samples, in one batch; `floor` as in `prepare`.

        One whose cloud cannot be used becomes one that failed.
        """
        ready: list[tuple[Sample, Tensor]] = []
        for one in samples:
            if one.cloud is None:
                continue
            try:
                points, strange = self.prepare(one.cloud, one.name, one.axis, floor)
            except DataError as error:
                one.failed(error, one.name)
                continue
            one.reason = "; ".join(strange)
            ready.append((one, points))
        if not ready:
            return
        stacked = torch.stack([points for _, points in ready])
        found = self.probabilities(stacked, len(ready), floor)
        for (one, _), each in zip(ready, found, strict=True):
            if np.isnan(each).any():
                one.failed(DIVERGED)
                continue
            one.probabilities = each
            one.cls = self.classes[int(each.argmax())]

    def predict_depth(
        self,
        depth_m: Float[np.ndarray, "h w"],
        camera: Pinhole | Sequence[float] | np.ndarray,
        *,
        mask: np.ndarray | None = None,
        box: Sequence[float] | None = None,
        up: Sequence[float] | None = None,
        camera_height: float | None = None,
    ) -> list[Sample]:
        """The classes of the objects of a mask, one a number, or of what lies in a box.

        Args:
            depth_m: [h, w] floats, metres along the optical axis; 0, not finite or masked: not
                measured.
            camera: fx, fy, cx, cy in pixels, the centre of the top left one at (0, 0); or the
                matrix [3, 3] of these.
            mask: [h, w] whole numbers or bool; 0 is background. Or:
            box: left, top, right, bottom in pixels.
            up: in the camera's frame (x right, y down, z forward), any length; None: by the planes
                of the picture, and where it shows none, up in the picture.
            camera_height: above the floor, in metres. Nets that see heights need it; None: as in
                their target, if that is a camera's.

        Returns:
            In the order of the mask's numbers: `cls`, `confidence`, `cautions`, `upright`, ...

        Raises:
            DataError: not a depth image, a mask of another size, a box outside of the picture, or
                intrinsics that cannot be the picture's.
            ConfigError: `camera_height` is needed, or is not in metres.
        """
        floor = self.floor(None if camera_height is None else -camera_height)
        depth = _filled(depth_m)
        if not isinstance(camera, Pinhole):
            camera = camera_of([float(value) for value in np.ravel(camera)], "camera")
        mask = None if mask is None else _filled(mask)
        given = Intrinsics(camera)
        found = list(pointed("", depth, given, mask, box, up, self.result.gravity))
        self.predict(found, floor)
        return found


def load(
    run: str | Path,
    *,
    device: str | torch.device = "cpu",
    packages: Sequence[str] = PACKAGES,
    prior: str | Mapping[str, float] | None = None,
    prior_power: float = POWER,
) -> Predictor:
    """The classifier that a finished run reports.

        predictor = qs3.load("logs/qs3_s2d/seed0-1a2b3c4d")
        probabilities = predictor([cloud_a, cloud_b])  # [2, classes] float64
        predictor.classes  # their names, in that order
        found = predictor.predict_depth(depth_m, (fx, fy, cx, cy), mask=mask)  # or box=, up=

    A cloud is an [n, 3] array of x y z with any n, any size and place, z up (or `up=`). One that
    knows sizes and heights, as "dgcnn-rooms" (`predictor.needs_floor`), takes metres and needs the
    floor: `predictor(clouds, floor=0.0)`, `predictor.predict_depth(..., camera_height=1.2)`.

    On the CPU the process keeps the memory that predictions free from then on
    (`qs3.utils.processor.keep_freed_memory`): it stays as large as it was at most.

    Args:
        run: its folder, or the file result.pt of it, which needs nothing next to it; or a folder
            that `qs3 export out=FOLDER` wrote; or the name of a classifier that comes with qs3,
            "dgcnn-speckle".
        device: where to run it: "cpu", "cuda", "cuda:1".
        packages: where the net of the file may be defined. For a net of your own add your
            package, if you trust it to be built with any arguments.
        prior: how common classes are where the clouds come from: "rooms", as in ScanNet's, or
            {"chair": 4, "bathtub": 0}, where those not named count as 1; None: as in training.
        prior_power: how much of that is believed: 0 nothing, 1 all (`qs3.evaluation.prior`).

    Raises:
        MissingDataError: no finished run there.
        DataError: the file is damaged, or asks for something else than a net of `packages`.
        ConfigError: no such prior.
    """
    result = read_result(run)
    place = torch.device(device)
    if place.type == "cpu":
        keep_freed_memory()
    net = build_net(result, packages).to(place)
    given = None
    if prior is not None:
        given = read_prior(prior, result.classes, result.shares, prior_power)
    return Predictor(net, result, place, given)


def resample(
    cloud: Float[np.ndarray, "n 3"], points: int, up: str = "z"
) -> Float[np.ndarray, "points 3"]:
    """A cloud as the store has it: float32 [points, 3] with z up, of one with the axis `up` up.

    Of more points the farthest from the first one on are kept; fewer are repeated from the first
    one on.
    """
    found = turned(check_cloud(thinned(cloud, points), points, "the cloud"), up)
    return np.ascontiguousarray(found)  # as on disk: sums take another order otherwise


def _given(cloud: Any, name: str) -> Float[np.ndarray, "n 3"]:
    """The x y z of an array, tensor or nested list [n, >= 3] of numbers, as float32.

    Refuses several points that are (0, 0, 0): depth cameras write them where they measured nothing.
    """
    found = np.ma.asanyarray(cloud.detach().cpu() if isinstance(cloud, Tensor) else cloud)
    if found.ndim != 2 or found.shape[1] < 3 or found.dtype.kind not in "fiu":
        raise DataError(f"{name}: {found.dtype} {found.shape}, expected numbers [n, 3]")
    check_shape(name, found.shape)
    hidden = int(np.ma.getmaskarray(found)[:, :3].any(axis=1).sum())
    found = np.asarray(found)[:, :3]
    zeros = int((found == 0).all(axis=1).sum())
    if hidden or zeros > 1:  # one may be a shape's own
        raise DataError(f"{name}: {hidden or zeros} points are masked or (0, 0, 0); leave them out")
    return checked(found, name)


def _filled(image: Any) -> np.ndarray:
    """The values, 0 for those that a masked array hides."""
    return np.asarray(image.filled(0) if isinstance(image, np.ma.MaskedArray) else image)
