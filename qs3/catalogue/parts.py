"""Primitives: every function returns one closed 2-manifold, its faces oriented outwards.

Metres, z up. `at` is the centre of the part's lower face unless noted otherwise. Nearly all
solids are lofts: a stack of rings of equally many points, closed by a fan at both ends.
"""

from collections.abc import Sequence

import numpy as np

from qs3.meshes.mesh import Mesh

Vector = Sequence[float] | np.ndarray
Profile = Sequence[tuple[float, float]]
ORIGIN = (0.0, 0.0, 0.0)


def outward(mesh: Mesh) -> Mesh:
    """The same closed mesh with its faces oriented outwards (positive volume)."""
    a, b, c = mesh.vertices[mesh.faces.T]
    volume = np.einsum("ij,ij->", a - mesh.vertices[0], np.cross(b - a, c - a))
    return mesh if volume > 0 else Mesh(mesh.vertices, mesh.faces[:, ::-1])


def loft(
    rings: np.ndarray,
    *,
    loop: bool = False,
    start: Vector | None = None,
    end: Vector | None = None,
) -> Mesh:
    """Skin over rings [K, N, 3]: corresponding points of consecutive closed curves.

    With `loop` the last ring continues in the first (a torus, an open-ended thick shade); else the
    apexes `start` and `end`, by default their means, close the first and the last one.
    """
    rings = np.asarray(rings, dtype=np.float64)
    k, n = rings.shape[:2]
    index = np.arange(k * n).reshape(k, n)
    lower = index if loop else index[:-1]
    upper = np.roll(index, -1, axis=0) if loop else index[1:]
    lower_next, upper_next = np.roll(lower, -1, axis=1), np.roll(upper, -1, axis=1)
    faces = [
        np.stack([lower, lower_next, upper_next], axis=-1).reshape(-1, 3),
        np.stack([lower, upper_next, upper], axis=-1).reshape(-1, 3),
    ]
    vertices = [rings.reshape(-1, 3)]
    if not loop:
        first, last = k * n, k * n + 1
        apexes = [
            rings[0].mean(axis=0) if start is None else np.asarray(start, dtype=np.float64),
            rings[-1].mean(axis=0) if end is None else np.asarray(end, dtype=np.float64),
        ]
        vertices.append(np.stack(apexes))
        head, tail = index[0], index[-1]
        faces.append(np.stack([np.roll(head, -1), head, np.full(n, first)], axis=-1))
        faces.append(np.stack([tail, np.roll(tail, -1), np.full(n, last)], axis=-1))
    return outward(Mesh(np.concatenate(vertices), np.concatenate(faces)))


# Plane curves ---------------------------------------------------------------------------


def rectangle(width: float, depth: float) -> np.ndarray:
    """[4, 2] counterclockwise corners, centred."""
    x, y = width / 2, depth / 2
    return np.array([(-x, -y), (x, -y), (x, y), (-x, y)])


def rounded_rectangle(width: float, depth: float, radius: float, steps: int = 3) -> np.ndarray:
    """[4 * (steps + 1), 2] a rectangle with round corners, centred."""
    radius = min(radius, 0.499 * min(width, depth))
    quarter = np.linspace(0, np.pi / 2, steps + 1)
    corners = []
    for k, (sx, sy) in enumerate([(1, 1), (-1, 1), (-1, -1), (1, -1)]):
        angle = quarter + k * np.pi / 2
        centre = np.array([sx * (width / 2 - radius), sy * (depth / 2 - radius)])
        corners.append(centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return np.concatenate(corners)


def ellipse(width: float, depth: float, sides: int = 24) -> np.ndarray:
    """[sides, 2] an ellipse by its two diameters, centred."""
    angle = np.arange(sides) * (2 * np.pi / sides)
    return np.stack([width / 2 * np.cos(angle), depth / 2 * np.sin(angle)], axis=1)


def ring_at(curve: np.ndarray, z: float) -> np.ndarray:
    """[N, 3] a plane curve at height z."""
    return np.column_stack([curve, np.full(len(curve), z)])


def arc(start: Vector, control: Vector, end: Vector, steps: int = 8) -> np.ndarray:
    """[steps + 1, 3] a quadratic Bézier curve, for bent tubes and stems."""
    t = np.linspace(0, 1, steps + 1)[:, None]
    a, b, c = (np.asarray(p, dtype=np.float64) for p in (start, control, end))
    return (1 - t) ** 2 * a + 2 * t * (1 - t) * b + t**2 * c


# Solids ---------------------------------------------------------------------------------


def frustum(
    bottom: tuple[float, float],
    top: tuple[float, float],
    height: float,
    at: Vector = ORIGIN,
    shift: tuple[float, float] = (0.0, 0.0),
) -> Mesh:
    """A box whose (width, depth) changes from bottom to top; the top may be shifted."""
    upper = rectangle(*top) + np.asarray(shift)
    rings = np.stack([ring_at(rectangle(*bottom), 0.0), ring_at(upper, height)])
    return loft(rings + np.asarray(at, dtype=np.float64))


def box(size: Vector, at: Vector = ORIGIN) -> Mesh:
    """An upright box of (width, depth, height)."""
    width, depth, height = (float(s) for s in size)
    return frustum((width, depth), (width, depth), height, at)


def rounded_box(
    size: Vector, at: Vector = ORIGIN, radius: float = 0.03, crown: float = 0.0, steps: int = 3
) -> Mesh:
    """A box with round edges; `crown` lifts the middle of its top like a filled cushion."""
    width, depth, height = (float(s) for s in size)
    radius = min(radius, 0.45 * min(width, depth, height))
    rings = []
    angles = np.linspace(0, np.pi / 2, steps + 1)
    for angle, upper in [*((a, False) for a in angles), *((a, True) for a in angles[::-1])]:
        inset, z = radius * (1 - np.sin(angle)), radius * (1 - np.cos(angle))
        curve = rounded_rectangle(
            width - 2 * inset, depth - 2 * inset, max(radius - inset, 0.1 * radius), steps
        )
        rings.append(ring_at(curve, height - z if upper else z))
    end = None
    if crown > 0:
        last = rings[-1]
        for s in (0.75, 0.4):
            rings.append(last * (s, s, 1) + (0, 0, crown * (1 - s**2)))
        end = np.array([0, 0, height + crown]) + np.asarray(at)
    return loft(np.stack(rings) + np.asarray(at, dtype=np.float64), end=end)


def pillow(size: Vector, at: Vector = ORIGIN) -> Mesh:
    """A loose pillow: thick in the middle, flat at the seam."""
    width, depth, height = (float(s) for s in size)
    rings = []
    for t in np.linspace(-0.97, 0.97, 8):
        s = (1 - abs(t) ** 3) ** 0.5
        curve = rounded_rectangle(width * s, depth * s, 0.25 * min(width, depth) * s)
        rings.append(ring_at(curve, height * (0.5 + 0.5 * t)))
    return loft(np.stack(rings) + np.asarray(at, dtype=np.float64))


def slab(curve: np.ndarray, height: float, at: Vector = ORIGIN) -> Mesh:
    """A level plate whose outline is a star-shaped plane curve (see `extrude` for upright ones)."""
    return shell(curve, [(1, 0.0), (1, height)], at)


def shell(curve: np.ndarray, profile: Profile, at: Vector = ORIGIN, *, loop: bool = False) -> Mesh:
    """Scaled copies of a plane curve at given heights: profile of (scale, z), closed by caps.

    A profile that goes up outside and down inside makes a vessel. Scale 0 at an end makes a pole;
    `loop` joins the last point to the first (thick shades).
    """
    at = np.asarray(at, dtype=np.float64)
    points = list(profile)
    start = end = None
    if not loop and points[0][0] <= 0:
        start = at + np.array([0, 0, points.pop(0)[1]])
    if not loop and points[-1][0] <= 0:
        end = at + np.array([0, 0, points.pop()[1]])
    rings = np.stack([ring_at(curve * scale, z) for scale, z in points])
    return loft(rings + at, loop=loop, start=start, end=end)


def lathe(profile: Profile, at: Vector = ORIGIN, *, sides: int = 20, loop: bool = False) -> Mesh:
    """A solid of revolution about z: profile of (radius, z), see `shell`."""
    return shell(ellipse(2, 2, sides), profile, at, loop=loop)


def cylinder(
    radius: float, height: float, at: Vector = ORIGIN, *, top: float | None = None, sides: int = 16
) -> Mesh:
    """An upright cylinder, or a cone frustum when the `top` radius is given."""
    return lathe([(radius, 0), (radius if top is None else top, height)], at, sides=sides)


def ellipsoid(size: Vector, centre: Vector = ORIGIN, *, sides: int = 16, rings: int = 9) -> Mesh:
    """An ellipsoid of full (width, depth, height) about `centre`."""
    angle = np.linspace(0, np.pi, rings + 2)
    ball = lathe([(float(np.sin(a)), -float(np.cos(a))) for a in angle[1:-1]], sides=sides)
    # the caps of this stack are flat; its poles move out to the sphere
    vertices = ball.vertices.copy()
    vertices[-2:] = [(0, 0, -1), (0, 0, 1)]
    return Mesh(vertices * (np.asarray(size) / 2) + np.asarray(centre), ball.faces)


def sweep(
    section: np.ndarray,
    path: np.ndarray,
    *,
    scale: Sequence[float] | np.ndarray | None = None,
    up: Vector = (0, 0, 1),
) -> Mesh:
    """A star-shaped section [N, 2] carried along a path [K, 3] without twist.

    At the path's start the section's second axis points along `up` as far as it can and its
    first is tangent x up. `scale` enlarges the section at each point of the path.
    """
    path = np.asarray(path, dtype=np.float64)
    steps = np.gradient(path, axis=0)
    tangents = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    normal = _perpendicular(np.asarray(up, dtype=np.float64), tangents[0])
    factors = np.ones(len(path)) if scale is None else np.asarray(scale, dtype=np.float64)
    rings = []
    for point, tangent, factor in zip(path, tangents, factors, strict=True):
        normal = _perpendicular(normal, tangent)
        side = np.cross(tangent, normal)
        flat = section * factor
        rings.append(point + flat[:, :1] * side + flat[:, 1:] * normal)
    return loft(np.stack(rings))


def _perpendicular(vector: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """The unit vector across `tangent` nearest to `vector` (y where they are parallel)."""
    across = vector - (vector @ tangent) * tangent
    if np.linalg.norm(across) < 1e-6:
        across = np.array([0.0, 1.0, 0.0]) - tangent[1] * tangent
    return across / np.linalg.norm(across)


def tube(
    path: np.ndarray,
    radius: float,
    *,
    scale: Sequence[float] | np.ndarray | None = None,
    sides: int = 8,
) -> Mesh:
    """A round bar along a path [K, 3]; `scale` multiplies the radius along it."""
    return sweep(ellipse(2 * radius, 2 * radius, sides), path, scale=scale)


def rod(p: Vector, q: Vector, radius: float, end: float | None = None, sides: int = 10) -> Mesh:
    """A straight round bar from p to q, tapering to the radius `end`."""
    scale = [1.0, 1.0 if end is None else end / radius]
    return tube(np.array([p, q], dtype=np.float64), radius, scale=scale, sides=sides)


def beam(p: Vector, q: Vector, size: tuple[float, float], end: float = 1.0) -> Mesh:
    """A straight bar of rectangular section from p to q, scaled by `end` at q.

    For a level bar, size is (horizontal, vertical); for an upright one, (along x, along y).
    """
    return sweep(rectangle(*size), np.array([p, q], dtype=np.float64), scale=[1.0, end])


def leaf(
    path: np.ndarray, width: float, *, across: Vector, thickness: float = 0.003, belly: float = 0.4
) -> Mesh:
    """A leaf or blade along its midrib [K, 3], widest at the fraction `belly`, pointed at the end.

    `across` is the direction of its greatest width (made perpendicular to the path), `thickness`
    that of the midrib.
    """
    path = np.asarray(path, dtype=np.float64)
    steps = np.gradient(path, axis=0)
    tangents = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    side = _perpendicular(np.asarray(across, dtype=np.float64), tangents[len(path) // 2])
    rings, normals = [], np.cross(side, tangents)
    for t, point, normal in zip(np.linspace(0, 1, len(path)), path, normals, strict=True):
        rise = np.sin(0.5 * np.pi * t / belly)
        fall = np.cos(0.5 * np.pi * (t - belly) / (1 - belly))
        share = max(float(rise if t < belly else fall), 0.06)
        half, lift = 0.5 * width * share, 0.5 * thickness * share**0.5 * normal
        rings.append([point - half * side, point - lift, point + half * side, point + lift])
    return loft(np.array(rings))


def extrude(
    outline: np.ndarray | Sequence[tuple[float, float]], thickness: float, axis: str
) -> Mesh:
    """A plate with a star-shaped outline [N, 2], from 0 to `thickness` along `axis`.

    The outline's plane is (y, z) for axis x and (x, z) for axis y.
    """
    order = {"x": (2, 0, 1), "y": (0, 2, 1)}[axis]
    rings = [ring_at(np.asarray(outline, dtype=np.float64), t)[:, order] for t in (0.0, thickness)]
    return loft(np.stack(rings))


# Placement ------------------------------------------------------------------------------


def move(mesh: Mesh, offset: Vector) -> Mesh:
    """Shift by (x, y, z) metres."""
    return Mesh(mesh.vertices + np.asarray(offset, dtype=np.float64), mesh.faces)


def turn(mesh: Mesh, degrees: float, axis: str = "z", about: Vector = ORIGIN) -> Mesh:
    """Turn right-handed about an axis through the point `about`."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    centre = np.asarray(about, dtype=np.float64)
    return Mesh((mesh.vertices - centre) @ matrix.T + centre, mesh.faces)


def mirrored(mesh: Mesh, axis: str = "x") -> Mesh:
    """Mirror in the plane through the origin across an axis."""
    sign = np.ones(3)
    sign["xyz".index(axis)] = -1
    return Mesh(mesh.vertices * sign, mesh.faces[:, ::-1])
