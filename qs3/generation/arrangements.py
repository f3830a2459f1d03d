"""What people have put around an object and on it: a table before a chair, chairs at a table.

A room of pieces at random (`scenes.Room`) hides an object by accident. In lived-in rooms it is
hidden where it is used: of a chair at a table the back alone is seen, of a table among chairs the
top and of that what no thing stands on, of a lamp among books the shade.
"""

from collections.abc import Mapping
from dataclasses import field
from typing import Annotated

import numpy as np
from annotated_types import Ge
from jaxtyping import Float

from qs3.generation.scenes import HAIR_M, prism, rectangle, ring_of, table
from qs3.geometry.sampling import surface_sample
from qs3.meshes.mesh import Mesh, merge
from qs3.utils.settings import NotNegative, Positive, Share, settings

_CHAIR_M = (0.38, 0.55)
_SEAT_M = (0.42, 0.5)
_BACK_M = (0.75, 1.05)
"""Chairs that only hide things: width and depth, height of the seat and of the back."""
CELL_M = 0.04
_SAMPLES = 20_000
_FLAT_M = 0.03
"""Under a thing the surface differs by no more than this: a board or a mattress, no pillows."""


@settings
class Arrangement:
    """What stands at an object and on it, drawn anew for each picture.

    Attributes:
        tables: by class the probability that an object on the floor stands at a table, with what
            is lower than its board under it or just before it; 0 of a class that is not here.
        seats: by class the most chairs that stand at an object and partly under it, each facing it
            at a place of its own; the number is uniform. Only at what has room for them: higher
            than their seats.
        apart_m: the table is drawn back by up to so much from what it could cover; half of the
            tables are not.
        things: by class the most things that stand on an object, 0 of a class that is not here;
            the number is uniform. Those of "table" are also for the table it stands at, and those
            of "support" for the furniture that an object above the floor stands on.
    """

    tables: Mapping[str, Share] = field(default_factory=dict)
    seats: Mapping[str, Annotated[int, Ge(0)]] = field(default_factory=dict)
    min_top_m: Positive = 0.7  # height of the table
    max_top_m: Positive = 0.78
    min_side_m: Positive = 0.7  # of the table
    max_side_m: Positive = 1.6
    board_m: Positive = 0.06  # thickness of it and of what hangs under it
    leg_m: Positive = 0.05  # side
    apart_m: NotNegative = 0.3
    things: Mapping[str, Annotated[int, Ge(0)]] = field(default_factory=dict)
    min_thing_m: Positive = 0.06  # sides and height
    max_thing_m: Positive = 0.4
    min_albedo: Share = 0.25
    max_albedo: Share = 0.9

    def around(
        self, mesh: Mesh, cls: str, rng: np.random.Generator, support: Mesh | None = None
    ) -> list[Mesh]:
        """The table, if there is one, and all things.

        Of an object of a class that is placed over the floor z = 0, on it or on a `support`.
        """
        found, most = [], self.things.get
        if rng.random() < self.tables.get(cls, 0.0) and support is None:
            found.append(self._table(mesh, rng))
            found += self._on(found[0], most("table", 0), rng)
        if support is not None:
            top = float(support.bounds[1, 2])
            found += self._on(merge([support, mesh]), most("support", 0), rng, top)
        found += self._on(mesh, most(cls, 0), rng)
        room = mesh.bounds[1, 2] > _SEAT_M[1] + 0.15
        most_seats = self.seats.get(cls, 0) if room else 0
        found += [self._chair(mesh, rng) for _ in range(int(rng.integers(0, most_seats + 1)))]
        return found

    def _chair(self, mesh: Mesh, rng: np.random.Generator) -> Mesh:
        """Before one side of the object's footprint, its seat up to two thirds within it."""
        chair, side = plain_chair(rng)
        flat = mesh.vertices[:, :2] - mesh.bounds.mean(axis=0)[:2]
        yaw = rng.uniform(0, 2 * np.pi)
        ahead = -np.array([np.cos(yaw), np.sin(yaw)])  # from the chair to the object
        edge = float((flat @ -ahead).max())
        away = edge + side * rng.uniform(-0.15, 0.8)  # of its middle: its back is outside
        aside = rng.uniform(-0.3, 0.3)
        turn = np.array([ahead, [-ahead[1], ahead[0]]])
        moved = chair.vertices[:, :2] @ turn + mesh.bounds.mean(axis=0)[:2]
        moved += -away * ahead + aside * turn[1]
        return Mesh(np.column_stack([moved, chair.vertices[:, 2]]), chair.faces)

    def _table(self, mesh: Mesh, rng: np.random.Generator) -> Mesh:
        """On the side away from the object's back: where it is not higher than the table."""
        top = rng.uniform(self.min_top_m, self.max_top_m)
        width, depth = rng.uniform(self.min_side_m, self.max_side_m, 2)
        surface = surface_sample(mesh.vertices, mesh.faces, _SAMPLES, rng)
        middle = mesh.bounds.mean(axis=0)[:2]
        flat = surface[:, :2] - middle
        high = surface[:, 2] > top - self.board_m
        back = flat[high].mean(axis=0) if high.any() else np.zeros(2)
        if np.hypot(*back) < 0.03:  # nothing above the board, or no side that is higher: a stool
            yaw = rng.uniform(0, 2 * np.pi)
            front = np.array([np.cos(yaw), np.sin(yaw)])
        else:
            front = -back / np.hypot(*back)
        turn = np.array([front, [-front[1], front[0]]])  # rows: its axes in the world
        ahead = flat @ front
        nearest = (float(ahead[high].max()) if high.any() else float(ahead.min())) + 0.02
        farthest = max(float(ahead.max()), nearest)
        edge = rng.uniform(nearest, farthest) + self.apart_m * max(rng.uniform(-1, 1), 0.0)
        aside = rng.uniform(-0.3, 0.3) * width
        low = np.array([edge, aside - width / 2])
        outline = (low, low + np.array([depth, width]))
        made = table(outline, turn, 0.0, top, self.board_m, self.leg_m)
        return Mesh(made.vertices + np.array([*middle, 0.0]), made.faces)

    def _on(
        self, mesh: Mesh, most: int, rng: np.random.Generator, top: float | None = None
    ) -> list[Mesh]:
        """Up to `most` boxes and cylinders where the mesh, from above, is flat (and at `top`)."""
        if most == 0:
            return []
        low, heights = heights_of(mesh, rng)
        found = []
        for _ in range(int(rng.integers(0, most + 1))):
            size = rng.uniform(self.min_thing_m, self.max_thing_m, 3)
            sides = 4 if rng.random() < 0.6 else 16
            spot, yaw = rng.random(2), rng.uniform(0, 2 * np.pi)
            flat = flat_within(heights, float(np.hypot(*size[:2])) / 2)
            if top is not None:
                flat &= np.abs(heights - top) < _FLAT_M
            free = np.argwhere(flat)
            if not len(free):
                continue
            cell = free[int(spot[0] * len(free))]
            ring = ring_of(size[:2], sides, yaw) + low + (cell + 0.5) * CELL_M
            bottom = float(heights[tuple(cell)]) + HAIR_M
            found.append(prism(ring, bottom, bottom + float(size[2])))
        return found


def plain_chair(rng: np.random.Generator) -> tuple[Mesh, float]:
    """A seat on four legs with a back at -x, about the z axis, and the seat's side."""
    side = rng.uniform(*_CHAIR_M)
    seat, back = rng.uniform(*_SEAT_M), rng.uniform(*_BACK_M)
    outline = table(
        (np.full(2, -side / 2), np.full(2, side / 2)), np.eye(2), 0.0, seat, 0.05, 0.035
    )
    panel = rectangle(np.array([-side / 2, -side / 2]), np.array([-side / 2 + 0.04, side / 2]))
    gap = 0.0 if rng.random() < 0.6 else 0.15  # between the seat and the back
    return merge([outline, prism(panel, seat + gap + HAIR_M, back)]), side


def heights_of(
    mesh: Mesh, rng: np.random.Generator
) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, "x y"]]:
    """How high a mesh is, from above: the grid's lowest corner [m], and z of each cell of 4 cm.

    A cell that shows nothing is -inf. By points on the surface: thin rods may have gaps.
    """
    points = surface_sample(mesh.vertices, mesh.faces, _SAMPLES, rng)
    low = mesh.bounds[0, :2]
    cells = ((points[:, :2] - low) / CELL_M).astype(int)
    heights = np.full(cells.max(axis=0) + 1, -np.inf)
    np.maximum.at(heights, (cells[:, 0], cells[:, 1]), points[:, 2])
    return low, heights


def flat_within(heights: Float[np.ndarray, "x y"], radius_m: float) -> np.ndarray:
    """[x, y] bool: where all cells within `radius_m` are there and of nearly one height."""
    from scipy.ndimage import maximum_filter, minimum_filter

    reach = max(round(radius_m / CELL_M), 1)
    # What lies outside the grid is as what shows nothing.
    lowest = minimum_filter(heights, 2 * reach + 1, mode="constant", cval=-np.inf)
    highest = maximum_filter(heights, 2 * reach + 1, mode="constant", cval=-np.inf)
    with np.errstate(invalid="ignore"):
        return np.isfinite(lowest) & (highest - lowest < _FLAT_M)
