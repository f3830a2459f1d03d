"""Rooms as people scan them: every labelled thing that a picture shows well becomes a cloud.

`Rooms` imitates how real single-view datasets come about (NYU Depth V2, SUN RGB-D): somebody
stands in a furnished room and takes depth images from several places, an annotator draws masks, and
`qs3.datasets.cutting` cuts by the same rules as it does there.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field, replace

import numpy as np
from jaxtyping import Bool
from pydantic import InstanceOf

from qs3.datasets.cutting import Rules, cut, inliers, measured_pixels, pieces
from qs3.datasets.depth_images import DepthImage, Pinhole
from qs3.generation.camera_poses import direction
from qs3.generation.furnishing import Furnished, Furnishing, Thing
from qs3.generation.kept import Keep
from qs3.generation.recipes import Cloud, Found, MaskCrop
from qs3.geometry.cameras import Camera, Intrinsics, look_at
from qs3.geometry.sampling import farthest_point_sampling_np
from qs3.meshes.mesh import MeshItem
from qs3.meshes.placement import RealSize
from qs3.sensors.base import DepthFrame, DepthSensor, Shot
from qs3.sensors.renderers.base import Body, Renderer
from qs3.utils.seeding import object_rng
from qs3.utils.settings import Count, NotNegative, Positive, Share, settings

_BARE = Keep()
_AROUND_PX = 10  # of an object's pixels, for what covers its outline and for careless masks
_WORKTOP_M = 0.05
_APART_M = 0.3  # of a camera from what stands in the room
_FROM_WALL_M = 0.15
_STANDS = 12  # tries
_MOST_THINGS = 250  # labels of pixels have 8 bits


@settings
class StandingCamera:
    """Somebody stands in a furnished room; the thing is anywhere in the picture."""

    min_height_m: float = 1.1  # above the floor
    max_height_m: float = 1.7
    min_distance_m: Positive = 1.3  # along the floor, from the thing's middle
    max_distance_m: Positive = 4.5
    clearance_m: NotNegative = 0.6  # at least, from the circle around the thing's footprint
    spread: Share = 0.85  # of the picture's half width and height, within which its middle lies
    min_pitch_deg: float = -5.0  # how far the camera looks down
    max_pitch_deg: float = 40.0
    roll_deg: NotNegative = 1.5  # standard deviation
    small_m: Positive = 0.35  # distances shrink with things whose largest side is below

    def before(
        self, rng: np.random.Generator, thing: Thing, room: Furnished, lens: Intrinsics
    ) -> np.ndarray | None:
        """[4, 4] world_from_camera; None where there is no place to stand."""
        box = thing.mesh.bounds
        middle, sides = box.mean(axis=0), np.ptp(box, axis=0)
        radius, near = float(np.hypot(*sides[:2])) / 2, min(1.0, sides.max() / self.small_m)
        standing = [*(t.mesh for t in room.things), *room.others]
        low, high = np.stack([mesh.bounds for mesh in standing]).transpose(1, 0, 2)
        for _ in range(_STANDS):
            away = near * rng.uniform(self.min_distance_m, self.max_distance_m)
            away, azimuth = max(away, radius + near * self.clearance_m), rng.uniform(0, 2 * np.pi)
            height = rng.uniform(self.min_height_m, self.max_height_m)
            eye = np.array([*(middle[:2] + away * direction(azimuth, 0.0)[:2]), height])
            inside = (eye[:2] > _FROM_WALL_M) & (eye[:2] < room.size_m - _FROM_WALL_M)
            hit = ((eye > low - _APART_M) & (eye < high + _APART_M)).all(axis=1).any()
            if inside.all() and not hit:
                return self._looking(rng, eye, middle, away, azimuth, lens)
        return None

    def _looking(
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
class Rooms:
    """A room of meshes to the clouds of what its pictures show well.

    Attributes:
        sensor: that takes the pictures, whole.
        furnishing: of each room.
        camera: where pictures are taken from.
        views: pictures of a room. Each is aimed at a thing of the class with the fewest clouds yet.
        most: clouds of a class and room, times its share.
        shares: how common classes are among things and clouds, relative to each other; 1 of a class
            that is not here.
        mask: how carelessly masks are drawn; its box is not used, nor its `margin_m`.
        rules: by which things are cut, and when they are refused.
        drawn: at most so many of an object's pixels, at random and without outliers, as archives of
            cut objects hold.
        points: of a cloud, the farthest of these; a smaller one repeats points.
        by_class: probability that a picture has masks of classes and not of things, as NYU Depth V2
            has: what depth edges part is several objects then, and what touches is one.
        worktops: by class the probability that its top is not its own, as where kitchens' worktops
            are labelled as counters.
        shelves: the meshes that rooms of a split are furnished from.
    """

    sensor: InstanceOf[DepthSensor]
    furnishing: InstanceOf[Furnishing] = field(default_factory=Furnishing)
    camera: InstanceOf[StandingCamera] = field(default_factory=StandingCamera)
    most: Count = 4
    shares: Mapping[str, NotNegative] = field(default_factory=dict)
    mask: InstanceOf[MaskCrop] = field(default_factory=MaskCrop)
    rules: InstanceOf[Rules] = field(default_factory=Rules)
    drawn: Count = 2048
    points: Count = 1024
    by_class: Share = 0.5
    worktops: Mapping[str, Share] = field(default_factory=dict)
    shelves: Mapping[str, tuple[InstanceOf[MeshItem], ...]] = field(default_factory=dict)
    views: Count = 10
    needs_renderer: bool = True

    @property
    def placing(self) -> RealSize:
        """How meshes are scaled."""
        return self.furnishing.placing

    def make(
        self, split: str, room_id: str, seed: int, renderer: Renderer | None, keep: Keep = _BARE
    ) -> Cloud:
        """The clouds of one room, which is furnished from the meshes of a split."""
        assert renderer is not None
        rng = object_rng(seed, room_id, 0)
        room = self.furnishing.furnish(_Shelf(self.shelves[split], self.shares).draw, rng)
        things = room.things[:_MOST_THINGS]
        others = [Body(mesh, label=0) for mesh in (*room.others, *room.shell)]
        bodies = (*(Body(thing.mesh, label=1 + k) for k, thing in enumerate(things)), *others)
        clouds: list[np.ndarray] = []
        found: list[Found] = []
        counts, looks = Counter[str](), np.zeros(len(things))
        share = {thing.cls: max(self.shares.get(thing.cls, 1.0), 1e-9) for thing in things}
        for view in range(self.views if things else 0):
            rng = object_rng(seed, room_id, 1 + view)
            fewest = [counts[thing.cls] / share[thing.cls] for thing in things] + 0.1 * looks
            aim = int(np.argmin(fewest))
            looks[aim] += 1
            pose = self.camera.before(rng, things[aim], room, self.sensor.intrinsics)
            if pose is None:
                continue
            camera, box = Camera(self.sensor.intrinsics, pose), things[aim].mesh.bounds
            shot = Shot(camera, bodies, box, renderer, rng, keep.view is not None)
            frame = self.sensor.take(shot)
            if frame is None:
                continue
            if keep.view is not None:
                keep.view(room_id, view, frame, pose, pose)
            full = {cls for cls in share if counts[cls] >= self.most * share[cls]}
            for thing, points in self._cut(frame, pose, things, full, rng):
                if counts[thing.cls] < self.most * share[thing.cls]:
                    counts[thing.cls] += 1
                    found.append(Found(thing.cls, thing.item.origin, thing.sha256, len(points)))
                    few = min(self.drawn, len(points))
                    points = points[np.sort(rng.choice(len(points), few, replace=False))]
                    points = points[inliers(points, self.rules)]
                    clouds.append(points[farthest_point_sampling_np(points, self.points)])
        return Cloud({"points": np.stack(clouds)} if clouds else {}, 1, 0, (), tuple(found))

    def _cut(
        self,
        frame: DepthFrame,
        pose: np.ndarray,
        things: list[Thing],
        full: set[str],
        rng: np.random.Generator,
    ) -> Iterator[tuple[Thing, np.ndarray]]:
        """Things that a frame shows well, each with its points [n, 3] float32 above the floor.

        None of the classes that are `full`.
        """
        pixels = np.bincount(frame.label.ravel(), minlength=1 + len(things))[1:]
        groups: list[list[int]] = [[k] for k in range(len(things))]
        apart = rng.random() >= self.by_class
        if not apart:
            names = [thing.cls for thing in things]
            groups = [
                [k for k in range(len(names)) if names[k] == cls] for cls in dict.fromkeys(names)
            ]
        for group in groups:
            cls = things[group[0]].cls
            rules = replace(self.rules, outlier_sds=0.0)  # looked for among the few that are drawn
            if cls in full or pixels[group].sum() < rules.limits_of(cls).pixels:
                continue
            seen = np.isin(frame.label, np.array(group) + 1)
            window = _around(seen)
            image, label = _depth_image(frame, pose, window), frame.label[window]
            mask, edge_px = self.mask.drawn(seen[window], rng), None
            if rng.random() < self.worktops.get(cls, 0.0):
                top = max(things[k].mesh.bounds[1, 2] for k in group) - pose[2, 3]
                mask &= ~(image.points_m[..., 2] > top - _WORKTOP_M)
            masks = [mask]
            if not apart:
                masks = list(parts(image, mask, cls, rules))
                rules, edge_px = replace(rules, join_m=0.0), 0
            for mask in masks:
                piece = cut(image, mask, cls, rules, edge_px)
                if not piece.refused:
                    most = np.bincount(label[mask], minlength=1 + len(things))[np.array(group) + 1]
                    over = np.array([0, 0, pose[2, 3]], dtype=np.float32)
                    yield things[group[int(most.argmax())]], piece.points_m + over


def parts(
    image: DepthImage, mask: Bool[np.ndarray, "h w"], cls: str, rules: Rules
) -> Iterator[Bool[np.ndarray, "h w"]]:
    """What depth edges part of a class's pixels and is large enough, each as a mask of its own."""
    measured, _ = measured_pixels(image, mask, rules)
    number = pieces(measured, image.depth_m, rules)
    sizes = np.bincount(number[measured])
    for k in np.flatnonzero(sizes >= rules.limits_of(cls).pixels):
        yield number == k


def _depth_image(
    frame: DepthFrame, world_from_camera: np.ndarray, window: tuple[slice, slice]
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


def _around(seen: Bool[np.ndarray, "h w"]) -> tuple[slice, slice]:
    """Rows and columns of what is seen, and a little around it."""
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    return (
        slice(max(rows[0] - _AROUND_PX, 0), rows[-1] + _AROUND_PX + 1),
        slice(max(columns[0] - _AROUND_PX, 0), columns[-1] + _AROUND_PX + 1),
    )


class _Shelf:
    """Meshes of each class, drawn by shares."""

    def __init__(self, items: Sequence[MeshItem], shares: Mapping[str, float]) -> None:
        self._of: dict[str, list[MeshItem]] = {}
        for item in items:
            self._of.setdefault(item.cls, []).append(item)
        weights = np.array([shares.get(cls, 1.0) for cls in self._of])
        self._classes, self._shares = list(self._of), weights / weights.sum()

    def draw(self, rng: np.random.Generator) -> MeshItem:
        own = self._of[self._classes[int(rng.choice(len(self._classes), p=self._shares))]]
        return own[int(rng.integers(len(own)))]
