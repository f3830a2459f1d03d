"""One object on its way from mesh to cloud, or one room, and the figure that shows the stages.

Images are of one view; clouds are all views together, seen from the side of the camera. The bytes
are those that `generate.py` makes of the object or room.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from qs3.config.compose import composed
from qs3.config.hydra import build
from qs3.generation.kept import Keep, view_images
from qs3.generation.plan import planned
from qs3.generation.rooms import Rooms
from qs3.generation.scan import Scanner
from qs3.geometry.sampling import surface_sample
from qs3.meshes.io import Up, load_mesh
from qs3.meshes.mesh import Mesh, MeshItem
from qs3.sensors.base import DepthFrame
from qs3.utils.pictures import AZIMUTH_DEG, Image, cloud_image, sheet, turn_deg, value_image
from qs3.utils.seeding import object_rng

_OFTEN_THERE = "chair/train/chair_0000"
_ASIDE_DEG = 40.0  # of the camera, so that errors of depth are seen
_SIDE_PX, _PANEL_IN = 800, 2.8
_ROW = 4  # pictures
_SURFACE = 1_000_000  # samples of a mesh, one or two millimetres apart

Picture = tuple[str, Image]


class View(NamedTuple):
    """What `save_view` is given: number, frame, and [4, 4] poses, the true and the believed one."""

    number: int
    frame: DepthFrame
    world_from_camera: np.ndarray
    believed: np.ndarray


@dataclass(frozen=True, eq=False)
class ScannedObject:
    """An object, its views and its clouds.

    Attributes:
        name: its id.
        domain: its label, and what was changed in its settings.
        views: by number; none where the domain has no sensor.
        cloud: [P, 3] float32, metres: fused and sampled, as training gets it.
        clean: [P, 3] float32 its clean twin, or None.
        mesh: as it stood before the sensor.
    """

    name: str
    domain: str
    views: tuple[View, ...]
    cloud: np.ndarray
    clean: np.ndarray | None
    mesh: Mesh

    def fused(self) -> Float[np.ndarray, "m 3"]:
        """What all views measured, before crop and sampling, in believed poses."""
        parts = [view.frame.points(view.frame.depth_m, view.believed) for view in self.views]
        return np.concatenate([*parts, np.zeros((0, 3))])

    @cached_property
    def residual_m(self) -> Float[np.ndarray, " p"]:
        """Distance of each point of `cloud` to the mesh, by a million samples of its surface.

        Positive behind the surface as the point's camera sees it, negative before it. Samples of
        a surface have no camera, and their distances no sign.
        """
        rng = np.random.default_rng(0)
        surface = surface_sample(self.mesh.vertices, self.mesh.faces, _SURFACE, rng)
        tree = cKDTree(surface, balanced_tree=False, compact_nodes=False)  # built in half the time
        found, nearest = tree.query(self.cloud)
        if not self.views:
            return np.asarray(found)
        counts = [int(np.isfinite(view.frame.depth_m).sum()) for view in self.views]
        eyes = np.repeat([view.believed[:3, 3] for view in self.views], counts, axis=0)
        _, seen = cKDTree(self.fused()).query(self.cloud)  # the point itself, but for rounding
        behind = ((self.cloud - surface[nearest]) * (self.cloud - eyes[seen])).sum(axis=1)
        return np.where(behind >= 0, found, -found)


def scan_object(
    overrides: Sequence[str], object_id: str | None = None, mesh: str | Path | None = None
) -> ScannedObject:
    """Run one object through a domain's recipe.

    Args:
        overrides: of generate.py, such as ["domain=specklenet10"].
        object_id: which object; None: a chair, or the first there is.
        mesh: a mesh file to scan in place of the domain's objects.
    """
    cfg = composed("generate", *overrides)
    scanner = Scanner(cfg)
    recipe = scanner.recipe
    if mesh is not None:
        path = Path(mesh).expanduser()
        up: Up = "y" if cfg.up == "y" else "z"
        load = partial(load_mesh, path, keep_colliders=cfg.colliders == "keep", up=up)
        item = MeshItem(object_id or path.stem, "", "train", load, path.name, path)
    else:
        items = {item.id: item for item in planned(cfg).items}
        name = object_id or (_OFTEN_THERE if _OFTEN_THERE in items else next(iter(items)))
        item = items[name]
    loaded, looks = item.load(), recipe.needs_renderer
    views: list[View] = []
    keep = Keep(view=lambda _, *seen: views.append(View(*seen))) if looks else Keep()
    made = scanner.cloud(loaded, item.id, keep).arrays
    shown = ("domain=", "renderer=", "paths.", "workers=")
    changed = [word for word in overrides if not word.startswith(shown)]
    label = build(cfg.domain).label + (f" with {' '.join(changed)}" if changed else "")
    placed = recipe.placing.place(loaded, object_rng(cfg.seed, item.id, 0), item.id)
    clouds = made["points"], made.get("points_clean")
    return ScannedObject(item.id, label, tuple(views), *clouds, placed)


def makes_rooms(overrides: Sequence[str]) -> bool:
    """Whether a domain's recipe furnishes rooms."""
    return isinstance(planned(composed("generate", *overrides)).recipe, Rooms)


def room_figure(overrides: Sequence[str], room: str | None = None) -> Figure:
    """Draw a furnished room from four places, its things in colours, and clouds cut from it.

    Args:
        overrides: of generate.py, such as ["domain=rooms10"].
        room: its id; None: the first of the domain's.
    """
    cfg = composed("generate", *overrides)
    item = next(one for one in planned(cfg).tasks if room in (None, one.id))
    frames: list[DepthFrame] = []
    scanner = Scanner(cfg)
    made = scanner.cloud(item.load(), item.id, Keep(view=lambda _, *seen: frames.append(seen[1])))
    assert made.found is not None
    fullest = sorted(frames, key=lambda frame: -len(np.unique(frame.label)))[:_ROW]
    shown: list[Picture] = []
    for frame in fullest:
        low, high = np.nanpercentile(-frame.depth_m, [2, 98])
        near = value_image(-frame.depth_m, low, high, "gray")
        tint = 255 * colormaps["tab20"]((frame.label - 1) % 20)[..., :3]
        thing = (frame.label > 0) & np.isfinite(frame.depth_m)
        near[thing] = (0.45 * near[thing] + 0.55 * tint[thing]).astype(np.uint8)
        far = np.nanmax(frame.depth_m)
        shown.append((f"depth to {far:.1f} m, {len(np.unique(frame.label)) - 1} things", near))
    of_class = {
        found.cls: points for found, points in zip(made.found, made.arrays["points"], strict=True)
    }
    for cls, points in list(of_class.items())[: 2 * _ROW]:
        azimuth = AZIMUTH_DEG + turn_deg(points)
        size = np.ptp(points, axis=0).max()
        shown.append((f"{cls}, {size:.2f} m", cloud_image(points, _SIDE_PX, azimuth)))
    titles, images = zip(*shown, strict=True)
    words = f"{item.id}, {build(cfg.domain).label}"
    words += f": {len(made.found)} clouds of {len(frames)} pictures"
    return sheet(images, titles, columns=_ROW, heading=words, panel_in=_PANEL_IN)


def pipeline_figure(one: ScannedObject, view: int = 0) -> Figure:
    """Draw every stage of one object; its images are those of a view."""
    pictures, words = cloud_images(one), f"{one.name}, {one.domain}"
    if one.views:
        words += f", view {view} of {len(one.views)}"
        pictures = [*view_images(one.views[view].frame), *pictures]
    titles, images = zip(*pictures, strict=True)
    return sheet(images, titles, columns=4, heading=words, panel_in=_PANEL_IN)


def cloud_images(one: ScannedObject) -> list[Picture]:
    """The cloud, its clean twin and its residuals, with their titles."""
    azimuth = AZIMUTH_DEG
    if one.views:
        away = -one.views[0].world_from_camera[:3, 2]  # from the object to the first camera
        azimuth = float(np.rad2deg(np.arctan2(away[1], away[0]))) + _ASIDE_DEG
    kind = f"{len(one.views)} views fused" if one.views else "samples of the surface, no sensor"
    size = f"{len(one.cloud):,} points, {np.ptp(one.cloud, axis=0).max():.2f} m"
    found: list[Picture] = [
        (f"cloud: {kind}\n{size}", cloud_image(one.cloud, _SIDE_PX, azimuth)),
    ]
    if one.clean is not None:
        twin = cloud_image(one.clean, _SIDE_PX, azimuth)
        found.append(("clean twin: true depth, same views\ncolour is height", twin))
    residual = 1000 * one.residual_m  # mm
    median, most = np.percentile(np.abs(residual), [50, 95])
    share = np.clip(0.5 + 0.5 * residual / max(float(most), 0.1), 0, 1)
    words = (
        f"distance to the mesh\nhalf within {median:.1f} mm, 95 % within {most:.1f} mm\n"
        "blue is before it, red behind"
    )
    colours = colormaps["coolwarm"](share)[:, :3]
    return [*found, (words, cloud_image(one.cloud, _SIDE_PX, azimuth, colours))]
