"""Which conditions a bench has, and running them so that an interruption loses one of them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from qs3.calibration.bench import edges, infrared_images, planar, rooms
from qs3.calibration.bench.subject import Subject
from qs3.config.compose import choices, composed
from qs3.config.hydra import build
from qs3.errors import ConfigError, DataError
from qs3.sensors.renderers.base import Renderer
from qs3.utils.files import write_json
from qs3.utils.memory import JSON_PEAK, read_whole

DEFAULT_SENSORS = (
    "kinect_v1", "structure_sensor", "realsense_d415", "realsense_d435", "speckle_stereo",
    "time_of_flight", "fringe", "kinect_like", "blensor_kinect", "blensor_tof",
)  # fmt: skip
"""On the page. Not on it: copies of others, and those that repeat a defect on purpose."""


Condition = (
    planar.PlanarCondition
    | edges.EdgeCondition
    | infrared_images.InfraredCondition
    | rooms.RoomCondition
)


@dataclass(frozen=True)
class Plan:
    """How thorough a bench is.

    Attributes:
        tilts_deg: at `tilt_depth_m`, or the depth of the sensor nearest to it.
        tilt_depth_m: where the plane is tilted.
        phases: planes a condition.
        repeats: frames for the noise over time.
        half_px: half the region, in samples.
        edge_frames: frames of the edge bench.
        room_frames: frames of rooms for each of their materials; 0 leaves them out.
    """

    tilts_deg: tuple[float, ...] = (15, 30, 45, 60, 65, 70, 75, 80, 85)
    tilt_depth_m: float = 2.0
    phases: int = 16
    repeats: int = 12
    half_px: int = 24
    edge_frames: int = 8
    room_frames: int = 2

    @staticmethod
    def quick() -> Plan:
        """Less of everything: seconds a sensor."""
        return Plan(
            tilts_deg=(45, 75), phases=8, repeats=6, half_px=16, edge_frames=3, room_frames=0
        )

    def conditions(self, subject: Subject) -> list[Condition]:
        """All of one sensor: distances, tilts both ways, the edge, infrared images, rooms."""
        depths = subject.depths_m()
        common: dict[str, Any] = {"phases": self.phases, "half_px": self.half_px}
        out: list[Condition] = [
            planar.PlanarCondition(z, repeats=self.repeats, **common) for z in depths
        ]
        tilted = min(depths, key=lambda z: abs(z - self.tilt_depth_m))
        for across in (True, False):
            out += [
                planar.PlanarCondition(tilted, float(t), across, **common) for t in self.tilts_deg
            ]
        out.append(edges.default_condition(subject, self.edge_frames))
        if infrared_images.applies(subject):
            out.append(infrared_images.InfraredCondition())
        if self.room_frames and rooms.applies(subject):
            out += [rooms.RoomCondition(each, self.room_frames) for each in rooms.MATERIALS]
        return out


@dataclass
class SensorResult:
    """All measurements of one sensor.

    Attributes:
        subject: the sensor.
        config: its resolved settings.
        planes: results of `planar.measure`, in the order of the plan.
        edge: result of `edges.measure`.
        infrared: result of `infrared_images.measure`; None of a sensor without such images.
        rooms: results of `rooms.measure`, by materials.
    """

    subject: Subject
    config: dict[str, Any]
    planes: list[dict[str, Any]] = field(default_factory=list)
    edge: dict[str, Any] = field(default_factory=dict)
    infrared: dict[str, Any] | None = None
    rooms: list[dict[str, Any]] = field(default_factory=list)

    def facing(self) -> list[dict[str, Any]]:
        """Conditions without tilt, by depth."""
        found = [m for m in self.planes if m["condition"]["tilt_deg"] == 0]
        return sorted(found, key=lambda m: m["condition"]["depth_m"])

    def tilted(self, across: bool) -> list[dict[str, Any]]:
        """Conditions at one depth, by tilt, the untilted one first."""

        def wanted(c: dict[str, Any]) -> bool:
            return c["tilt_deg"] > 0 and c["across"] == across

        found = [m for m in self.planes if wanted(m["condition"])]
        depths = {m["condition"]["depth_m"] for m in found}
        first = [m for m in self.facing() if m["condition"]["depth_m"] in depths]
        return first + sorted(found, key=lambda m: m["condition"]["tilt_deg"])


def load(name: str, overrides: Sequence[str] = ()) -> tuple[Subject, dict[str, Any]]:
    """A sensor by the name of its file in conf/sensor ("kinect_v1"), and its resolved settings.

    Args:
        overrides: "sensor.key=value", or "hydra.searchpath=[file:///FOLDER]", whose FOLDER/sensor
            has files, too.

    Raises:
        ConfigError: there is no such sensor, or `overrides` do not fit.
    """
    known = [choice for choice in choices("sensor") if choice != "none"]
    elsewhere = any(word.startswith("hydra.searchpath=") for word in overrides)
    if name not in known and not elsewhere:  # of other folders Hydra says what they have
        raise ConfigError(f"sensor={name} is unknown; there are {', '.join(known)}")
    cfg = composed(None, f"+sensor={name}", *overrides, place=f"sensor={name}: ")
    settings = OmegaConf.to_container(cfg.sensor, resolve=True)
    assert isinstance(settings, dict)
    return Subject(name, build(cfg.sensor)), {str(k): v for k, v in settings.items()}


def run(
    subject: Subject,
    config: dict[str, Any],
    renderer: Renderer,
    cache: Path,
    plan: Plan,
    advance: Callable[[], None] = lambda: None,
) -> SensorResult:
    """Measure all conditions of one sensor from `load`, or read what an earlier call measured.

    Args:
        cache: folder for one JSON file a condition. Its name holds a hash of the settings, the
            renderer and the code that measures, so a changed sensor is measured anew.
        advance: called after each condition.
    """
    result = SensorResult(subject, config)
    for condition in plan.conditions(subject):
        key = fingerprint(config, renderer.provenance(), asdict(condition))
        path = cache / subject.name / f"{condition.name}-{key[:12]}.json"
        found = read_cached(path)
        if found is None:
            found = _measured(subject, condition, renderer)
            write_json(path, found)
        if isinstance(condition, edges.EdgeCondition):
            result.edge = found
        elif isinstance(condition, infrared_images.InfraredCondition):
            result.infrared = found
        elif isinstance(condition, rooms.RoomCondition):
            result.rooms.append(found)
        else:
            result.planes.append(found)
        advance()
    return result


def _measured(subject: Subject, condition: Condition, renderer: Renderer) -> dict[str, Any]:
    if isinstance(condition, edges.EdgeCondition):
        return edges.measure(subject, condition, renderer)
    if isinstance(condition, infrared_images.InfraredCondition):
        return infrared_images.measure(subject, condition, renderer)
    if isinstance(condition, rooms.RoomCondition):
        return rooms.measure(subject, condition, renderer)
    return planar.measure(subject, condition, renderer)


def fingerprint(*parts: Any) -> str:
    """SHA-256 of settings and of the code that decides the numbers: sensors and measurements."""
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode())
    showing = ("bands", "cli", "comparison", "figures", "laws", "page", "real")
    for path in sorted(Path(__file__).resolve().parents[1].rglob("*.py")):
        if path.parent.name != "bench" or path.stem not in showing:
            digest.update(path.read_bytes())
    return digest.hexdigest()


def read_cached(path: Path) -> dict[str, Any] | None:
    """A cached result; None if there is none that can be read."""
    try:
        found = json.loads(read_whole(path, JSON_PEAK))
    except (OSError, ValueError, RecursionError, DataError):
        return None
    return found if isinstance(found, dict) else None
