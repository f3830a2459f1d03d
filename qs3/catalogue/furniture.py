"""What all families share: their random choices, legs, bent tubes, curved backs, upholstery."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from qs3.catalogue import parts as p
from qs3.meshes.mesh import Mesh

T = TypeVar("T")
CORNERS = ((-1, -1), (-1, 1), (1, -1), (1, 1))


class Draw:
    """A stream of choices that depends on nothing but `key`.

    The key is hashed with SHA-256 (Python's own `hash` differs from process to process), so
    "0/chair/train/7" gives the same chair everywhere, however many objects are asked for.
    """

    def __init__(self, key: str) -> None:
        digest = hashlib.sha256(key.encode()).digest()
        self._rng = np.random.default_rng(int.from_bytes(digest, "little"))

    def between(self, low: float, high: float) -> float:
        """Uniform in [low, high)."""
        return float(self._rng.uniform(low, high))

    def count(self, low: int, high: int) -> int:
        """Uniform integer in [low, high], both included."""
        return int(self._rng.integers(low, high + 1))

    def chance(self, probability: float) -> bool:
        """True with the given probability."""
        return bool(self._rng.random() < probability)

    def pick(self, *options: T) -> T:
        """One of the options, all equally likely."""
        return options[int(self._rng.integers(len(options)))]


Build = Callable[[Draw], list[Mesh]]


@dataclass(frozen=True)
class Family:
    """Objects of one construction, e.g. chairs on a swivel base."""

    name: str  # unique within its class
    split: str  # the only one that draws from it
    build: Build  # makes the parts of one object, front along -y


def families_of(train: tuple[Build, ...], test: tuple[Build, ...]) -> tuple[Family, ...]:
    """The families of a class, named after their functions."""
    split = [("train", build) for build in train] + [("test", build) for build in test]
    return tuple(Family(build.__name__, where, build) for where, build in split)


def both_sides(mesh: Mesh) -> list[Mesh]:
    """A part and its mirror image across the plane x = 0."""
    return [mesh, p.mirrored(mesh)]


def post(
    path: Sequence[p.Vector], section: np.ndarray, scale: Sequence[float] | None = None
) -> Mesh:
    """A leg whose cross-sections stay level, so that it stands flat on the floor.

    `section` is an outline [N, 2]; `path` leads from bottom to top, `scale` is one for each of its
    points.
    """
    factors = [1.0] * len(path) if scale is None else scale
    pairs = zip(path, factors, strict=True)
    return p.loft(np.stack([p.ring_at(section * f, 0.0) + np.asarray(at) for at, f in pairs]))


def four_legs(
    width: float,
    depth: float,
    height: float,
    section: np.ndarray,
    *,
    splay: float = 0.0,
    foot: float = 1.0,
) -> list[Mesh]:
    """Straight legs at the corners of width x depth (between centres, at the upper end).

    `section` is their outline [N, 2] at the upper end, `foot` its scale at the floor; each foot
    stands out by `splay` along x and along y.
    """
    legs = []
    for sx, sy in CORNERS:
        top = np.array([sx * width / 2, sy * depth / 2, height])
        out = np.array([sx * splay, sy * splay, -height])
        legs.append(post([top + out, top], section, [foot, 1.0]))
    return legs


def leg_section(is_round: bool, size: float) -> np.ndarray:
    """Outline of a leg: round or square, `size` across."""
    return p.ellipse(size, size, 12) if is_round else p.rectangle(size, size)


def bent(points: Sequence[p.Vector], radius: float, steps: int = 5) -> np.ndarray:
    """[K, 3] a polyline with its inner corners rounded, as a bent tube's axis."""
    corners = np.asarray(points, dtype=np.float64)
    path = [corners[:1]]
    for before, corner, after in zip(corners[:-2], corners[1:-1], corners[2:], strict=True):
        to_before, to_after = before - corner, after - corner
        lengths = np.linalg.norm(to_before), np.linalg.norm(to_after)
        cut = min(radius, 0.49 * float(min(lengths)))
        begin = corner + cut * to_before / lengths[0]
        end = corner + cut * to_after / lengths[1]
        path.append(p.arc(begin, corner, end, steps))
    return np.concatenate([*path, corners[-1:]])


def curved_panel(
    size: p.Vector, at: p.Vector, *, bow: float = 0.0, rake: float = 0.0, radius: float = 0.008
) -> Mesh:
    """An upright panel of (width, thickness, height), hollow towards -y by `bow` metres.

    `at` is the middle of its lower edge at the two ends; it leans back by `rake` degrees.
    """
    width, thickness, height = (float(s) for s in size)
    half = height / 2
    path = p.arc((-width / 2, 0, half), (0, 2 * bow, half), (width / 2, 0, half), 10)
    section = p.rounded_rectangle(thickness, height, radius, 2)
    return p.move(p.turn(p.sweep(section, path), -rake, "x"), at)


def back_cushion(
    size: p.Vector, at: p.Vector, *, rake: float = 10.0, crown: float = 0.03, radius: float = 0.04
) -> Mesh:
    """A filled cushion of (width, thickness, height) leaning back, its crown to the front.

    `at` is the middle of the lower edge of its rear face.
    """
    width, thickness, height = (float(s) for s in size)
    lying = p.rounded_box((width, height, thickness), (0, 0, 0), radius, crown)
    upright = p.move(p.turn(lying, 90, "x"), (0, 0, height / 2))
    return p.move(p.turn(upright, -rake, "x"), at)
