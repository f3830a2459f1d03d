"""Which axis of a cloud points up, by the shape alone, given the class.

A cloud is described as it would look standing on each of its six sides: what its ten slices
from bottom to top hold. A ridge regression per class learns from shapes that are known to stand
upright which of the six descriptions is the right one. The descriptions do not change when the
object turns about the vertical axis, and half of the shapes to learn from are seen from above
only and noisy, so scans can be judged as well. Single views, of which whole sides are missing, have
a model of their own. What was learnt from the embedded catalogue lies beside this file;
`tests/fixtures/upright.py` made it.

Objects that lie and were then turned about z, each by its own angle, as meshes with y up are when
they are scanned as they stand, have no axis in common that could be found. So each cloud is also
asked whether it would look better on its side, whichever that is. Of a single view that says
nothing: half a chair does look better on one of sixteen sides. So single views are judged by the
axis that they have in common alone.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from qs3.geometry.sampling import unit_ball

UPS: tuple[str, ...] = ("+z", "-z", "+x", "-x", "+y", "-y")
"""The directions that may point up, in the order of all arrays here."""

POINTS = 512
"""How many points of a cloud are looked at."""

LEARNT = Path(__file__).with_name("gravity.json")
"""The model of the embedded catalogue."""

LEARNT_VIEWS = Path(__file__).with_name("gravity_views.json")
"""The same of single views."""

_PARTS = ("mean", "scale", "weights")
_SLICES = 10
_JUDGED = 100  # clouds a class
_RIDGE = 100.0
_SURE_SHARE = 0.6  # of the clouds that prefer the best direction to the second best
_SURE_SD = 3.0  # standard errors between their mean scores
_LEAST_SD = 0.3  # of a score's difference within a class, where few clouds happen to agree
_YAWS_RAD = np.arange(4) * np.pi / 8  # with four sides each: a side every 22.5 degrees


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
        on_z_share: share of the clouds that look better on z, either way round, than on any side;
            None for single views.
        stands: most clouds do, and beyond chance; of single views, their common axis is z.
        lies: most clouds look better on one of their sides, and beyond chance; each may have
            another one. Not found of single views.
    """

    cls: str
    clouds: int
    up: str
    axis_share: float
    sign_share: float
    axis_sure: bool
    sign_sure: bool
    on_z_share: float | None
    stands: bool
    lies: bool

    def contradicts(self) -> bool:
        """Whether the evidence is clear and against +z."""
        upside_down = self.sign_sure and self.up == "-z"
        return self.lies or (self.axis_sure and (self.up[1] != "z" or upside_down))

    def confirms(self) -> bool:
        """Whether the evidence is clear and for the axis z; then the sign is not against it."""
        return self.stands and self.axis_sure and not self.contradicts()


@dataclass(frozen=True, eq=False)
class UpModel:
    """What upright objects look like, by class: mean, scale [F] of descriptions; weights [2F].

    With `views` they are single views, and only their common axis is judged.
    """

    mean: Mapping[str, np.ndarray]
    scale: Mapping[str, np.ndarray]
    weights: Mapping[str, np.ndarray]
    views: bool = False

    @staticmethod
    def fit(upright: Mapping[str, Float[np.ndarray, "n p 3"]], views: bool = False) -> UpModel:
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
        return UpModel(mean, scale, weights, views)

    def scores(self, clouds: Float[np.ndarray, "n p 3"], cls: str) -> Float[np.ndarray, "n 6"]:
        """How well each direction of `UPS` does as "up"; the mean over the six is 0."""
        score = self._raw(clouds, cls)
        return score - score.mean(axis=1, keepdims=True)

    def on_z(self, clouds: Float[np.ndarray, "n p 3"], cls: str) -> Float[np.ndarray, " n"]:
        """How much better a cloud looks on z, either way round, than on the best of 16 sides."""
        turns = np.stack([self._raw(turned(clouds, yaw), cls) for yaw in _YAWS_RAD], axis=1)
        upright = turns[..., :2].mean(axis=1).max(axis=1)  # z does not turn: one score, with noise
        return upright - turns[..., 2:].max(axis=(1, 2))

    def _raw(self, clouds: np.ndarray, cls: str) -> np.ndarray:
        """[n, 6] scores, comparable within a cloud and its turned copies."""
        return _features(describe(clouds), self.mean[cls], self.scale[cls]) @ self.weights[cls]

    def judge(self, clouds: Float[np.ndarray, "n p 3"], cls: str) -> Verdict:
        """Which way is up in clouds [n, P, 3] of one class; one direction for all of them."""
        score = self.scores(clouds, cls)
        best = int(score.mean(axis=0).argmax())
        along = score.reshape(-1, 3, 2).max(axis=2)  # [n, 3 axes]
        axis = best // 2
        rival = max((a for a in range(3) if a != axis), key=lambda a: along[:, a].mean())
        axis_sure = prefers(along[:, axis] - along[:, rival])[1]
        sign_share, sign_sure = prefers(score[:, best] - score[:, best ^ 1])
        on_z_share, stands, lies = None, axis_sure and axis == UPS.index("+z") // 2, False
        if not self.views:
            on_z = self.on_z(clouds, cls)
            (on_z_share, stands), lies = prefers(on_z), prefers(-on_z)[1]
        return Verdict(
            cls=cls,
            clouds=len(score),
            up=UPS[best],
            axis_share=float((score.argmax(axis=1) // 2 == axis).mean()),
            sign_share=sign_share,
            axis_sure=axis_sure,
            sign_sure=sign_sure,
            on_z_share=on_z_share,
            stands=stands,
            lies=lies,
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
    embedded catalogue's whole and fused clouds unless given; `seed` draws a hundred clouds of a
    class, if there are more.
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
def catalogue_model(views: bool = False) -> UpModel:
    """The model of the embedded catalogue, as `tests/fixtures/upright.py` learnt it."""
    found = json.loads((LEARNT_VIEWS if views else LEARNT).read_text())
    parts = {part: {cls: np.array(of[part]) for cls, of in found.items()} for part in _PARTS}
    return UpModel(**parts, views=views)


def turned(cloud: Float[np.ndarray, "*b 3"], yaw_rad: float) -> Float[np.ndarray, "*b 3"]:
    """The cloud turned about z."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return cloud @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], dtype=cloud.dtype)


def describe(clouds: Float[np.ndarray, "n p 3"]) -> Float[np.ndarray, "n 6 f"]:
    """What the slices of each cloud hold, for each direction of `UPS` as "up".

    Of each of ten slices of equal height: the share of points (square root), their mean
    distance from the vertical axis, their spread along and across (standard deviations), how far
    their centre is off the axis; and of the whole the height and the two sides of the base. In
    units of the unit ball; at most 512 points of a cloud are taken, evenly.
    """
    step = max(1, clouds.shape[1] // POINTS)
    clouds = unit_ball(np.asarray(clouds, dtype=np.float64)[:, ::step][:, :POINTS])
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


def prefers(difference: Float[np.ndarray, " n"]) -> tuple[float, bool]:
    """Share of positive differences of scores, and whether most are, beyond chance."""
    share = float((difference > 0).mean())
    error = max(float(difference.std()), _LEAST_SD) / np.sqrt(len(difference))
    sure = share >= _SURE_SHARE and float(difference.mean()) > _SURE_SD * error
    return share, bool(sure)
