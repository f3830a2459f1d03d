"""The released slide's shape, and the released light against the released scene in Blender."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

from qs3.geometry.cameras import look_at
from qs3.meshes.mesh import Mesh
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.matching import StereoBlockMatcher
from qs3.sensors.optics.infrared import FilmicCamera
from qs3.sensors.optics.patterns import ReleasedSlide, Speckle
from qs3.sensors.renderers.base import Body
from qs3.sensors.renderers.mitsuba import MitsubaRenderer


def test_the_slide_is_square_and_its_dots_are_higher_than_wide():
    one = ReleasedSlide(columns=20, rows=10, tiles=1, dot_px=2, fill=0.005, spacing=4, detail=8)
    slide = one.slide
    assert slide.shape == (320, 320)
    assert slide.dtype == np.float32
    assert slide.max() == pytest.approx(1)
    rows, cols = np.nonzero(slide > 0.5)
    height, width = np.ptp(rows) + 1, np.ptp(cols) + 1
    assert height / width == pytest.approx(2, rel=0.15)  # stretched from 10 to 20


def test_the_slide_repeats_in_tiles_and_holds_the_dots_of_its_pattern():
    slide = ReleasedSlide(columns=40, rows=30, tiles=3, detail=2)
    plain = Speckle(columns=40, rows=30, tiles=3)
    third = slide.slide.shape[0] // 3
    inner = slide.slide[third // 2 : third, third // 2 : third]
    shifted = slide.slide[third + third // 2 : 2 * third, third + third // 2 : 2 * third]
    np.testing.assert_allclose(inner, shifted, atol=1e-5)
    # Decoded after interpolation: less light than a linear slide of the same dots.
    linear = cv2.resize(plain.slide, slide.slide.shape[::-1], interpolation=cv2.INTER_LINEAR)
    assert 0.5 * linear.mean() < slide.slide.mean() < 0.9 * linear.mean()


SCENE = """
import sys
import bpy, mathutils, numpy as np
given = np.load(sys.argv[1])
folder = sys.argv[2]
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", 32
scene.cycles.use_adaptive_sampling = scene.cycles.use_denoising = False
scene.render.resolution_x = scene.render.resolution_y = 1080
scene.render.use_border = True
scene.render.border_min_x = scene.render.border_min_y = 0.3
scene.render.border_max_x = scene.render.border_max_y = 0.7
scene.view_settings.view_transform = "Filmic"
scene.view_settings.look = "None"
scene.render.image_settings.file_format = "PNG"
scene.world = bpy.data.worlds.new("grey")
scene.world.use_nodes = False
scene.world.color = (0.0509, 0.0509, 0.0509)

mesh = bpy.data.meshes.new("object")
mesh.from_pydata(given["vertices"].tolist(), [], given["faces"].tolist())
mesh.update()
material = bpy.data.materials.new("default")
material.use_nodes = True
mesh.materials.append(material)
scene.collection.objects.link(bpy.data.objects.new("object", mesh))

fill = bpy.data.lights.new("fill", "AREA")
fill.shape, fill.size = "SQUARE", 24.34
fill.energy = 1000 * np.pi / 4  # of a file of Blender 2.93, which divided by 4 and not by pi
thing = bpy.data.objects.new("fill", fill)
thing.location = (0, 0, 2)
scene.collection.objects.link(thing)

height, width = given["slide"].shape
picture = bpy.data.images.new("slide", width, height)
pixels = np.ones((height, width, 4), dtype=np.float32)
pixels[..., :3] = given["slide"][..., None]
picture.pixels.foreach_set(pixels.ravel())
picture.update()
spot = bpy.data.lights.new("spot", "SPOT")
spot.energy, spot.spot_size, spot.spot_blend = 300, 2.0944, 0.15
spot.shadow_soft_size = 0
spot.use_nodes = True
tree = spot.node_tree
tree.nodes.clear()
node, link = tree.nodes.new, tree.links.new
where, parts = node("ShaderNodeTexCoord"), node("ShaderNodeSeparateXYZ")
divide, place = node("ShaderNodeVectorMath"), node("ShaderNodeMapping")
divide.operation = "DIVIDE"
place.inputs["Location"].default_value = (0.5, 0.5, 0)
place.inputs["Scale"].default_value = (0.8, 0.8, 0.8)
image, light = node("ShaderNodeTexImage"), node("ShaderNodeEmission")
image.image, image.extension = picture, "CLIP"
light.inputs["Strength"].default_value = 6
out = node("ShaderNodeOutputLight")
link(where.outputs["Normal"], parts.inputs[0])
link(where.outputs["Normal"], divide.inputs[0])
link(parts.outputs["Z"], divide.inputs[1])
link(divide.outputs[0], place.inputs["Vector"])
link(place.outputs[0], image.inputs["Vector"])
link(image.outputs["Color"], light.inputs["Color"])
link(light.outputs[0], out.inputs["Surface"])
projector = bpy.data.objects.new("spot", spot)
scene.collection.objects.link(projector)
lens = bpy.data.cameras.new("eye")
lens.lens, lens.sensor_width = 50, 36
eye = bpy.data.objects.new("eye", lens)
scene.collection.objects.link(eye)
scene.camera = eye

def at(offset):
    pose = given["pose"] @ np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] += offset * pose[:3, 0]
    return mathutils.Matrix(pose.tolist())

projector.matrix_world = at(0.05)
for name, offset in (("left", 0.0), ("right", 0.1)):
    eye.matrix_world = at(offset)
    scene.render.filepath = f"{folder}/{name}.png"
    bpy.ops.render.render(write_still=True)
"""


@pytest.mark.slow
def test_the_released_light_makes_the_images_of_the_released_scene(tmp_path):
    """A square facing the camera; the scene is built in Blender as its file describes it."""
    pose = look_at(np.array([3.0, 0.5, 2.4]), np.zeros(3))
    centre = pose[:3, 3] + 4.03 * pose[:3, 2]
    corners = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    vertices = np.array([centre + 0.4 * (a * pose[:3, 0] + b * pose[:3, 1]) for a, b in corners])
    mesh = Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]))
    slide = ReleasedSlide()
    stored = Speckle(columns=211, rows=165, tiles=3).slide
    # Blender's first row is the lowest, and its mapping turns the picture upside down.
    np.savez(
        tmp_path / "given.npz",
        vertices=mesh.vertices,
        faces=mesh.faces,
        pose=pose,
        slide=stored[:, ::-1],
    )
    arguments = [sys.executable, "-c", SCENE, str(tmp_path / "given.npz"), str(tmp_path)]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=500)
    assert (tmp_path / "right.png").is_file(), done.stderr[-1000:]
    left, right = (cv2.imread(str(tmp_path / f"{n}.png"), 0) for n in ("left", "right"))

    sensor = SpeckleStereo(
        ambient=0.27,
        pattern=slide,
        matcher=StereoBlockMatcher(remove_bias=False),
        infrared=FilmicCamera(0.0509),
        projector_strength=45.5945,
    )
    renderer = MitsubaRenderer(samples=32)
    frame = sensor.scan((Body(mesh),), mesh.bounds, pose, renderer, np.random.default_rng(0))
    theirs = cv2.StereoBM_create(160, 19).compute(left, right) / 16
    ours = frame.images["disparity"]
    # The window's place: the square is symmetric about the principal axis of the left camera.
    clean = frame.images["clean"]
    rows, cols = np.nonzero(np.isfinite(clean))
    top = round(539.5 - (rows.min() + rows.max()) / 2)
    first = round(539.5 - (cols.min() + cols.max()) / 2)
    window = np.s_[top : top + clean.shape[0], first : first + clean.shape[1]]
    inside = cv2.erode(np.isfinite(clean).astype(np.uint8), np.ones((25, 25))) > 0

    grey, their_grey = frame.images["left"][inside].astype(float), left[window][inside]
    assert np.corrcoef(grey, their_grey)[0, 1] > 0.98
    assert abs(grey.mean() - their_grey.mean()) < 20  # the fill light is uneven there
    truth = 150 / 4.03
    their_error, error = theirs[window][inside] - truth, ours[inside] - truth
    found = (their_error > -30) & np.isfinite(error)
    assert found.mean() > 0.99
    assert np.median(error[found]) == pytest.approx(np.median(their_error[found]), abs=1 / 32)
    assert error[found].std() == pytest.approx(their_error[found].std(), rel=0.3)
    assert np.quantile(np.abs(error - their_error)[found], 0.9) <= 1 / 16 + 1e-6
