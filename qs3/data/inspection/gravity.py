"""Which axis of a cloud points up, by the shape alone, given the class.

A cloud is described as it would look standing on each of its six sides: what its ten slices
from bottom to top hold. A ridge regression per class learns from shapes that are known to stand
upright which of the six descriptions is the right one. The descriptions do not change when the
object turns about the vertical axis, and half of the shapes to learn from are seen from above
only and noisy, so scans can be judged as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float, Int

from qs3.classes import CLASSES
from qs3.geometry.sampling import surface_sample, unit_ball
from qs3.meshes.catalogue import Catalogue

UPS: tuple[str, ...] = ("+z", "-z", "+x", "-x", "+y", "-y")
"""The directions that may point up, in the order of all arrays here."""

_SLICES = 10
_POINTS = 512  # of a cloud that are looked at
_JUDGED = 100  # clouds a class
_SHAPES = 40  # of the catalogue a class, to learn from
_RIDGE = 100.0
_SURE_SHARE = 0.6  # of the clouds that prefer the best direction to the second best
_SURE_SD = 3.0  # standard errors between their mean scores


@dataclass(frozen=True)
class Verdict:
    """Which way is up in the clouds of one class.

    Attributes:
        cls: class name.
        clouds: how many were looked at.
        up: direction with the best mean score, one of `UPS`.
        axis_share: share of the clouds whose best direction lies along the axis of `up`.
        sign_share: share of the clouds that prefer `up` to its opposite.
        axis_sure: the axis is told from the other two by most clouds and beyond chance.
        sign_sure: the same of the sign; a bookshelf looks alike upside down.
    """

    cls: str
    clouds: int
    up: str
    axis_share: float
    sign_share: float
    axis_sure: bool
    sign_sure: bool

    def contradicts(self) -> bool:
        """Whether the evidence is clear and against +z."""
        return self.axis_sure and (self.up[1] != "z" or (self.sign_sure and self.up == "-z"))


@dataclass(frozen=True, eq=False)
class UpModel:
    """What upright objects look like, by class: mean, scale [F] of descriptions; weights [2F]."""

    mean: Mapping[str, np.ndarray]
    scale: Mapping[str, np.ndarray]
    weights: Mapping[str, np.ndarray]

    @staticmethod
    def fit(upright: Mapping[str, Float[np.ndarray, "n p 3"]]) -> UpModel:
        """Learn from clouds [n, P, 3] of each class that stand upright on z, any unit."""
        mean, scale, weights = {}, {}, {}
        for cls, clouds in upright.items():
            described = describe(clouds)  # [n, 6, F]
            mean[cls] = described.mean(axis=(0, 1))
            scale[cls] = described.std(axis=(0, 1)) + 1e-3
            x = _features(described, mean[cls], scale[cls])
            x = (x - x.mean(axis=1, keepdims=True)).reshape(-1, x.shape[-1])
            y = np.tile(np.eye(6)[0] - 1 / 6, len(clouds))
            ridge = _RIDGE * len(clouds) / 192  # as strong for few clouds as for many
            weights[cls] = np.linalg.solve(x.T @ x + ridge * np.eye(x.shape[1]), x.T @ y)
        return UpModel(mean, scale, weights)

    def scores(self, clouds: Float[np.ndarray, "n p 3"], cls: str) -> Float[np.ndarray, "n 6"]:
        """How well each direction of `UPS` does as "up"; the mean over the six is 0."""
        x = _features(describe(clouds), self.mean[cls], self.scale[cls])
        score = x @ self.weights[cls]
        return score - score.mean(axis=1, keepdims=True)

    def judge(self, clouds: Float[np.ndarray, "n p 3"], cls: str) -> Verdict:
        """Which way is up in clouds [n, P, 3] of one class; one direction for all of them."""
        score = self.scores(clouds, cls)
        best = int(score.mean(axis=0).argmax())
        along = score.reshape(-1, 3, 2).max(axis=2)  # [n, 3 axes]
        axis = best // 2
        rival = max((a for a in range(3) if a != axis), key=lambda a: along[:, a].mean())
        sign_share, sign_sure = _prefers(score[:, best] - score[:, best ^ 1])
        return Verdict(
            cls=cls,
            clouds=len(score),
            up=UPS[best],
            axis_share=float((score.argmax(axis=1) // 2 == axis).mean()),
            sign_share=sign_share,
            axis_sure=_prefers(along[:, axis] - along[:, rival])[1],
            sign_sure=sign_sure,
        )


def judge_set(
    points: Float[np.ndarray, "n p 3"],
    labels: Int[np.ndarray, " n"],
    classes: Sequence[str],
    model: UpModel | None = None,
    seed: int = 0,
) -> list[Verdict]:
    """A verdict for each class that occurs and that the model knows.

    Labels are positions in `classes`; negative ones are passed over. The model is that of the
    embedded catalogue unless given; `seed` draws a hundred clouds of a class, if there are more.
    """
    model = model or catalogue_model()
    verdicts = []
    for label, cls in enumerate(classes):
        members = np.flatnonzero(labels == label)
        if cls not in model.weights or len(members) == 0:
            continue
        rng = np.random.default_rng([seed, label])
        chosen = np.sort(rng.permutation(members)[:_JUDGED])
        verdicts.append(model.judge(np.stack([points[i] for i in chosen]), cls))
    return verdicts


@cache
def catalogue_model() -> UpModel:
    """The model of the embedded catalogue: whole surfaces, and scans from above, with noise."""
    return UpModel.fit({cls: upright_examples(cls, _SHAPES) for cls in CLASSES})


def upright_examples(cls: str, shapes: int, seed: int = 7) -> Float[np.ndarray, "n 512 3"]:
    """Clouds of the catalogue's objects of a class, z up: four of each shape, two of them scans."""
    rng = np.random.default_rng([seed, CLASSES.index(cls)])
    catalogue = Catalogue(seed=seed, train=shapes, test=0, classes=(cls,), families="all")
    clouds = []
    for item in catalogue.items():
        mesh = item.load()
        for kind in range(4):
            cloud = surface_sample(mesh.vertices, mesh.faces, 4 * _POINTS, rng)
            cloud = turned(
                cloud * rng.uniform(0.8, 1.25, 3), rng.uniform(0, 2 * np.pi) * (kind % 2)
            )
            if kind >= 2:
                cloud = seen_from_above(cloud, rng)
                cloud = cloud + rng.normal(0, 0.01 * np.ptp(cloud, axis=0).max(), cloud.shape)
            few = len(cloud) < _POINTS
            picked = rng.integers(0, len(cloud), _POINTS) if few else rng.permutation(len(cloud))
            clouds.append(cloud[picked[:_POINTS]])
    return np.stack(clouds)


def turned(cloud: Float[np.ndarray, "*b 3"], yaw_rad: float) -> Float[np.ndarray, "*b 3"]:
    """The cloud turned about z."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return cloud @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], dtype=cloud.dtype)


def seen_from_above(
    cloud: Float[np.ndarray, "p 3"], rng: np.random.Generator
) -> Float[np.ndarray, "m 3"]:
    """The points that are in front in one of four views, 15 to 45 degrees above the horizon."""
    cells, views = 50, 4
    centred = cloud - cloud.mean(axis=0)
    size = max(float(np.abs(centred).max()), 1e-12)
    kept = np.zeros(len(cloud), dtype=bool)
    first, arc = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 2.6)
    for view in range(views):
        azimuth = first + arc * view / (views - 1)
        elevation = np.deg2rad(rng.uniform(15, 45))
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
        away = np.array([np.cos(azimuth), np.sin(azimuth), 0]) * np.cos(elevation)
        towards = away + np.array([0, 0, np.sin(elevation)])
        picture = centred @ np.stack([right, np.cross(towards, right)], axis=1) / size
        column, row = ((picture + 1.8) / 3.6 * cells).astype(int).T  # corners lie at sqrt(3)
        nearness = centred @ towards / size
        front = np.full(cells * cells, -np.inf)
        np.maximum.at(front, row * cells + column, nearness)
        kept |= nearness > front[row * cells + column] - 0.07
    return cloud[kept]


def describe(clouds: Float[np.ndarray, "n p 3"]) -> Float[np.ndarray, "n 6 f"]:
    """What the slices of each cloud hold, for each direction of `UPS` as "up".

    Of each of ten slices of equal height: the share of points (square root), their mean
    distance from the vertical axis, their spread along and across (standard deviations), how far
    their centre is off the axis; and of the whole the height and the two sides of the base. In
    units of the unit ball; at most 512 points of a cloud are taken, evenly.
    """
    step = max(1, clouds.shape[1] // _POINTS)
    clouds = unit_ball(np.asarray(clouds, dtype=np.float64)[:, ::step][:, :_POINTS])
    n, points, _ = clouds.shape
    found = []
    for up in UPS:
        axis = "xyz".index(up[1])
        sign = 1 if up[0] == "+" else -1
        height = sign * clouds[..., axis]
        base = np.delete(clouds, axis, axis=2)
        low, high = base.min(axis=1, keepdims=True), base.max(axis=1, keepdims=True)
        base = base - (low + high) / 2
        floor = height.min(axis=1, keepdims=True)
        tall = np.maximum(height.max(axis=1, keepdims=True) - floor, 1e-9)
        slices = np.minimum(((height - floor) / tall * _SLICES).astype(int), _SLICES - 1)
        cell = (np.arange(n)[:, None] * _SLICES + slices).ravel()
        count = np.bincount(cell, minlength=n * _SLICES).reshape(n, _SLICES)

        u, v = base[..., 0], base[..., 1]
        mean_u, mean_v, uu, vv, uv = (
            _slice_mean(cell, count, values) for values in (u, v, u * u, v * v, u * v)
        )
        uu, vv, uv = uu - mean_u**2, vv - mean_v**2, uv - mean_u * mean_v
        middle, spread = (uu + vv) / 2, np.sqrt(((uu - vv) / 2) ** 2 + uv**2)
        parts = (
            np.sqrt(count / points),
            _slice_mean(cell, count, np.hypot(u, v)),
            np.sqrt(np.maximum(middle + spread, 0)),
            np.sqrt(np.maximum(middle - spread, 0)),
            np.hypot(mean_u, mean_v),
            tall,
            np.sort((high - low)[:, 0], axis=1),
        )
        found.append(np.concatenate(parts, axis=1))
    return np.stack(found, axis=1)


def _slice_mean(cell: np.ndarray, count: np.ndarray, values: np.ndarray) -> np.ndarray:
    """[n, slices] mean of values [n, P] by slice; 0 in an empty one."""
    total = np.bincount(cell, values.ravel(), minlength=count.size).reshape(count.shape)
    return total / np.maximum(count, 1)


def _features(described: np.ndarray, mean: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """[..., 2 F] standardised, clipped, and their squares."""
    x = np.clip((described - mean) / scale, -4, 4)
    return np.concatenate([x, x**2 - 1], axis=-1)


def _prefers(difference: np.ndarray) -> tuple[float, bool]:
    """Share of positive differences, and whether most are and their mean is beyond chance."""
    share = float((difference > 0).mean())
    error = float(difference.std()) / np.sqrt(max(len(difference) - 1, 1))
    sure = share >= _SURE_SHARE and float(difference.mean()) > _SURE_SD * error
    return share, bool(sure)
