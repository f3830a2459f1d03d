"""Recipes: how a domain turns one mesh into one point cloud.

`Mesh2Point` is the paper's pipeline (section 3.1, figure 2): place, look from several
views, measure depth, back-project, crop, fuse, sample. `SurfaceSamples` is what ModelNet10
and its dropout variant are. Both are plain values, so that they can be sent to workers and
written into a dataset's recipe file.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple, Protocol

import cv2
import numpy as np
from annotated_types import Ge
from pydantic import InstanceOf

from qs3.errors import ConfigError, DataError
from qs3.generation.camera_poses import AnchoredViews, Drift, Views
from qs3.generation.kept import Keep, provenance_of
from qs3.generation.materials import LightAbove, Principled
from qs3.generation.released import PoseTable, ReleasedPlacing, ReleasedViews, box_of_corners
from qs3.generation.scenes import Alone, Surroundings
from qs3.geometry.sampling import farthest_point_sampling_np, surface_sample
from qs3.meshes.mesh import Mesh
from qs3.meshes.placement import Placing, UnitCube
from qs3.sensors.base import DepthFrame, DepthSensor
from qs3.sensors.renderers.base import Renderer
from qs3.utils.seeding import object_rng
from qs3.utils.settings import Count, NotNegative, Share, settings

_BARE = Keep()
_SPARE = 5  # times as many samples as wanted, of which regions may take all but a fifth

Least = Annotated[int, Ge(0)]


class Found(NamedTuple):
    """What one cloud of a room shows: its class, the mesh, and points before sampling."""

    cls: str
    origin: str
    mesh_sha256: str
    valid_points: int


@dataclass(frozen=True, eq=False)
class Cloud:
    """What a recipe makes of one mesh.

    `arrays` are [P, 3] float32 by name: "points", and "points_clean" where there is a twin; where
    it was asked for also "provenance" [P, 5] of "points". Of a room, "points" are [k, P, 3], and
    `found` says what each shows.
    """

    arrays: Mapping[str, np.ndarray]
    views: int  # that gave points
    valid_points: int  # before sampling
    frames: tuple[DepthFrame, ...] = ()  # for looking at
    found: tuple[Found, ...] | None = None  # of a room


class Recipe(Protocol):
    """Turns a mesh into a cloud, the same bytes for the same (seed, object id)."""

    points: int
    needs_renderer: bool

    def make(
        self, mesh: Mesh, object_id: str, seed: int, renderer: Renderer | None, keep: Keep = _BARE
    ) -> Cloud:
        """Make the cloud; DataError or RenderError give the reason if not.

        `keep` asks for more than the cloud and never changes it.
        """
        ...


@settings
class BoxCrop:
    """Keep the points in the object's axis-aligned box, enlarged by a margin.

    The released code has no margin: of a face that lies in the box's side only the errors that
    point inwards survive. 3 cm are 4.7 standard deviations of the paper's sensor at 3 m, 1.67 at
    5 m (docs/reference/planes.csv).
    """

    margin_m: NotNegative = 0.03

    def keep(self, frame: DepthFrame, rng: np.random.Generator) -> np.ndarray | None:
        """[h, w] bool in the image; None: the box alone decides, after back-projection."""
        return None

    def inside(self, points: np.ndarray, box_m: np.ndarray) -> np.ndarray:
        """[M] bool for points [M, 3] in the world and the object's box [2, 3]."""
        low, high = box_m[0] - self.margin_m, box_m[1] + self.margin_m
        return ((points >= low) & (points <= high)).all(axis=1)


@settings
class MaskCrop(BoxCrop):
    """Keep the pixels of the object's mask and box, drawn as sloppily as annotations are.

    The mask of what is really seen grows or shrinks by a few pixels and is shifted; of the
    background that comes in, the box keeps what is near the object. Pixels are those of the depth
    image: with `step_px=4` one is four of the camera's.
    """

    margin_m: NotNegative = 0.1  # by which the object's axis-aligned box is enlarged
    min_grow_px: int = -1  # by which the mask's outline moves outwards, a whole number
    max_grow_px: int = 3
    max_shift_px: Least = 2  # of the mask along each axis

    def keep(self, frame: DepthFrame, rng: np.random.Generator) -> np.ndarray:
        """[h, w] bool."""
        return self.drawn(frame.label == 1, rng)

    def drawn(self, seen: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """[h, w] bool: as somebody draws the mask `seen`."""
        mask: np.ndarray = seen.astype(np.uint8)
        grow = int(rng.integers(self.min_grow_px, self.max_grow_px + 1))
        shift = rng.integers(-self.max_shift_px, self.max_shift_px + 1, 2)
        if grow:
            size = 2 * abs(grow) + 1
            kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
            mask = (cv2.dilate if grow > 0 else cv2.erode)(mask, kernel)
        move = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], dtype=np.float64)
        mask = cv2.warpAffine(mask, move, mask.shape[::-1], flags=cv2.INTER_NEAREST)
        return mask.astype(bool)


@settings
class Mesh2Point:
    """Mesh to points through a simulated depth sensor.

    Attributes:
        points: of the final cloud, by farthest point sampling (paper: 2,048). A cloud with
            fewer measured points repeats some.
        min_points: objects with fewer measured points over all views are recorded as failed.
        min_view_points: frames with fewer points are left out.
        clean: also make the twin from the true depth at the same views (the paper's S_c).
        min_clean_points: as `min_points`, of the twin; None: the same. A thin lamp may give
            few: a matcher's patches make thin parts wide, the true depth does not.
        poses: from a file, in place of `placing` and of `views` (whose count is kept).
        materials: of the bodies; None: as the scene has them, matt.
        light: in addition to the sensor's own.
        box_of_corners: crop by the box of the turned corners of the mesh's own box, as the
            released code does, and not by the object's own axis-aligned box.
    """

    sensor: InstanceOf[DepthSensor]
    placing: Placing = field(default_factory=UnitCube)
    scene: Surroundings = field(default_factory=Alone)
    views: Views = field(default_factory=AnchoredViews)
    drift: InstanceOf[Drift] = field(default_factory=Drift)
    crop: InstanceOf[BoxCrop] = field(default_factory=BoxCrop)
    points: Count = 2048
    min_points: Least = 128
    min_view_points: Least = 1
    clean: bool = True
    min_clean_points: Least | None = None
    poses: InstanceOf[PoseTable] | None = None
    materials: Principled | None = None
    light: LightAbove | None = None
    box_of_corners: bool = False
    needs_renderer: bool = True

    def __post_init__(self) -> None:
        if self.poses is not None:
            object.__setattr__(self, "placing", ReleasedPlacing(self.poses))
            object.__setattr__(self, "views", ReleasedViews(self.poses, self.views.count))

    def make(
        self, mesh: Mesh, object_id: str, seed: int, renderer: Renderer | None, keep: Keep = _BARE
    ) -> Cloud:
        """See Recipe.make."""
        assert renderer is not None
        rng = object_rng(seed, object_id, 0)
        placed = self.placing.place(mesh, rng, object_id)
        box = placed.bounds
        crop_box = box_of_corners(mesh, placed) if self.box_of_corners else box
        pose_rng = object_rng(seed, object_id, 1)
        true_poses = self.views.poses(pose_rng, box, object_id)
        bodies = self.scene.bodies(placed, np.stack(true_poses)[:, :3, 3], rng)
        if self.materials is not None:
            bodies = self.materials.dress(bodies)
        lighting = None if self.light is None else self.light.over(box)
        believed_poses = self.drift.believed(true_poses, pose_rng)

        noisy, clean, frames, origins = [], [], [], []
        for i, (pose, believed) in enumerate(zip(true_poses, believed_poses, strict=True)):
            view_rng = object_rng(seed, object_id, 2 + i)
            explain = keep.view is not None
            frame = self.sensor.scan(bodies, box, pose, renderer, view_rng, explain, lighting)
            if frame is None:
                continue
            frames.append(frame)
            if keep.view is not None:
                keep.view(object_id, i, frame, pose, believed)
            mask = self.crop.keep(frame, view_rng)
            depth = frame.depth_m if mask is None else np.where(mask, frame.depth_m, np.nan)
            points = frame.points(depth, believed)
            # A box is known in the world; with drift the cloud and the box part company,
            # as they do when a scan is cropped by an annotation made on the fused model.
            inside = self.crop.inside(points, crop_box)
            points = points[inside]
            if len(points) >= self.min_view_points:
                noisy.append(points)
                if keep.provenance:
                    origins.append(provenance_of(frame, depth, i)[inside])
            if self.clean:
                seen = np.where(frame.label == 1, frame.clean_m, np.nan)
                clean.append(frame.points(seen, pose))

        fused, order = self._sample(noisy, "min_points")
        arrays = {"points": fused[order]}
        if self.clean:
            least = "min_points" if self.min_clean_points is None else "min_clean_points"
            true, true_order = self._sample(clean, least)
            arrays["points_clean"] = true[true_order]
        if keep.provenance:
            arrays["provenance"] = np.concatenate(origins)[order]
        return Cloud(arrays, len(noisy), sum(map(len, noisy)), tuple(frames))

    def _sample(self, parts: list[np.ndarray], least: str) -> tuple[np.ndarray, np.ndarray]:
        """All points [M, 3] float32, and which of them make the cloud: [P] indices."""
        total, wanted = sum(map(len, parts)), getattr(self, least)
        if total < max(wanted, 1):
            raise DataError(
                f"{total} points over {self.views.count} views, fewer than recipe.{least}={wanted}"
            )
        fused = np.concatenate(parts).astype(np.float32)
        return fused, farthest_point_sampling_np(fused, self.points)


@settings
class RegionDropout:
    """Holes in a surface sample, to imitate missing parts (the paper's M_d).

    The paper gives no parameters; these are ours: one to three balls around random points
    of the cloud, each emptying a share of the cloud. All together take four fifths at most.
    """

    min_regions: Least = 1
    max_regions: Least = 3
    min_share: Share = 0.1
    max_share: Share = 0.25

    def __post_init__(self) -> None:
        if self.max_regions * self.max_share > 1 - 1 / _SPARE:  # too few points would be left
            raise ConfigError("recipe.dropout: max_regions * max_share must be at most 0.8")

    def apply(self, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """The points [N, 3] that remain; each region takes its share of the N."""
        total = len(points)
        for _ in range(int(rng.integers(self.min_regions, self.max_regions + 1))):
            share = rng.uniform(self.min_share, self.max_share)
            centre = points[int(rng.integers(len(points)))]
            distance = ((points - centre) ** 2).sum(axis=1)
            order = np.argsort(distance, kind="stable")
            points = points[np.sort(order[int(share * total) :])]
        return points


@settings
class SurfaceSamples:
    """Uniform samples of the whole surface, as in ModelNet10 (M) and its dropout (M_d)."""

    placing: Placing = field(default_factory=UnitCube)
    dropout: InstanceOf[RegionDropout] | None = None
    points: Count = 2048
    needs_renderer: bool = False

    def make(
        self, mesh: Mesh, object_id: str, seed: int, renderer: Renderer | None, keep: Keep = _BARE
    ) -> Cloud:
        """See Recipe.make."""
        rng = object_rng(seed, object_id, 0)
        placed = self.placing.place(mesh, rng, object_id)
        drawn = self.points if self.dropout is None else _SPARE * self.points
        points = surface_sample(placed.vertices, placed.faces, drawn, rng)
        if self.dropout is not None:
            points = self.dropout.apply(points, rng)
            points = points[np.sort(rng.permutation(len(points))[: self.points])]
        points = points.astype(np.float32)
        return Cloud({"points": points}, views=0, valid_points=len(points))
