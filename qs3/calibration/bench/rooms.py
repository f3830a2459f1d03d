"""Whole frames of a furnished room: the share of pixels without depth, and mixed pixels.

A plane and a square show what a sensor does to surfaces that it sees well. In real rooms most of
what is lost lies in the shadows of furniture, at the border of the view, and on what is dark, shiny
or seen at a slant. Furniture of the embedded catalogue stands in a room of five by four metres;
each frame is a room of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np

from qs3.calibration.bench.planar import without_nan
from qs3.calibration.bench.real import depth_steps
from qs3.calibration.bench.subject import Subject
from qs3.catalogue import families, make
from qs3.catalogue.parts import box
from qs3.config.compose import composed
from qs3.config.hydra import build
from qs3.errors import ConfigError
from qs3.geometry.cameras import look_at
from qs3.meshes.mesh import Mesh
from qs3.sensors.base import DepthFrame
from qs3.sensors.devices.reference_speckle import ReferenceSpeckle
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.pixel_status import Reason
from qs3.sensors.renderers.base import Body, Renderer

MATERIALS = ("lambert", "mixed")
"""Files of conf/materials; with the first all is matt."""

NEAR_M = 3.0
"""Mixed pixels are counted to here; farther away a Kinect's noise is as large as they are."""
APART_M = 0.05
"""So far from both sides a mixed pixel is: three standard deviations of a Kinect at 3 m."""

CLEAR_PX = 2.0

_LONG_M, _WIDE_M, _HIGH_M = 5.0, 4.0, 2.5
_WALL_M = 0.05
_PLACES: tuple[tuple[str, float, float, float], ...] = (
    # class, x and y of its middle, degrees about the vertical; fronts look along -y
    ("bookshelf", 4.7, -0.9, -90.0),
    ("cabinet", 4.4, 0.9, -90.0),
    ("sofa", 3.0, 1.45, 0.0),
    ("table", 2.9, -0.1, 20.0),
    ("chair", 2.2, -0.7, 200.0),
    ("chair", 3.4, -1.1, 60.0),
    ("lamp", 3.9, 1.6, 0.0),
    ("plant", 3.6, -1.6, 0.0),
)


@dataclass(frozen=True)
class RoomCondition:
    """Frames of rooms.

    Attributes:
        materials: of the furniture, a file of conf/materials; walls, floor and ceiling are matt.
        frames: how many, each of other furniture from another place.
        height_m, pitch_deg: of the camera, and how far it looks down, each give or take a fifth.
    """

    materials: str = "lambert"
    frames: int = 2
    height_m: float = 1.35
    pitch_deg: float = 15.0

    @property
    def name(self) -> str:
        """For file names and messages."""
        return f"room-{self.materials}"


def applies(subject: Subject) -> bool:
    """Whether it is a device that looks at rooms: dots, and a depth at every pixel."""
    return isinstance(subject.sensor, ReferenceSpeckle | SpeckleStereo) and subject.step_px == 1


def measure(
    subject: Subject, condition: RoomCondition, renderer: Renderer, seed: int = 0
) -> dict[str, Any]:
    """Render and measure.

    Returns:
        empty: share of pixels without depth, of those that see a surface. reasons: the same by
        `Reason`, shadow and occlusion told apart from the rest. mixed: share of the depth
        steps at silhouettes with a pixel that lies between (`real.depth_steps`), of surfaces
        within `NEAR_M`; steps: how many there are. flying: share of the pixels with a depth
        there that are wrong by more than `APART_M` and 3 %.
    """
    reasons = np.zeros(len(Reason))
    mixed = steps = off = valid = 0
    for i in range(condition.frames):
        rng = np.random.default_rng([0x5001, seed, i])
        bodies, pose = room(condition, rng)
        frame = take(subject, bodies, pose, renderer, rng)
        sees = np.isfinite(frame.clean_m)
        found = sees & np.isfinite(frame.depth_m)
        why = np.where(found, np.uint8(Reason.OK), frame.reason)[sees]
        reasons += np.bincount(why, minlength=len(Reason))[: len(Reason)]
        near = frame.clean_m < NEAR_M
        at = silhouettes(frame.clean_m, subject.focal_baseline or np.inf)
        between, every = depth_steps(np.where(at, frame.depth_m, np.nan), apart_m=APART_M)
        mixed, steps = mixed + between, steps + every
        error = np.abs(frame.depth_m - frame.clean_m)[found & near]
        off += int((error > np.maximum(APART_M, 0.03 * frame.clean_m[found & near])).sum())
        valid += int((found & near).sum())
    shares = reasons / max(reasons.sum(), 1)
    return without_nan(
        {
            "condition": asdict(condition),
            "empty": float(1 - shares[Reason.OK]),
            "reasons": {r.name.lower(): float(shares[r]) for r in Reason if shares[r]},
            "mixed": mixed / steps if steps else None,
            "steps": steps,
            "flying": off / max(valid, 1),
        }
    )


def silhouettes(clean_m: np.ndarray, focal_baseline: float, reach_px: int = 9) -> np.ndarray:
    """[h, w] bool: within `reach_px` of a true step that the sensor resolves, on near surfaces.

    A step is over 10 cm and `CLEAR_PX` of disparity: with less the window sees one surface.
    Elsewhere neighbours that differ are noise, or a surface that recedes.
    """
    step = np.zeros(clean_m.shape, dtype=np.uint8)
    for axis in (0, 1):
        true, marked = (np.swapaxes(a, 0, axis) for a in (clean_m, step))
        one, other = true[1:], true[:-1]
        with np.errstate(invalid="ignore"):
            jump = (np.abs(one - other) > 0.1) & (np.maximum(one, other) < NEAR_M)
            jump &= abs(focal_baseline) * np.abs(1 / one - 1 / other) > CLEAR_PX
        marked[1:] |= jump
        marked[:-1] |= jump
    size = 2 * reach_px + 1
    return cv2.dilate(step, np.ones((size, size), np.uint8)).astype(bool)


def room(condition: RoomCondition, rng: np.random.Generator) -> tuple[tuple[Body, ...], np.ndarray]:
    """The bodies of one room, and [4, 4] world_from_camera; the floor is z = 0."""
    bodies = [
        Body(mesh, albedo=float(albedo), label=0)
        for mesh, albedo in zip(_shell(), rng.uniform((0.3, *[0.7] * 4), 0.85), strict=True)
    ]
    things = []
    for cls, x, y, turn_deg in _PLACES:
        names = [family.name for family in families(cls)]
        name = names[int(rng.integers(len(names)))]
        mesh = make(cls, name, f"room/{int(rng.integers(2**31))}")
        turn = np.deg2rad(turn_deg + rng.uniform(-15, 15))
        things.append(_placed(mesh, np.array([x, y]) + rng.uniform(-0.15, 0.15, 2), turn))
    albedo = rng.uniform(0.3, 0.85, len(things))
    furniture = [Body(m, albedo=float(a)) for m, a in zip(things, albedo, strict=True)]
    materials = composed(None, f"+materials={condition.materials}").get("materials")
    if materials is not None:
        mixed = build(materials)
        furniture = [dressed for body in furniture for dressed in mixed.dress((body,), rng)]
    height = condition.height_m * rng.uniform(0.8, 1.2)
    pitch = np.deg2rad(condition.pitch_deg * rng.uniform(0.8, 1.2))
    eye = np.array([0.3, rng.uniform(-0.6, 0.6), height])
    yaw = np.deg2rad(rng.uniform(-12, 12))
    ahead = [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)]
    return (*furniture, *bodies), look_at(eye, eye + np.array(ahead))


def take(
    subject: Subject,
    bodies: Sequence[Body],
    pose: np.ndarray,
    renderer: Renderer,
    rng: np.random.Generator,
) -> DepthFrame:
    """One whole frame: the box of the room holds the camera, so all of the view is rendered."""
    half = _WIDE_M / 2
    around = np.array([[0.0, -half, 0.0], [_LONG_M, half, _HIGH_M]])
    frame = subject.sensor.scan(tuple(bodies), around, pose, renderer, rng, explain=True)
    if frame is None:
        raise ConfigError(f"sensor={subject.name} does not see the room")
    return frame


def _shell() -> list[Mesh]:
    """Floor, ceiling, the far wall and those at both sides; what the camera has behind is open."""
    half, wall = _WIDE_M / 2, _WALL_M
    long, high = _LONG_M, _HIGH_M
    return [
        _moved(box((long, 2 * half, wall)), (long / 2, 0, -wall)),
        _moved(box((long, 2 * half, wall)), (long / 2, 0, high)),
        _moved(box((wall, 2 * half, high)), (long + wall / 2, 0, 0)),
        _moved(box((long, wall, high)), (long / 2, half + wall / 2, 0)),
        _moved(box((long, wall, high)), (long / 2, -half - wall / 2, 0)),
    ]


def _moved(mesh: Mesh, to: tuple[float, float, float]) -> Mesh:
    """The lowest point's height and the middle along the floor are where `to` says."""
    low, high = mesh.bounds
    middle = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    return Mesh(mesh.vertices - middle + np.array(to), mesh.faces)


def _placed(mesh: Mesh, at: np.ndarray, turn: float) -> Mesh:
    """Turned about the vertical, then with its middle at [2] `at`, within the walls."""
    c, s = np.cos(turn), np.sin(turn)
    vertices = mesh.vertices @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    turned = Mesh(vertices, mesh.faces)
    half = np.ptp(turned.bounds, axis=0)[:2] / 2 + 0.01
    limit = np.array([_LONG_M, _WIDE_M / 2])
    x, y = np.clip(at, (1.2, -limit[1] + half[1]), limit - half)
    return _moved(turned, (float(x), float(y), 0.001))
