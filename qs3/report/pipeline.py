"""One object on its way from mesh to cloud, and the figure that shows every stage.

Images are of one view; clouds are all views together, seen from the side of the camera. The bytes
are those that `generate.py` makes of the object.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from qs3.errors import ConfigError
from qs3.generation.kept import REASON_COLOURS, Keep, KeptView, load_views, photograph
from qs3.generation.plan import mesh_items
from qs3.meshes.io import Up, load_mesh
from qs3.meshes.mesh import Mesh, MeshItem
from qs3.report.datasets import distance_to_mesh
from qs3.sensors.optics.visibility import Reason
from qs3.utils.pictures import AZIMUTH_DEG, Image, cloud_image, sheet, value_image
from qs3.utils.seeding import object_rng

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_OFTEN_THERE = "chair/train/chair_0000"
_ASIDE_DEG = 40.0  # of the camera, so that errors of depth are seen
_SIDE_PX, _PANEL_IN = 800, 2.8
_BEFORE_BEHIND = ("#1f5fbf", "#b4bac3", "#c8321f")

Picture = tuple[str, Image | None]


@dataclass(frozen=True, eq=False)
class ScannedObject:
    """An object, its views and its clouds.

    Attributes:
        name: its id.
        domain: its label, and what was changed in its settings.
        sensor: class of the sensor; "" where the domain has none.
        renderer: its name; "" likewise.
        views: by number; none where the domain has no sensor.
        cloud: [P, 3] float32, metres: fused and sampled, as training gets it.
        clean: [P, 3] float32 its clean twin, or None.
        mesh: as it stood before the sensor.
    """

    name: str
    domain: str
    sensor: str
    renderer: str
    views: tuple[KeptView, ...]
    cloud: np.ndarray
    clean: np.ndarray | None
    mesh: Mesh

    def view(self, number: int) -> KeptView | None:
        """A view by its number; None where the domain has no sensor."""
        found = [view for view in self.views if view.number == number]
        if self.views and not found:
            raise ConfigError(f"view={number}: {self.name} has {len(self.views)} views")
        return found[0] if found else None

    def fused(self) -> Float[np.ndarray, "m 3"]:
        """What all views measured, before crop and sampling, in believed poses."""
        parts = [view.frame.points(view.frame.depth_m, view.believed) for view in self.views]
        return np.concatenate([*parts, np.zeros((0, 3))])

    @cached_property
    def residual_m(self) -> Float[np.ndarray, " p"]:
        """Distance of each point of `cloud` to the mesh.

        Positive behind the surface as the point's camera sees it, negative before it. Samples of
        a surface have no camera, and their distances no sign.
        """
        if not self.views:
            return distance_to_mesh(self.cloud, self.mesh)
        counts = [int(np.isfinite(view.frame.depth_m).sum()) for view in self.views]
        eyes = np.stack([view.believed[:3, 3] for view in self.views])
        _, nearest = cKDTree(self.fused()).query(self.cloud)  # the point itself, but for rounding
        return signed_distance_m(self.cloud, np.repeat(eyes, counts, axis=0)[nearest], self.mesh)


def signed_distance_m(
    points: Float[np.ndarray, "p 3"], eyes_m: Float[np.ndarray, "p 3"], mesh: Mesh
) -> Float[np.ndarray, " p"]:
    """Distance of points to a mesh, positive behind it as seen from the eyes.

    Behind is where going on, away from the eye, leads away from the nearest surface.
    """
    points = np.asarray(points, dtype=np.float64)

    away = points - eyes_m
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    found = distance_to_mesh(points, mesh)
    step = 0.1 * found[:, None] * away
    on, back = (distance_to_mesh(points + side * step, mesh) for side in (1, -1))
    return np.where(on >= back, found, -found)


def scan_object(
    overrides: Sequence[str], object_id: str | None = None, mesh: str | Path | None = None
) -> ScannedObject:
    """Run one object through a domain's recipe.

    Args:
        overrides: of generate.py, such as ["domain=specklenet10", "renderer=mitsuba"].
        object_id: which object; None: a chair, or the first there is.
        mesh: a mesh file to scan in place of the domain's objects.

    Raises:
        ConfigError: a setting is wrong, or there is no such object.
        MeshError, RenderError, DataError: it cannot be scanned.
    """
    from qs3.config.hydra import build
    from qs3.generation.scan import Scanner, composed_recipe

    cfg = composed_recipe(overrides)
    scanner = Scanner(cfg)
    recipe, domain = scanner.recipe, build(cfg.domain)
    if mesh is not None:
        path = Path(mesh).expanduser()
        up: Up = "y" if cfg.up == "y" else "z"
        load = partial(load_mesh, path, keep_colliders=cfg.colliders == "keep", up=up)
        item = MeshItem(object_id or path.stem, "", "train", load, path.name, path)
    else:
        items = {item.id: item for item in mesh_items(cfg)}
        name = object_id or (_OFTEN_THERE if _OFTEN_THERE in items else next(iter(items)))
        if name not in items:
            raise ConfigError(f"object={name} is not in the domain; it has {next(iter(items))}")
        item = items[name]
    loaded = item.load()
    looks = recipe.needs_renderer
    with tempfile.TemporaryDirectory(prefix="qs3-pipeline-") as folder:
        made = scanner.cloud(loaded, item.id, Keep(views=Path(folder)) if looks else Keep())
        views = load_views(Path(folder), item.id)
    shown = ("domain=", "renderer=", "paths.", "workers=")
    changed = [word for word in overrides if not word.startswith(shown)]
    return ScannedObject(
        name=item.id,
        domain=domain.label + (f" with {' '.join(changed)}" if changed else ""),
        sensor=type(recipe.sensor).__name__ if looks else "",
        renderer=str((cfg.get("renderer") or {}).get("name", "")),
        views=views,
        cloud=made.arrays["points"],
        clean=made.arrays.get("points_clean"),
        mesh=recipe.placing.place(loaded, object_rng(cfg.seed, item.id, 0), item.id),
    )


def pipeline_figure(one: ScannedObject, view: int = 0) -> Figure:
    """Draw every stage of one object; its images are those of a view."""
    from matplotlib.patches import Patch

    seen, words = one.view(view), f"{one.name}, {one.domain}"
    pictures = cloud_images(one)
    if seen is not None:
        by = f" rendered by {one.renderer.capitalize()}" if one.renderer else ""
        words += f": {one.sensor}{by}, {len(one.views)} views"
        pictures = [*view_images(seen), reason_image(seen), *pictures]
    figure = sheet(
        [picture for _, picture in pictures],
        [title for title, _ in pictures],
        columns=4,
        heading=words,
        panel_in=_PANEL_IN,
    )
    if seen is not None:
        shares = {kind: float((seen.frame.reason == kind).mean()) for kind in REASON_COLOURS}
        handles = [
            Patch(color=f"#{bytes(REASON_COLOURS[kind][::-1]).hex()}",
                  label=f"{'measured' if kind == Reason.OK else kind.name.lower()} {share:.1%}")
            for kind, share in shares.items() if share >= 0.0005
        ]  # fmt: skip
        figure.legend(handles=handles, loc="lower left", ncols=2, fontsize=7, frameon=False,
                      handlelength=1.0)  # fmt: skip
    return figure


def view_images(view: KeptView) -> list[Picture]:
    """Both images, disparity and depth of a view, with their titles."""
    frame, images = view.frame, view.frame.images
    second = "infrared, right" if "right" in images else "stored picture of the pattern"
    shown = (
        (f"view {view.number}: infrared", photograph(images), "", "gray"),
        (second, images.get("right", images.get("reference")), "", "gray"),
        ("disparity", images.get("disparity"), "px", "viridis"),
        ("depth as measured", frame.depth_m, "m", "viridis_r"),
    )
    found: list[Picture] = []
    for title, values, unit, colours in shown:
        if values is None or not np.isfinite(values).any():
            found.append((f"{title}: none", None))
            continue
        values = values.astype(np.float64)
        low, high = np.percentile(values[np.isfinite(values)], [1, 99])
        ends = ("blue", "yellow") if colours == "viridis" else ("yellow", "blue")
        words = f"{low:.2f} ({ends[0]}) to {high:.2f} {unit} ({ends[1]})"
        if not unit:  # a gamma, as a screen has one: the surface between the dots would be black
            values = (values / max(high, 1e-12)).clip(0, 1) ** 0.6
            low, high, words = 0, 1, f"{values.shape[1]} x {values.shape[0]} px"
        found.append((f"{title}\n{words}", value_image(values, low, high, colours)))
    return found


def reason_image(view: KeptView) -> Picture:
    """Why each pixel of a view has a depth or none, in `REASON_COLOURS`."""
    reason = view.frame.reason
    picture = np.zeros((*reason.shape, 3), dtype=np.uint8)
    for kind, bgr in REASON_COLOURS.items():
        picture[reason == kind] = bgr[::-1]
    return "why there is a depth or none\n\n\n", picture


def cloud_images(one: ScannedObject) -> list[Picture]:
    """The cloud, its clean twin and its residuals, with their titles."""
    from matplotlib.colors import LinearSegmentedColormap

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
    colours = LinearSegmentedColormap.from_list("before and behind", _BEFORE_BEHIND)(share)[:, :3]
    words = (
        f"distance to the mesh\nhalf within {median:.1f} mm, 95 % within {most:.1f} mm\n"
        "blue is before it, red behind"
    )
    found.append((words, cloud_image(one.cloud, _SIDE_PX, azimuth, colours)))
    return found
