"""What every renderer must do; each test runs with Blender and with both paths of Mitsuba."""

import hashlib
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from qs3.geometry.cameras import Camera, Intrinsics, Window
from qs3.meshes.mesh import Mesh
from qs3.sensors.renderers.base import Body, Projector, RendererSettings, Scene
from tests.sensors.renderers.scenes import (
    busy_camera,
    busy_scene,
    moved,
    octahedron,
    quad,
    tilted_pose,
    wall,
)


def one(renderer, scene, camera, seed=0):
    (image,) = renderer.render(scene, [camera], seed=seed, geometry=[True])
    return image


def digest(images):
    hasher = hashlib.sha256()
    for image in images:
        for array in (image.radiance, image.depth_m, image.label):
            hasher.update(array.tobytes())
    return hasher.hexdigest()


def busy_digest(renderer):
    camera = busy_camera()
    pair = [camera, camera.moved((0.08, 0, 0))]
    return digest(renderer.render(busy_scene(), pair, seed=7, geometry=[True, False]))


# --- radiometry


@pytest.mark.parametrize("z_m", [1.0, 2.0])
def test_white_slide_on_white_wall_is_strength_over_z_squared(renderer, z_m):
    slide = np.ones((12, 16), dtype=np.float32)
    scene = Scene((wall(z_m),), Projector(np.eye(4), slide, tan_half_width=0.8, strength=3.0))
    camera = Camera(Intrinsics.centred(40, 30, 25.5), np.eye(4))  # sees not quite all of it
    radiance = one(renderer, scene, camera).radiance
    # The same everywhere: a projector has no vignetting.
    assert radiance[1:-1, 1:-1] == pytest.approx(3.0 / z_m**2, rel=0.02)


def test_cosine_of_incidence_and_albedo(renderer):
    slope = 0.7
    body = quad([[-2, -2, 2 - 2 * slope], [2, -2, 2 + 2 * slope],
                 [2, 2, 2 + 2 * slope], [-2, 2, 2 - 2 * slope]], albedo=0.4)  # fmt: skip
    slide = np.ones((8, 8), dtype=np.float32)
    scene = Scene((body,), Projector(np.eye(4), slide, tan_half_width=0.5, strength=2.0))
    camera = Camera(Intrinsics(21, 21, 60.0, 10.0, 10.0), np.eye(4))
    image = one(renderer, scene, camera)
    x, y = np.meshgrid((np.arange(21) - 10) / 60.0, (np.arange(21) - 10) / 60.0)
    direction = np.stack([x, y, np.ones_like(x)], axis=-1)
    normal = np.array([-slope, 0, 1]) / np.hypot(slope, 1)
    # cos(incidence) / cos(angle to the axis), see Projector.strength
    expected = 0.4 * 2.0 / image.depth_m**2 * (direction @ normal)
    np.testing.assert_allclose(image.radiance, expected, rtol=0.01)


def test_ambient_is_albedo_times_ambient_without_noise(renderer):
    bodies = (Body(octahedron((0, 0, 1), 0.3), 0.25, 1), wall(1.3, albedo=0.75))
    renderer.settings = RendererSettings(samples=2)
    image = one(renderer, Scene(bodies, None, ambient=0.6), busy_camera())
    expected = np.where(image.label == 1, 0.15, 0.45)
    off = np.abs(image.radiance - expected) > 1e-5
    assert off.mean() < 0.05  # only pixels on the outline mix the two


def test_shadow_is_on_the_far_side_of_the_projector(renderer):
    blocker = quad([[-0.1, -0.1, 1], [0.1, -0.1, 1], [0.1, 0.1, 1], [-0.1, 0.1, 1]])
    slide = np.ones((8, 8), dtype=np.float32)
    scene = Scene((blocker, wall(2.0)), Projector(moved(-0.5), slide, tan_half_width=1.0))
    image = one(renderer, scene, Camera(Intrinsics.centred(101, 101, 100.0), np.eye(4)))
    # Projector at x = -0.5, blocker at half way: its shadow on the wall is at x = 0.3 .. 0.7,
    # y = -0.2 .. 0.2, which the camera sees 50 px per metre.
    expected = np.ones((101, 101)) / 4
    expected[41:60, 66:85] = 0
    expected[image.label == 1] = 1
    inner = (image.label == 0) & ~_near_step(expected)
    np.testing.assert_allclose(image.radiance[inner], expected[inner], atol=0.01)


def _near_step(image):
    padded = np.pad(image, 2, mode="edge")
    height, width = image.shape
    around = [padded[i : i + height, j : j + width] for i in range(5) for j in range(5)]
    return np.ptp(around, axis=0) > 0


def test_faces_that_lie_on_each_other_do_not_shadow_each_other(renderer):
    body = octahedron((0.05, 0.02, 1.0), 0.3)
    twice = Mesh(
        np.concatenate([body.vertices, body.vertices]),
        np.concatenate([body.faces, body.faces[:, ::-1] + len(body.vertices)]),
    )
    scene = busy_scene()
    doubled = replace(scene, bodies=(Body(twice, 0.8, 1), scene.bodies[1]))
    first, second = one(renderer, scene, busy_camera()), one(renderer, doubled, busy_camera())
    np.testing.assert_allclose(second.radiance, first.radiance, atol=1e-5)


# --- geometry


def test_slide_is_upright_from_the_projector(renderer):
    slide = np.zeros((14, 10), dtype=np.float32)  # a letter F, taller than wide
    slide[2:12, 2:4] = slide[2:4, 2:8] = slide[6:8, 2:6] = 1
    pose = tilted_pose()
    facing = wall(1.5, half_m=3.0).mesh.transformed(pose)
    scene = Scene((Body(facing, 1.0),), Projector(pose, slide, tan_half_width=0.25, strength=2.25))
    # 8 camera pixels a slide pixel
    camera = Camera(Intrinsics.centred(80, 112, 160.0), pose)
    seen = one(renderer, scene, camera).radiance
    expected = np.kron(slide, np.ones((8, 8)))
    np.testing.assert_allclose(
        seen[~_near_blur(expected)], expected[~_near_blur(expected)], atol=0.05
    )
    assert np.corrcoef(seen.ravel(), expected.ravel())[0, 1] > 0.9
    for flipped in (expected[:, ::-1], expected[::-1], expected[::-1, ::-1]):
        assert np.corrcoef(seen.ravel(), flipped.ravel())[0, 1] < 0.7


def _near_blur(image):
    """Within half a slide pixel of a step, where the slide is interpolated."""
    near = np.zeros(image.shape, dtype=bool)
    for axis in (0, 1):
        for shift in range(-5, 6):
            near |= np.roll(image, shift, axis) != image
    return near | np.roll(near, 5, 0) | np.roll(near, -5, 0)


def test_depth_is_exact_at_pixel_centres(renderer):
    pose = tilted_pose()
    camera = Camera(Intrinsics(64, 48, 70.0, 25.25, 30.6), pose)
    local = quad([[-4, -4, 0.8], [4, -4, 3.2], [4, 4, 5.2], [-4, 4, 2.8]])
    scene = Scene((Body(local.mesh.transformed(pose)),))
    depth = one(renderer, scene, camera).depth_m
    # z = 3 + 0.3 x + 0.25 y in camera coordinates
    x = (np.arange(64) - 25.25) / 70.0
    y = (np.arange(48)[:, None] - 30.6) / 70.0
    expected = 3 / (1 - 0.3 * x - 0.25 * y)
    per_px = np.abs(np.gradient(expected, axis=1))  # metres a pixel
    assert (np.abs(depth - expected) / per_px).max() < 0.005
    assert depth.dtype == np.float32


# --- windows, determinism, memory


def test_window_is_a_crop_of_the_whole(renderer):
    whole = one(renderer, busy_scene(), busy_camera())
    for window in (Window(31, 17, 40, 32), Window(90, 75, 6, 5)):
        part = one(renderer, busy_scene(), busy_camera(window))
        np.testing.assert_array_equal(part.depth_m, whole.depth_m[window.slices])
        np.testing.assert_array_equal(part.label, whole.label[window.slices])
        np.testing.assert_array_equal(part.cosine, whole.cosine[window.slices])
        difference = part.radiance - whole.radiance[window.slices]
        assert abs(difference.mean()) < 0.03
        assert np.abs(difference).max() < 0.6  # noise on the edges of dots, at most 1.9 bright


def test_same_call_same_bytes_whatever_came_between(renderer):
    first = busy_digest(renderer)
    # another size of everything, another number of bodies, no projector
    one(renderer, Scene((wall(2.0),), None, 0.1), Camera(Intrinsics.centred(33, 21, 30), np.eye(4)))
    with pytest.raises(ValueError, match="zip"):
        renderer.render(busy_scene(), [busy_camera()], seed=0, geometry=[])
    assert busy_digest(renderer) == first


def test_threads_do_not_change_a_byte(renderer):
    first = busy_digest(renderer)
    renderer.settings = RendererSettings(samples=16, threads=3)
    assert busy_digest(renderer) == first


@pytest.mark.slow
def test_fresh_process_makes_the_same_bytes(renderer, request):
    name = request.node.callspec.params["shared"]
    code = (
        "from tests.sensors.renderers.scenes import RENDERERS\n"
        "from tests.sensors.renderers.test_renderers import busy_digest\n"
        f"print(busy_digest(RENDERERS[{name!r}]()))"
    )
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert child.stdout.strip() == busy_digest(renderer)  # and nothing else was printed


@pytest.mark.slow
def test_memory_does_not_grow(renderer):
    renderer.settings = RendererSettings(samples=1)
    camera = busy_camera(Window(0, 0, 8, 8))

    def render(times):
        for i in range(times):
            # 0.5 MB of vertices a scene: a leak of meshes would show
            mesh = Mesh(
                np.concatenate([octahedron((0, 0, 1), 0.3).vertices, np.zeros((20000 + i, 3))]),
                octahedron((0, 0, 1), 0.3).faces,
            )
            renderer.render(
                replace(busy_scene(), bodies=(Body(mesh), wall(2.0))),
                [camera], seed=i, geometry=[True],
            )  # fmt: skip
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * 4096 / 1e6

    before = render(10)
    assert render(40) - before < 10


# --- words


def test_importing_the_modules_is_light():
    code = (
        "import sys, qs3.sensors.renderers.blender, qs3.sensors.renderers.mitsuba\n"
        "assert not {'bpy', 'mitsuba', 'drjit', 'torch'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
