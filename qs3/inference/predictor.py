"""Using a trained classifier: `qs3.load(run)(clouds)`.

    predictor = qs3.load("logs/qs3_s2d/seed0-1a2b3c4d")
    probabilities = predictor([cloud_a, cloud_b])  # [n, 3] each, any n, any size and place, z up
    objects = predictor.predict_depth(depth_m, (fx, fy, cx, cy), mask=mask)  # or box=, up=
    predictor = qs3.load("dgcnn-rooms")  # in_metres, and needs_floor
    probabilities = predictor([cloud_a, cloud_b], floor=0.0)  # z of the floor, in metres
    objects = predictor.predict_depth(depth_m, camera, mask=mask, camera_height=1.2)
    predictor = qs3.load(run, prior="rooms")  # or prior={"chair": 4, "bathtub": 0}

A cloud goes the way of the target's clouds in the run: thinned to as many points as these were
stored with (farthest points from the first one on), or filled up by repeating its points from the
first on; put into the unit ball, or of a net that sees metres only centred, or of one that sees
heights put over the floor; and of it the farthest `points` points. The test clouds of a run get the
probabilities of its predictions.csv; with `evaluation.prior` if `load` is told the same.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.config.checks import check_choice, check_int
from qs3.datamodules.clouds import Clouds
from qs3.datamodules.fps_samples import sample
from qs3.datasets.depth_images import Pinhole
from qs3.datasets.importing import UP_AXES, check_cloud, thinned, turned
from qs3.datasets.pointed import Pointed
from qs3.errors import ConfigError, DataError
from qs3.evaluation.metrics import predict
from qs3.evaluation.ood import measure_one, ood_reasons, other_units, relax_min_points
from qs3.evaluation.prior import POWER, Prior, check_told, read_prior, shares_of
from qs3.evaluation.trust import COMPARED, Known
from qs3.inference.depth_image import DepthPrediction, objects_of
from qs3.inference.floor import (
    camera_is_missing,
    check_camera_height,
    check_floor,
    floor_is_missing,
)
from qs3.inference.given_cloud import given_cloud
from qs3.inference.held_out import known_of
from qs3.inference.model_file import PACKAGES, Result, build_net, read_result
from qs3.utils.allocator import keep_freed_memory
from qs3.utils.plural import counted

log = logging.getLogger(__name__)

BATCH = 32  # clouds: more are no faster on a CPU
DIVERGED = "the classifier's answer is no number: its training has diverged"


class Prepared(NamedTuple):
    """A cloud as the net sees it.

    Attributes:
        points: [m, 3] about the centroid, in the unit ball or in metres; for a net that sees
            heights z is that above the floor.
        given: how many points there were.
        strange: how it differs from the clouds of training, as text; see `qs3.evaluation.ood`.
        measures: `qs3.evaluation.trust.COMPARED` of it.
    """

    points: Float[Tensor, "m 3"]
    given: int
    strange: tuple[str, ...]
    measures: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Predictor:
    """A trained classifier.

    Attributes:
        net: [B, N, 3] to logits [B, C], in eval mode; it wants prepared clouds.
        result: where it comes from, and how its clouds are prepared.
        device: of the net.
        prior: how common classes are where the clouds come from; None: as in training.
        before_target: of a net whose norms follow its target, the net with those of training, which
            `held_out` is of; None: it is `net`.
    """

    net: nn.Module
    result: Result
    device: torch.device
    prior: Prior | None = None
    before_target: nn.Module | None = None

    def __repr__(self) -> str:
        """In a line: net, classes, points, scale, target, device."""
        floor = ", needs floor=" if self.needs_floor and self.camera_height is None else ""
        prior = ", with a prior" if self.prior else ""
        return f"Predictor({self.result.told}{floor}{prior}, on {self.device})"

    @property
    def classes(self) -> tuple[str, ...]:
        """Names in the order of the probabilities."""
        return self.result.classes

    @property
    def points(self) -> int:
        """Points of a cloud as the net sees it."""
        return self.result.points

    @property
    def held_out(self) -> Known | None:
        """What the net that is `asked` says of held-out labelled clouds; None: nobody knows."""
        return known_of(self.result.held_out) if self.result.held_out else None

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

        None: their floor is at or above the origin, so they say nothing about a camera.
        """
        floor = self.result.floor_m
        return -floor if floor is not None and floor < 0 else None

    def prepare(
        self,
        cloud: np.ndarray,
        name: str = "the cloud",
        up: str = "z",
        floor: float | None = None,
    ) -> Prepared:
        """A cloud [n, >= 3] of any n >= 1 as the net sees it.

        Args:
            cloud: x y z in any unit; in metres if the net sees sizes (`in_metres`).
            name: for messages: its file.
            up: the axis that points up in it: x, y, z, -x, -y or -z.
            floor: where the floor is along that axis, in metres: minus the camera's height where
                the camera is the origin. Nets that see heights (`needs_floor`) must be told; None:
                as in their target, if that is a camera's (`camera_height`).

        Raises:
            DataError: no points, NaN or infinite coordinates, or no cloud; says which.
            ConfigError: `up` is no axis; `floor` is no length in metres, or nobody knows it.
        """
        check_choice("up", up, UP_AXES)
        cloud = given_cloud(cloud, name)
        # As the importer of one's own clouds, so that both ways give the same bits.
        points = self.result.stored_points
        stored = turned(check_cloud(thinned(cloud, points), points, name), up)
        stored = np.ascontiguousarray(stored)  # as on disk: sums take another order otherwise
        whole = stored[None]  # [1, P, 3]
        some = self.points < points
        order = sample(whole, self.points, 1) if some else None
        one = Clouds.of(whole, order, self.result.scale, self._floor(floor))
        usual = relax_min_points(self.result.usual, self.points)
        measured = measure_one(one, 0)
        found = ood_reasons(measured, usual)
        compared = tuple(measured[name] for name in COMPARED)
        return Prepared(one.all()[0], len(cloud), tuple(found), compared)

    def _floor(self, given: float | None) -> float:
        if given is None:
            if self.needs_floor and self.camera_height is None:
                raise floor_is_missing()
            return self.result.floor_m or 0.0
        return check_floor(given)

    def probabilities(
        self, points: Float[Tensor, "n m 3"], batch_size: int = BATCH
    ) -> Float[np.ndarray, "n c"]:
        """Class probabilities of prepared clouds, with `prior`; n >= 1."""
        found = self.without_prior(points, batch_size)
        return self.prior(found) if self.prior else found

    def without_prior(
        self, points: Float[Tensor, "n m 3"], batch_size: int = BATCH
    ) -> Float[np.ndarray, "n c"]:
        """The same as the net gives them."""
        return self._said_by(self.net, points, batch_size)

    def asked(
        self, points: Float[Tensor, "n m 3"], batch_size: int = BATCH
    ) -> Float[np.ndarray, "n c"]:
        """The same by the net with the norms it was trained with, for a verdict by `held_out`.

        Norms with the target's statistics make a net surer than it is right.
        """
        return self._said_by(self.before_target or self.net, points, batch_size)

    def _said_by(
        self, net: nn.Module, points: Float[Tensor, "n m 3"], batch_size: int
    ) -> Float[np.ndarray, "n c"]:
        found = predict(net, points, check_int("batch_size", batch_size, 1), self.device)
        if found.shape[1] != len(self.classes):
            raise DataError(
                f"the net tells {found.shape[1]} classes apart, the file names {len(self.classes)}"
            )
        return found

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

        Of clouds that are as large as if they were in other units than the net's metres is warned.

        Args:
            clouds: [N, P, 3], or a list of clouds with different numbers of points; their unit as
                in `prepare`.
            names: theirs, for messages; None counts them from 0.
            up: the axis that points up in them.
            floor: where the floor is in them, in metres, as in `prepare`: 0 if objects stand on
                z = 0. A net that sees heights must be told, "dgcnn-rooms" for one.
            batch_size: clouds that the net sees at a time.

        Raises:
            DataError: no list of clouds, or not as many names; or names the cloud that is empty or
                not finite.
            ConfigError: `up` is no axis; `floor` is needed, as `prepare` says; `batch_size` is no
                number of clouds.
        """
        if clouds is None or isinstance(clouds, str | bytes) or not hasattr(clouds, "__iter__"):
            raise DataError(f"got {clouds!r:.60}; give a list of clouds, [n, 3] arrays")
        if getattr(clouds, "ndim", 3) == 2:
            raise DataError(
                f"got one array of shape {tuple(clouds.shape)}; give a list of clouds, "  # type: ignore[union-attr]
                "predictor([cloud])"
            )
        arrays = list(clouds)
        names = [f"cloud {i}" for i in range(len(arrays))] if names is None else names
        if len(names) != len(arrays):
            raise DataError(
                f"names: {len(names)} of {counted(len(arrays), 'cloud')}; give each its own"
            )
        if not arrays:
            return np.empty((0, len(self.classes)))
        pairs = zip(arrays, names, strict=True)
        ready = [self.prepare(cloud, name, up, floor) for cloud, name in pairs]
        if words := other_units("; ".join(one.strange) for one in ready):
            log.warning("%s: %s", counted(len(ready), "cloud"), words)
        return self.probabilities(torch.stack([one.points for one in ready]), batch_size)

    def predict_depth(
        self,
        depth_m: Float[np.ndarray, "h w"],
        camera: Pinhole | Sequence[float] | np.ndarray,
        *,
        mask: np.ndarray | None = None,
        box: Sequence[float] | None = None,
        up: Sequence[float] | None = None,
        camera_height: float | None = None,
    ) -> list[DepthPrediction]:
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
            camera_height: above the floor, in metres. Nets that see heights must be told; None:
                as in their target, if that is a camera's.

        Returns:
            In the order of the mask's numbers.

        Raises:
            DataError: no depth image, a mask of another size, a box beside the picture,
                intrinsics that cannot be the picture's, or no numbers where these are expected.
            ConfigError: `camera_height` is no height in metres, or nobody knows it.
        """
        if camera_height is None and self.needs_floor and self.camera_height is None:
            raise camera_is_missing()
        floor = None if camera_height is None else -check_camera_height(camera_height)
        found, unsure = objects_of(depth_m, camera, mask=mask, box=box, up=up)
        return [self._of_depth(one, unsure, floor) for one in found]

    def _of_depth(
        self, one: Pointed, unsure: Sequence[str], floor: float | None
    ) -> DepthPrediction:
        points = one.piece.points_m
        cautions = (*(caution.words for caution in one.cautions), *unsure)
        nothing = np.full(len(self.classes), np.nan)
        if one.why:
            said = (*cautions, one.why)
            return DepthPrediction(
                one.name, "", float("nan"), nothing, points, one.tier, said, one.up, ()
            )
        ready = self.prepare(one.cloud(self.result.gravity), one.name, floor=floor)
        (each,) = self.probabilities(ready.points[None])
        if np.isnan(each).any():
            said, strange = (*cautions, DIVERGED), ready.strange
            return DepthPrediction(
                one.name, "", float("nan"), nothing, points, one.tier, said, one.up, strange
            )
        best = int(each.argmax())
        return DepthPrediction(
            one.name,
            self.classes[best],
            float(each[best]),
            each,
            points,
            one.tier,
            cautions,
            one.up,
            ready.strange,
        )


def load(
    run: str | Path,
    *,
    device: str | torch.device = "cpu",
    packages: Sequence[str] = PACKAGES,
    prior: str | Mapping[str, float] | None = None,
    prior_power: float = POWER,
) -> Predictor:
    """The classifier that a finished run reports; also as `qs3.load`.

    On the CPU the process keeps the memory that predictions free from then on, as trainings do
    (`qs3.utils.allocator`): it stays as large as it was at most, and predictions are faster.

    Args:
        run: its folder, or the file result.pt of it, which needs nothing else; or a folder of
            `qs3.inference.model_folder`; or a name of `qs3.inference.pretrained`. One that knows
            heights (`needs_floor`) is called with floor= or camera_height=.
        device: where to run it: "cpu", "cuda", "cuda:1".
        packages: where the net of the file may be defined. For a net of your own add your
            package, if you trust it to be built with any arguments.
        prior: how common classes are where the clouds come from, "rooms" or as {"chair": 4,
            "bathtub": 0}, those not named counting as 1; None: as in training. See
            `qs3.evaluation.prior`.
        prior_power: how much of that is believed; 0 nothing, 1 all.

    Raises:
        MissingDataError: no finished run there.
        DataError: the file is damaged, or asks for something else than a net of `packages`.
        ConfigError: no such device, or no such prior.
    """
    result = read_result(run)
    place = device_of(device)
    if place.type == "cpu":
        keep_freed_memory()
    check_told(prior, prior_power)
    net = build_net(result, packages).to(place)
    before = None
    if result.trained_norms and result.held_out:  # else there is nothing to judge by
        before = build_net(result.before_target, packages).to(place)
    found = Predictor(net, result, place, before_target=before)
    if prior is None:
        return found
    return replace(found, prior=read_prior(prior, found.classes, learnt_of(result), prior_power))


def learnt_of(result: Result) -> Float[np.ndarray, " c"] | None:
    """Shares of the classes in a classifier's training; None where its file says nothing of it."""
    if result.learnt is not None:
        return np.array(result.learnt)
    if result.held_out:  # a file of an older version: those of clouds that were held out
        return shares_of(result.held_out["labels"].numpy(), len(result.classes))
    return None


def device_of(device: Any) -> torch.device:
    """The device, if it works here.

    Raises:
        ConfigError: it does not.
    """
    try:
        place = torch.device(device)
        torch.empty(1, device=place)
    except (RuntimeError, AssertionError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"device={device} cannot be used here ({reason}); try cpu") from error
    return place
