"""Furnished rooms: things with a class where people put them, among things without one.

A thing stands with its back to a wall, anywhere on the floor, drawn up to a table, or on top of
other furniture, or it hangs on a wall. Tables, chairs, chests, boxes and cylinders without a class
are where things of a class need or hide behind them.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import cv2
import numpy as np
from annotated_types import Ge
from jaxtyping import Float

from qs3.generation.scenes import HAIR_M, prism, rectangle, ring_of, table
from qs3.geometry.sampling import surface_sample
from qs3.meshes.mesh import Mesh, MeshItem, merge
from qs3.meshes.placement import RealSize
from qs3.utils.settings import Positive, Share, settings

_FLOOR_CELL_M = 0.05  # of the map of the floor
_TOP_CELL_M = 0.04  # of the map of furniture from above
_SAMPLES = 20_000
_FLAT_M = 0.03
"""Under a thing the surface differs by no more than this: a board or a mattress, no pillows."""
_CHAIR_M = (0.38, 0.55)
_SEAT_M = (0.42, 0.5)
_BACK_M = (0.75, 1.05)
"""Chairs that only hide things: width and depth, height of the seat and of the back."""
_WALL_M = 2.6
_TRIES = 12
Range = tuple[Positive, Positive]
Most = Annotated[int, Ge(0)]


@settings
class Habits:
    """Where things of one class are, as probabilities; what is left stands anywhere on the floor.

    Attributes:
        wall: its back (+y of the mesh as made) is at a wall.
        table: it is drawn up to a table, facing it, as chairs are.
        top: it stands on furniture, unless it is taller than `Furnishing.tallest_m`.
        hung: it hangs on a wall.
        stand_m: height of the furniture that is made for it where there is no other.
        carries: the most things without a class that stand on it; the number is uniform.
    """

    wall: Share = 0.0
    table: Share = 0.0
    top: Share = 0.0
    hung: Share = 0.0
    stand_m: Range = (0.45, 1.1)
    carries: Most = 3

    def draw(self, rng: np.random.Generator) -> str:
        """One of the four, or "floor"."""
        shares = [self.wall, self.table, self.top, self.hung]
        place = int(np.searchsorted(np.cumsum(shares), rng.random(), side="right"))
        return ("wall", "table", "top", "hung", "floor")[place]


_BY_WORD = {"floor": Habits(), "wall": Habits(wall=1.0), "top": Habits(top=1.0)}


@dataclass(frozen=True, eq=False)
class Thing:
    """A mesh with a class in a room.

    Attributes:
        mesh: in the room, whose floor is z = 0 and whose corner is the origin, metres.
        item: what it is.
        sha256: of its mesh as made.
    """

    mesh: Mesh
    item: MeshItem
    sha256: str

    @property
    def cls(self) -> str:
        """Its class."""
        return self.item.cls


@dataclass(frozen=True, eq=False)
class Furnished:
    """A room: `things` have a class, `others` and the `shell` (floor and walls) have none."""

    size_m: Float[np.ndarray, " 2"]
    things: list[Thing]
    others: list[Mesh]
    shell: list[Mesh]


@settings
class Furnishing:
    """How rooms are furnished.

    Attributes:
        habits: by class; a word ("floor", "wall", "top") stands for always there, and "default" is
            for the classes that are not here.
        least_m, most_m: sides of the room.
        things: fewest and most things with a class.
        shared_top: probability that a thing on furniture shares what is there already, with a top
            at `shared_m`.
        seats: the most chairs without a class at a table; the number is uniform.
        clutter: the most boxes and cylinders on the floor; the number is uniform.
        thing_m, clutter_m: their sides and heights, on furniture and on the floor.
        tallest_m: taller things stand on no furniture.
        hung_m: height of what hangs.
        table_m, top_m: sides and height of a table without a class.
    """

    habits: Mapping[str, Literal["floor", "wall", "top"] | Habits] = field(default_factory=dict)
    least_m: Range = (3.0, 3.0)
    most_m: Range = (6.5, 6.0)
    things: tuple[int, int] = (10, 25)
    shared_top: Share = 0.6
    shared_m: Range = (0.5, 1.3)
    seats: Most = 3
    clutter: Most = 4
    thing_m: Range = (0.06, 0.4)
    clutter_m: Range = (0.08, 0.6)
    tallest_m: Positive = 1.0
    hung_m: Range = (1.2, 1.5)
    table_m: Range = (0.7, 1.6)
    top_m: Range = (0.7, 0.78)
    placing: RealSize = field(default_factory=RealSize)

    def of(self, cls: str) -> Habits:
        """Habits of a class."""
        found = self.habits.get(cls) or self.habits.get("default") or Habits()
        return _BY_WORD[found] if isinstance(found, str) else found

    def furnish(
        self, draw: Callable[[np.random.Generator], MeshItem], rng: np.random.Generator
    ) -> Furnished:
        """A room of things that `draw` gives, one after the other; what finds no place is left out.

        Walls first, then the floor by size, then tables' chairs, then what stands on something.
        """
        room = _Room(rng.uniform(self.least_m, self.most_m), rng)
        drawn = []
        for _ in range(int(rng.integers(self.things[0], self.things[1] + 1))):
            item = draw(rng)
            mesh, sha256 = _loaded(item, self.placing)
            how = self.of(item.cls).draw(rng)
            if how == "top" and mesh.bounds[1, 2] > self.tallest_m:
                how = "floor"
            drawn.append((item, mesh, how, sha256))
        order = ("wall", "floor", "table", "top", "hung")
        drawn.sort(key=lambda each: (order.index(each[2]), -np.prod(_sides(each[1]))))
        for item, mesh, how, sha256 in drawn:
            pose = None
            if how in ("wall", "hung"):
                pose = room.at_wall(mesh)
            elif how == "table":
                pose = self._at_table(room, mesh)
            elif how == "top":
                pose = self._on_top(room, mesh, self.of(item.cls))
            if pose is None and how in ("wall", "floor", "table"):
                pose = room.anywhere(mesh)
            if pose is None:
                continue
            if how == "hung":
                pose = replace(pose, z=rng.uniform(*self.hung_m))
            placed = pose.of(mesh)
            room.things.append(Thing(placed, item, sha256))
            if how in ("wall", "floor"):
                room.carriers.append(_Top.of(placed, rng, self.of(item.cls).carries))
            if item.cls == "table" and how != "top":
                room.tables.append(pose.outline(mesh))
        for outline in room.tables:
            for _ in range(int(rng.integers(0, self.seats + 1))):
                chair = _Pose(-np.pi / 2, np.zeros(2)).of(_plain_chair(rng))  # its back at +y
                if (pose := room.drawn_up(chair, [outline])) is not None:
                    room.others.append(pose.of(chair))
        for top in room.carriers:
            room.others += top.things(rng, self.thing_m)
        for _ in range(int(rng.integers(0, self.clutter + 1))):
            size = rng.uniform(*self.clutter_m, 3)
            piece = prism(ring_of(size[:2], 4 if rng.random() < 0.6 else 16, 0.0), 0.0, size[2])
            if (pose := room.anywhere(piece)) is not None:
                room.others.append(pose.of(piece))
        return Furnished(room.size, room.things, room.others, _shell(room.size))

    def _at_table(self, room: "_Room", mesh: Mesh) -> "_Pose | None":
        """Drawn up to one of the room's tables; where all are full, to one without a class."""
        rng = room.rng
        if room.tables and (pose := room.drawn_up(mesh, room.tables)) is not None:
            return pose
        half = rng.uniform(*self.table_m, 2) / 2
        board = table((-half, half), np.eye(2), 0.0, rng.uniform(*self.top_m), 0.06, 0.05)
        place = room.anywhere(board) if rng.random() < 0.6 else room.at_wall(board)
        if place is None:
            return None
        room.others.append(place.of(board))
        room.tables.append(place.outline(board))
        room.carriers.append(_Top.of(room.others[-1], rng, 6))
        return room.drawn_up(mesh, room.tables[-1:])

    def _on_top(self, room: "_Room", mesh: Mesh, habits: Habits) -> "_Pose | None":
        """On what is there, turned to the middle of the room, or on a stand of its own."""
        rng = room.rng
        radius = float(np.hypot(*_sides(mesh))) / 2
        if room.carriers and rng.random() < self.shared_top:
            for _ in range(4):
                top = room.carriers[int(rng.integers(len(room.carriers)))]
                spot = top.spot(0.7 * radius, rng, self.shared_m)
                if spot is not None:
                    ahead = room.size / 2 - spot[:2]
                    yaw = np.arctan2(ahead[1], ahead[0]) + np.pi / 2 + rng.normal(0, 0.5)
                    return _Pose(float(yaw), spot[:2], float(spot[2]) + HAIR_M)
        height = rng.uniform(*habits.stand_m)
        half = (_sides(mesh) + rng.uniform(0.06, 0.8, 2)) / 2
        if rng.random() < 0.4:
            stand = prism(rectangle(-half, half), 0.0, height)
        else:
            board, leg = rng.uniform(0.02, 0.06), rng.uniform(0.03, 0.08)
            stand = table((-half, half), np.eye(2), 0.0, height, board, leg)
        pose = room.at_wall(stand) if rng.random() < 0.75 else room.anywhere(stand)
        if pose is None:
            return None
        room.others.append(pose.of(stand))
        room.carriers.append(_Top.of(room.others[-1], rng, 3))
        room.carriers[-1].fill(pose.at, radius)
        return _Pose(pose.yaw + rng.normal(0, 0.3), pose.at, height + HAIR_M)


@dataclass(frozen=True, eq=False)
class _Pose:
    """Where a mesh around the z axis goes: turned by `yaw` (radians), to `at` [2] and `z`."""

    yaw: float
    at: np.ndarray
    z: float = 0.0

    @property
    def turn(self) -> np.ndarray:
        """[2, 2], for rows."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, s], [-s, c]])

    def of(self, mesh: Mesh) -> Mesh:
        flat = mesh.vertices[:, :2] @ self.turn + self.at
        return mesh.at(np.column_stack([flat, mesh.vertices[:, 2] + self.z]))

    def outline(self, mesh: Mesh) -> np.ndarray:
        """[4, 2] the mesh's box on the floor."""
        return rectangle(*mesh.bounds[:, :2]) @ self.turn + self.at


class _Room:
    """What stands where; the floor is a map of cells that are free or taken."""

    def __init__(self, size: np.ndarray, rng: np.random.Generator) -> None:
        self.size, self.rng = size, rng
        self.things: list[Thing] = []
        self.others: list[Mesh] = []
        self.tables: list[np.ndarray] = []
        self.carriers: list[_Top] = []
        self._taken = np.zeros((size / _FLOOR_CELL_M).astype(int) + 1, dtype=np.uint8)

    def anywhere(self, mesh: Mesh) -> _Pose | None:
        for _ in range(_TRIES):
            yaw, at = self.rng.uniform(0, 2 * np.pi), self.rng.uniform(0, self.size)
            if self._take(mesh, pose := _Pose(yaw, at)):
                return pose
        return None

    def at_wall(self, mesh: Mesh) -> _Pose | None:
        """Its back (+y) at a wall, at most 8 cm before it, turned by some 2 degrees."""
        for _ in range(_TRIES):
            side = int(self.rng.integers(4))
            yaw = side * np.pi / 2 + self.rng.normal(0, np.deg2rad(2))
            ring = _Pose(yaw, np.zeros(2)).outline(mesh)
            low, high = ring.min(axis=0), self.size - ring.max(axis=0)
            at = -low + self.rng.random(2) * (high + low)
            gap, axis = self.rng.uniform(0, 0.08), (1, 0)[side % 2]
            at[axis] = high[axis] - gap if side in (0, 3) else gap - low[axis]
            if self._take(mesh, pose := _Pose(yaw, at)):
                return pose
        return None

    def drawn_up(self, mesh: Mesh, tables: Sequence[np.ndarray]) -> _Pose | None:
        """Facing a side of a table [4, 2], up to two thirds of it below the board."""
        depth = float(np.ptp(mesh.bounds[:, 1]))
        for _ in range(_TRIES):
            ring = tables[int(self.rng.integers(len(tables)))]
            k = int(self.rng.integers(4))
            first, second = ring[k], ring[(k + 1) % 4]
            along = (second - first) / np.linalg.norm(second - first)
            out = np.array([along[1], -along[0]])  # rings are counter-clockwise
            at = first + self.rng.uniform(0.15, 0.85) * (second - first)
            at = at + out * depth * self.rng.uniform(-0.15, 0.8)
            yaw = np.arctan2(-out[0], out[1]) + self.rng.normal(0, 0.2)
            if self._take(mesh, pose := _Pose(yaw, at), ring):
                return pose
        return None

    def _take(self, mesh: Mesh, pose: _Pose, below: np.ndarray | None = None) -> bool:
        """Take the place of a mesh if it is free; what is taken `below` does not count."""
        ring = pose.outline(mesh)
        if (ring < 0).any() or (ring > self.size).any():
            return False
        cells, taken = self._cells(ring), self._taken
        if below is not None:
            taken = np.where(self._cells(below) & (taken == 1), 0, taken)
        if taken[cells].any():
            return False
        self._taken[cells] = 1 if below is None else 2
        return True

    def _cells(self, ring: np.ndarray) -> np.ndarray:
        cells = np.zeros(self._taken.shape, dtype=np.uint8)
        corners = np.rint(ring / _FLOOR_CELL_M).astype(np.int32)[:, ::-1]
        cv2.fillConvexPoly(cells, np.ascontiguousarray(corners), (1,))
        return cells.astype(bool)


@dataclass(frozen=True, eq=False)
class _Top:
    """Furniture from above: z of each cell, -inf where nothing is or something stands."""

    low: np.ndarray
    heights: np.ndarray
    most: int

    @staticmethod
    def of(mesh: Mesh, rng: np.random.Generator, most: int) -> "_Top":
        """By points on the surface: thin rods may have gaps."""
        points = surface_sample(mesh.vertices, mesh.faces, _SAMPLES, rng)
        low = mesh.bounds[0, :2]
        cells = ((points[:, :2] - low) / _TOP_CELL_M).astype(int)
        heights = np.full(cells.max(axis=0) + 1, -np.inf)
        np.maximum.at(heights, (cells[:, 0], cells[:, 1]), points[:, 2])
        return _Top(low, heights, most)

    def spot(
        self, radius_m: float, rng: np.random.Generator, between_m: Range = (0.0, np.inf)
    ) -> np.ndarray | None:
        """[3] a place where all within `radius_m` is flat and at a height between; takes it."""
        high = (self.heights >= between_m[0]) & (self.heights <= between_m[1])
        free = np.argwhere(_flat_within(self.heights, radius_m) & high)
        if not len(free):
            return None
        cell = free[int(rng.integers(len(free)))]
        at = self.low + (cell + 0.5) * _TOP_CELL_M
        height = self.heights[tuple(cell)]
        self.fill(at, radius_m)
        return np.array([*at, height])

    def fill(self, at: np.ndarray, radius_m: float) -> None:
        """Something stands there now."""
        reach = int(np.ceil(radius_m / _TOP_CELL_M))
        middle = ((at - self.low) / _TOP_CELL_M).astype(int)
        self.heights[tuple(slice(max(k - reach, 0), k + reach + 1) for k in middle)] = -np.inf

    def things(self, rng: np.random.Generator, size_m: Range) -> list[Mesh]:
        """Boxes and cylinders on it."""
        found = []
        for _ in range(int(rng.integers(0, self.most + 1))):
            size = rng.uniform(*size_m, 3)
            spot = self.spot(float(np.hypot(*size[:2])) / 2, rng)
            if spot is not None:
                ring = ring_of(size[:2], 4 if rng.random() < 0.6 else 16, rng.uniform(0, 2 * np.pi))
                bottom = float(spot[2]) + HAIR_M
                found.append(prism(ring + spot[:2], bottom, bottom + float(size[2])))
        return found


@functools.lru_cache(maxsize=1024)
def _loaded(item: MeshItem, placing: RealSize) -> tuple[Mesh, str]:
    mesh = item.load()
    return placing.stand(mesh), mesh.sha256


def _plain_chair(rng: np.random.Generator) -> Mesh:
    """A seat on four legs with a back at -x, about the z axis."""
    half = np.full(2, rng.uniform(*_CHAIR_M) / 2)
    seat, back = rng.uniform(*_SEAT_M), rng.uniform(*_BACK_M)
    low = table((-half, half), np.eye(2), 0.0, seat, 0.05, 0.035)
    panel = rectangle(-half, np.array([-half[0] + 0.04, half[1]]))
    gap = 0.0 if rng.random() < 0.6 else 0.15  # between the seat and the back
    return merge([low, prism(panel, seat + gap + HAIR_M, back)])


def _flat_within(heights: Float[np.ndarray, "x y"], radius_m: float) -> np.ndarray:
    """[x, y] bool: where all cells within `radius_m` are there and of nearly one height."""
    from scipy.ndimage import maximum_filter, minimum_filter

    reach = max(round(radius_m / _TOP_CELL_M), 1)
    # What lies outside the grid is as what shows nothing.
    lowest = minimum_filter(heights, 2 * reach + 1, mode="constant", cval=-np.inf)
    highest = maximum_filter(heights, 2 * reach + 1, mode="constant", cval=-np.inf)
    with np.errstate(invalid="ignore"):
        return np.isfinite(lowest) & (highest - lowest < _FLAT_M)


def _sides(mesh: Mesh) -> np.ndarray:
    return np.ptp(mesh.bounds[:, :2], axis=0)


def _shell(size: np.ndarray) -> list[Mesh]:
    """The floor, a hair below z = 0, and four walls."""
    two = np.array([[0, 1, 2], [0, 2, 3]])
    ring = rectangle(np.zeros(2), size)
    floor = Mesh(np.column_stack([ring, np.full(4, -HAIR_M)]), two)
    walls = [
        Mesh(np.array([[*a, 0.0], [*b, 0.0], [*b, _WALL_M], [*a, _WALL_M]]), two)
        for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True)
    ]
    return [floor, *walls]
