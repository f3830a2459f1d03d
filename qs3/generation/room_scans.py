"""One view of an object in a room, cut out of the depth image as objects of real frames are cut.

`RoomScan` imitates how real single-view datasets come about (NYU Depth V2, SUN RGB-D): somebody
stands in a room, the object is somewhere in the picture, other things cover a part of it, an
annotator draws its mask, and `qs3.datasets.cutting` cuts by the same rules as it does there.
"""

from collections.abc import Mapping
from dataclasses import field, replace
from typing import Annotated, Literal

import numpy as np
from annotated_types import Interval
from jaxtyping import Bool
from pydantic import InstanceOf

from qs3.datasets.cutting import Rules, body, cut, measured_pixels, pieces
from qs3.datasets.depth_images import DepthImage, Pinhole
from qs3.errors import DataError
from qs3.generation.arrangements import Arrangement
from qs3.generation.camera_poses import direction
from qs3.generation.kept import Keep, provenance_of
from qs3.generation.materials import LightAbove, MixedMaterials
from qs3.generation.recipes import Cloud, MaskCrop
from qs3.generation.scenes import HAIR_M, Room, around_an_eye
from qs3.geometry.cameras import Intrinsics, look_at
from qs3.geometry.sampling import farthest_point_sampling_np
from qs3.meshes.mesh import Mesh
from qs3.meshes.placement import Placing, RealSize
from qs3.sensors.base import DepthFrame, DepthSensor
from qs3.sensors.renderers.base import Body, Renderer
from qs3.utils.seeding import object_rng
from qs3.utils.settings import Count, NotNegative, Positive, Share, settings

_BARE = Keep()
_AROUND_M = 0.3
"""The picture is taken so far around the object, for what covers its outline."""
_WORKTOP_M = 0.05
_WHOLE = (slice(0, None), slice(0, None))


@settings
class RoomCamera:
    """Somebody stands in a room; the object is anywhere in the picture."""

    min_height_m: float = 1.1  # above the floor
    max_height_m: float = 1.7
    min_distance_m: Positive = 1.3  # along the floor, from the object's middle
    max_distance_m: Positive = 4.5
    clearance_m: NotNegative = 0.6  # at least, from the circle around the object's footprint
    spread: Share = 0.85  # of the picture's half width and height, within which its middle lies
    min_pitch_deg: float = -5.0  # how far the camera looks down
    max_pitch_deg: float = 40.0
    roll_deg: NotNegative = 1.5  # standard deviation
    side_deg: Annotated[float, Interval(ge=0, le=180)] = 75.0  # from straight before a front

    def pose(
        self,
        rng: np.random.Generator,
        box_m: np.ndarray,
        lens: Intrinsics,
        front_rad: float | None = None,
    ) -> np.ndarray:
        """[4, 4] world_from_camera before an object with box [2, 3]; the floor is z = 0.

        `front_rad`: it is seen from within `side_deg` of this azimuth; None: from anywhere.
        """
        middle = box_m.mean(axis=0)
        radius = float(np.hypot(*(box_m[1] - box_m[0])[:2])) / 2
        away = max(rng.uniform(self.min_distance_m, self.max_distance_m), radius + self.clearance_m)
        azimuth = rng.uniform(0, 2 * np.pi)
        if front_rad is not None:
            azimuth = front_rad + np.deg2rad(self.side_deg) * (azimuth / np.pi - 1)
        height = rng.uniform(self.min_height_m, self.max_height_m)
        eye = np.array([*(middle[:2] + away * direction(azimuth, 0.0)[:2]), height])
        return self.looking(rng, eye, middle, away, azimuth, lens)

    def looking(
        self,
        rng: np.random.Generator,
        eye: np.ndarray,
        middle: np.ndarray,
        away: float,
        azimuth: float,
        lens: Intrinsics,
    ) -> np.ndarray:
        """[4, 4] world_from_camera at `eye` [3], `middle` [3] somewhere in the picture.

        `eye` stands `away` from it along the floor, in the direction `azimuth`.
        """
        half = np.array([lens.width_px, lens.height_px]) / (2 * lens.focal_px)
        right, down = np.arctan(rng.uniform(-self.spread, self.spread, 2) * half)
        pitch = np.arctan2(eye[2] - middle[2], away) - down
        low, high = np.deg2rad([self.min_pitch_deg, self.max_pitch_deg])
        ahead = direction(azimuth + np.pi + right, -float(np.clip(pitch, low, high)))
        pose = look_at(eye, eye + ahead)
        roll = np.deg2rad(rng.normal(0, self.roll_deg))
        turn = np.array(
            [[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]]
        )
        pose[:3, :3] = pose[:3, :3] @ turn
        return pose


@settings
class RoomScan:
    """Mesh to points through one depth image of a room.

    Attributes:
        sensor: that takes it.
        placing: of the mesh in the room, whose floor is z = 0.
        scene: what is around it, and under it if it is placed above the floor.
        arrangement: what people have put before it and on it; None: nothing.
        camera: where it is looked from.
        fronts: by class the probability that it stands with its back to a wall or away from people:
            its front is seen, which is -y of a mesh as made. Empty if nobody knows where yours is.
        mask: how carelessly the mask is drawn; its box is not used, nor its `margin_m`.
        rules: by which it is cut, and when it is refused.
        points: of the final cloud; a smaller one repeats points.
        torn: probability that of an object which depth edges tear apart only one piece is cut, as
            where masks are split at jumps of the depth.
        worktops: by class the probability that its top is not its own, as where kitchens' worktops
            are labelled as counters.
        attempts: pictures that are taken, each from elsewhere, until one is not refused.
        clean: also make the twin from the true depth of what is seen.
        materials, light: as in `Mesh2Point`; the object has the same materials in every picture.
        views: 1, the only number of views there is.
    """

    sensor: InstanceOf[DepthSensor]
    placing: Placing = field(default_factory=RealSize)
    scene: InstanceOf[Room] = field(default_factory=Room)
    arrangement: InstanceOf[Arrangement] | None = None
    camera: InstanceOf[RoomCamera] = field(default_factory=RoomCamera)
    fronts: Mapping[str, Share] = field(default_factory=dict)
    mask: InstanceOf[MaskCrop] = field(default_factory=MaskCrop)
    rules: InstanceOf[Rules] = field(default_factory=Rules)
    points: Count = 2048
    torn: Share = 0.0
    worktops: Mapping[str, Share] = field(default_factory=dict)
    attempts: Count = 12
    clean: bool = True
    views: Literal[1] = 1
    materials: InstanceOf[MixedMaterials] | None = None
    light: LightAbove | None = None
    needs_renderer: bool = True

    def make(
        self, mesh: Mesh, object_id: str, seed: int, renderer: Renderer | None, keep: Keep = _BARE
    ) -> Cloud:
        """See Recipe.make."""
        assert renderer is not None
        cls = object_id.split("/")[0]
        placed = self.placing.place(mesh, object_rng(seed, object_id, 0), object_id)
        front = yaw_between(mesh, placed) - np.pi / 2
        around = placed.bounds + np.array([[-_AROUND_M], [_AROUND_M]])
        lighting = None if self.light is None else self.light.over(placed.bounds)
        why = "it is outside the picture"
        for attempt in range(self.attempts):
            rng = object_rng(seed, object_id, 1 + attempt)
            arranging = object_rng(seed, object_id, 1 + attempt, 2)
            seen = front if arranging.random() < self.fronts.get(cls, 0.0) else None
            pose = self.camera.pose(rng, placed.bounds, self.sensor.intrinsics, seen)
            bodies = self._bodies(placed, cls, pose, rng, arranging)
            if self.materials is not None:
                bodies = self.materials.dress(bodies, object_rng(seed, object_id, 0, 1))
            explain = keep.view is not None
            frame = self.sensor.scan(bodies, around, pose, renderer, rng, explain, lighting)
            if frame is None:
                continue
            image, mask = depth_image(frame, pose), self.mask.keep(frame, rng)
            if arranging.random() < self.worktops.get(cls, 0.0):
                top = placed.bounds[1, 2] - pose[2, 3]  # over the camera, as the image's points are
                mask &= ~(image.points_m[..., 2] > top - _WORKTOP_M)
            rules, edge_px = self.rules, None
            apart = object_rng(seed, object_id, 1 + attempt, 1)  # not of those that exist without
            if apart.random() < self.torn:
                measured, _ = measured_pixels(image, mask, rules)
                own = body(pieces(measured, image.depth_m, rules), image.points_m, rules)
                mask, edge_px = one_piece(image, own, cls, rules, apart), 0
                rules = replace(rules, join_m=0.0)
            piece = cut(image, mask, cls, rules, edge_px)
            if not piece.refused:
                assert piece.own is not None
                return self._cloud(frame, piece.own, pose, object_id, keep)
            why = piece.why
        raise DataError(
            f"none of {self.attempts} pictures (recipe.attempts) shows it well enough; "
            f"of the last one: {why}"
        )

    def _bodies(
        self,
        placed: Mesh,
        cls: str,
        pose: np.ndarray,
        rng: np.random.Generator,
        arranging: np.random.Generator,
    ) -> tuple[Body, ...]:
        """The scene's, the object first, and the arrangement's, none of it around the camera."""
        eyes = pose[None, :3, 3]
        bodies = self.scene.bodies(placed, eyes, rng, floor_m=0.0)
        if self.arrangement is None:
            return bodies
        support = bodies[2].mesh if placed.bounds[0, 2] > HAIR_M else None
        more = self.arrangement.around(placed, cls, arranging, support)
        more = [mesh for mesh in more if not around_an_eye(mesh, eyes)]
        albedo = arranging.uniform(
            self.arrangement.min_albedo, self.arrangement.max_albedo, len(more)
        )
        return bodies + tuple(
            Body(mesh, albedo=float(a), label=0) for mesh, a in zip(more, albedo, strict=True)
        )

    def _cloud(
        self, frame: DepthFrame, own: np.ndarray, pose: np.ndarray, object_id: str, keep: Keep
    ) -> Cloud:
        """Points of the pixels `own`, sampled; the twin has the same pixels where they are true."""
        depth = np.where(own, frame.depth_m, np.nan)
        points = frame.points(depth, pose).astype(np.float32)
        order = farthest_point_sampling_np(points, self.points)
        arrays = {"points": points[order]}
        if self.clean:
            true = frame.points(np.where(own & (frame.label == 1), frame.clean_m, np.nan), pose)
            if not len(true):
                raise DataError("no pixel that was cut shows the object")
            true = true.astype(np.float32)
            arrays["points_clean"] = true[farthest_point_sampling_np(true, self.points)]
        if keep.provenance:
            arrays["provenance"] = provenance_of(frame, depth, 0)[order]
        if keep.view is not None:
            keep.view(object_id, 0, frame, pose, pose)
        return Cloud(arrays, 1, len(points), (frame,))


def yaw_between(mesh: Mesh, placed: Mesh) -> float:
    """By how much, in radians counter-clockwise from above, `placed` is a mesh turned about z."""
    before, after = (m.vertices[:, 0] + 1j * m.vertices[:, 1] for m in (mesh, placed))
    return float(np.angle(np.vdot(before - before.mean(), after - after.mean())))


def one_piece(
    image: DepthImage,
    own: Bool[np.ndarray, "h w"],
    cls: str,
    rules: Rules,
    rng: np.random.Generator,
) -> Bool[np.ndarray, "h w"]:
    """One of the pieces of an object's pixels that are large enough for its class, or the largest.

    Nothing is joined: what a depth edge parts is two pieces, however near to each other they are.
    """
    number = pieces(own, image.depth_m, rules)
    sizes = np.bincount(number[own])
    enough = np.flatnonzero(sizes >= rules.limits_of(cls).pixels)
    return number == (rng.choice(enough) if len(enough) else 0)


def depth_image(
    frame: DepthFrame, world_from_camera: np.ndarray, window: tuple[slice, slice] = _WHOLE
) -> DepthImage:
    """Rows and columns of a frame as `qs3.datasets.frames` sees a picture, with its rotation."""
    lens, step = frame.camera.intrinsics, frame.step_px
    focal, (rows, columns) = lens.focal_px / step, window
    camera = Pinhole(
        focal,
        focal,
        (lens.cx_px - frame.left) / step - columns.start,
        (lens.cy_px - frame.top) / step - rows.start,
    )
    depth = np.nan_to_num(frame.depth_m[window], nan=0.0)
    return DepthImage(depth, camera, world_from_camera[:3, :3])
