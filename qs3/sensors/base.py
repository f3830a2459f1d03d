"""Depth sensors: what one is asked for, what it gives back, and what all of them share."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from qs3.geometry.cameras import Camera, Intrinsics, Window, project
from qs3.sensors.matching import Match, StereoBlockMatcher
from qs3.sensors.matching.base import found_px
from qs3.sensors.matching.filters import PostFilter, Quantiser
from qs3.sensors.optics.visibility import Reason, explained, reached_from
from qs3.sensors.renderers.base import AreaLight, Body, Image, Projector, Renderer, Scene
from qs3.utils.settings import Count, Positive, settings


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """One depth image of a part of a scene, on a regular grid of pixels.

    Attributes:
        camera: where it was taken from.
        left, top: pixel of the first sample; (r, c) is pixel (left + c step_px, top + r step_px).
        step_px: spacing of the samples in pixels of the camera.
        depth_m: [h, w] float32 as measured, NaN where nothing was.
        clean_m: [h, w] float32 true depth at the same pixels, inf where nothing is hit.
        label: [h, w] uint8, Body.label of what is seen, 0 where nothing is.
        cosine: [h, w] float32 of the angle of incidence, 0 where nothing is.
        reason: [h, w] uint8 `Reason`. Shadow and occlusion are told apart from other causes only
            if the scan was asked to `explain`.
        images: intermediate pictures by name ("left", "right", "disparity", ...), of the size of
            the rendered window.
    """

    camera: Camera
    left: int
    top: int
    step_px: int
    depth_m: np.ndarray
    clean_m: np.ndarray
    label: np.ndarray
    cosine: np.ndarray
    reason: np.ndarray
    images: dict[str, np.ndarray] = field(default_factory=dict)

    def points(self, depth_m: np.ndarray, world_from_camera: np.ndarray) -> np.ndarray:
        """Back-project `depth_m` [h, w] to [M, 3] float64 points in the world, row by row.

        `world_from_camera` [4, 4] is the pose that is believed: a drifting one or the true. Pixels
        that are not finite are left out.
        """
        rows, cols = np.nonzero(np.isfinite(depth_m))
        k = self.camera.intrinsics
        z = depth_m[rows, cols].astype(np.float64)
        x = (self.left + cols * self.step_px - k.cx_px) / k.focal_px * z
        y = (self.top + rows * self.step_px - k.cy_px) / k.focal_px * z
        local = np.stack([x, y, z], axis=1)
        return local @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]


@dataclass(frozen=True)
class Samples:
    """Every step-th pixel of every step-th row of a window; `left`, `top` are the first one's."""

    left: int
    top: int
    step_px: int
    grid: tuple[slice, slice]

    def of(self, image: np.ndarray) -> np.ndarray:
        """The samples of an image [h, w] of the window."""
        return np.ascontiguousarray(image[self.grid])


@dataclass(frozen=True, eq=False)
class Lighting:
    """Light of the place where the device stands, next to the device's own.

    Attributes:
        area: a light with shadows.
        ambient: radiance of light from all sides, in place of the sensor's `ambient` and in its
            units; None: that.
    """

    area: AreaLight | None = None
    ambient: float | None = None


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame in the making: what `DepthSensor.scan` was given, its window in `camera`."""

    camera: Camera
    bodies: tuple[Body, ...]
    box_m: np.ndarray
    renderer: Renderer
    rng: np.random.Generator
    explain: bool
    lighting: Lighting | None = None

    def seed(self) -> int:
        """A seed for the renderer, drawn from `rng`."""
        return int(self.rng.integers(2**31))

    def scene(self, projector: Projector | None, ambient: float) -> Scene:
        """The bodies in the sensor's light and in that of the place; `ambient` is the sensor's."""
        place = self.lighting or Lighting()
        ambient = ambient if place.ambient is None else place.ambient
        return Scene(self.bodies, projector, ambient, place.area)

    def image(
        self, projector: Projector | None = None, ambient: float = 0.0, seed: int | None = None
    ) -> Image:
        """What the camera sees, with the geometry; without a `seed` it draws one."""
        scene, seed = self.scene(projector, ambient), self.seed() if seed is None else seed
        (image,) = self.renderer.render(scene, [self.camera], seed=seed, geometry=[True])
        return image

    def pose_at(self, right_m: float) -> np.ndarray:
        """[4, 4] pose of a device so far right of the camera, looking the same way."""
        return self.camera.moved((right_m, 0.0, 0.0)).world_from_camera

    def reached_from(self, world_from_source: np.ndarray) -> np.ndarray:
        """[h, w] bool: whether a surface is seen, and can be seen from another pose, too."""
        return reached_from(self.bodies, self.camera, world_from_source, self.renderer)

    def explained(
        self,
        reason: np.ndarray,
        pictures: dict[str, np.ndarray],
        projector: np.ndarray,
        other: np.ndarray | None = None,
    ) -> np.ndarray:
        """Put shadow and occlusion before `reason` [h, w] uint8 where `explain` asks for it.

        `pictures` has "clean" and gets "lit" and, with another camera, "seen"; `projector` and
        `other` are the poses [4, 4] of the projector and of that camera.
        """
        if not self.explain:
            return reason
        pictures["lit"] = self.reached_from(projector)
        if other is not None:
            pictures["seen"] = self.reached_from(other)
        return explained(reason, pictures["clean"], pictures["lit"], pictures.get("seen"))

    def samples(self, step_px: int = 1, offset_px: int | None = None) -> Samples:
        """Samples of the window, on one grid over the whole image; see `on_grid`."""
        window = self.camera.rendered
        left, columns = on_grid(window.left, window.width, step_px, offset_px)
        top, rows = on_grid(window.top, window.height, step_px, offset_px)
        return Samples(left, top, step_px, (rows, columns))

    def frame(
        self,
        depth_m: np.ndarray,
        reason: np.ndarray,
        image: Image,
        pictures: dict[str, np.ndarray],
        at: Samples | None = None,
        intrinsics: Intrinsics | None = None,
    ) -> DepthFrame:
        """The finished frame of `depth_m` and `reason` at samples, by default of every pixel.

        `image` has what is true, over the whole window; `intrinsics` are what the device believes
        of its camera, where that is not the truth.
        """
        at = at or self.samples()
        return DepthFrame(
            Camera(intrinsics or self.camera.intrinsics, self.camera.world_from_camera),
            at.left,
            at.top,
            at.step_px,
            depth_m,
            at.of(image.depth_m),
            at.of(image.label),
            at.of(image.cosine),
            reason,
            pictures,
        )


@settings
class DepthSensor(ABC):
    """A depth camera that looks at bodies through a renderer. A kind of sensor writes `take`.

    Attributes:
        width_px, height_px, focal_px: of its camera, or of both.
        sees_light: whether what it measures depends on materials and light; one that adds noise
            to the true depth says False.
    """

    sees_light: ClassVar[bool] = True

    width_px: Count = 640
    height_px: Count = 480
    focal_px: Positive = 580.0

    @property
    def intrinsics(self) -> Intrinsics:
        """The camera's; its principal point is in the middle."""
        return Intrinsics.centred(self.width_px, self.height_px, self.focal_px)

    @property
    def margin_px(self) -> int:
        """Pixels around a box that have an influence on what is measured in it."""
        return 0

    def scan(
        self,
        bodies: tuple[Body, ...],
        box_m: np.ndarray,
        world_from_camera: np.ndarray,
        renderer: Renderer,
        rng: np.random.Generator,
        explain: bool = False,
        lighting: Lighting | None = None,
    ) -> DepthFrame | None:
        """Take one frame.

        Args:
            bodies: the scene.
            box_m: [2, 3] axis-aligned box of the world; only the pixels that it covers are
                rendered and matched.
            world_from_camera: [4, 4] true pose.
            renderer: makes the images.
            rng: all randomness of this frame.
            explain: render also who sees and who lights each surface, for `DepthFrame.reason`
                and the images "lit" and "seen". Costs renders and changes nothing else.
            lighting: of the place; None: the sensor's own light and `ambient` alone.

        Returns:
            The frame, or None if the box is outside the view.
        """
        whole = Camera(self.intrinsics, world_from_camera)
        window = window_of(box_m, whole, margin_px=self.margin_px)
        if window is None:
            return None
        camera = Camera(self.intrinsics, world_from_camera, window)
        return self.take(Shot(camera, bodies, box_m, renderer, rng, explain, lighting))

    @abstractmethod
    def take(self, shot: Shot) -> DepthFrame | None:
        """Render, expose and measure; None if the box is outside another camera's view."""


@settings
class TriangulatingSensor(DepthSensor):
    """A sensor whose depth is f b / (disparity + d0); d0 is 0 for two parallel cameras.

    Attributes:
        baseline_m: b, to the right of the camera unless the sensor says otherwise.
        min_depth_m, max_depth_m: depths outside are dropped.
        quantiser: step of the disparity.
        filters: applied to the disparity in this order, before the quantiser.
    """

    baseline_m: Positive = 0.075
    min_depth_m: Positive = 0.7
    max_depth_m: Positive = 6.0
    quantiser: Quantiser = field(default_factory=Quantiser)
    filters: tuple[PostFilter, ...] = ()

    def __post_init__(self) -> None:
        assert self.min_depth_m < self.max_depth_m, "min_depth_m must be below max_depth_m"
        matcher = getattr(self, "matcher", None)
        if matcher is None:
            return
        scale, zero = self.focal_px * self.baseline_m, self.zero_disparity_px
        low, high = (scale / depth_m - zero for depth_m in (self.max_depth_m, self.min_depth_m))
        least, most = found_px(matcher)
        assert least <= low < high <= most, (
            f"the depths need disparities {low:.1f} to {high:.1f} px, the matcher finds {least:g} "
            f"to {most:g}"
        )
        unbiased = isinstance(matcher, StereoBlockMatcher) and matcher.remove_bias
        # k / 16 less nearly half a step would be rounded straight back to k / 16.
        undone = unbiased and self.quantiser.steps_per_px == 16
        assert not undone, "quantiser.steps_per_px=16 undoes matcher.remove_bias"

    @property
    def zero_disparity_px(self) -> float:
        """Disparity f b / Z of a point that the matcher gives 0: 0 for two parallel cameras."""
        return 0.0

    def depth_of(self, match: Match) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Filter, quantise, triangulate, in this order.

        Returns:
            [h, w] float32 depth in metres and disparity as used, with NaN; [h, w] uint8 `Reason`.
        """
        disparity, reason = match.disparity, match.reason
        for post in self.filters:
            before = np.isfinite(disparity)
            disparity = post.apply(disparity)
            reason = np.where(before & ~np.isfinite(disparity), np.uint8(Reason.FILTERED), reason)
        disparity = self.quantiser.apply(disparity)
        scale = self.focal_px * self.baseline_m
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = disparity / np.float32(scale)
            if self.zero_disparity_px:
                inverse = inverse + np.float32(self.zero_disparity_px / scale)
            depth = (1 / inverse).astype(np.float32)
            inside = (depth > self.min_depth_m) & (depth < self.max_depth_m)
        reason = np.where(np.isfinite(disparity) & ~inside, np.uint8(Reason.RANGE), reason)
        depth[~inside] = np.nan
        return depth, disparity, reason.astype(np.uint8)


def window_of(box_m: np.ndarray, camera: Camera, *, margin_px: int = 0) -> Window | None:
    """The pixels of the image that a box [2, 3] of the world covers; None if there are none."""
    corners = np.stack(np.meshgrid(*box_m.T, indexing="ij"), axis=-1).reshape(8, 3)
    pixels, depth = project(corners, camera)
    k = camera.intrinsics
    if (depth <= 0).all():
        return None
    if (depth <= 0).any():  # the box reaches behind the camera: its outline is unbounded
        low, high = np.zeros(2), np.array([k.width_px - 1, k.height_px - 1])
    else:
        low, high = np.floor(pixels.min(axis=0)), np.ceil(pixels.max(axis=0))
    left, top = (int(max(0, value - margin_px)) for value in low)
    right = int(min(k.width_px - 1, high[0] + margin_px))
    bottom = int(min(k.height_px - 1, high[1] + margin_px))
    if right < left or bottom < top:
        return None
    return Window(left, top, right - left + 1, bottom - top + 1)


def on_grid(start: int, count: int, step: int, offset: int | None = None) -> tuple[int, slice]:
    """Every step-th of `count` pixels from `start`, on a grid that does not depend on them.

    Returns:
        The first pixel x >= start with x % step == offset (default: step // 2), and the pixels'
        slice.
    """
    first = start + ((step // 2 if offset is None else offset) - start) % step
    return first, slice(first - start, count, step)
