"""The strengths of conf/light/area.yaml: those of the released scene's lamps, rendered by Blender.

The released file is one of Blender 2.93 with a square area lamp of 1000 W, 24.34 m wide at
z = 2 m, a spot of 300 W and strength 6, and a grey world of 0.0509. Blender reads it as here.
"""

import json
import subprocess
import sys

import pytest
from omegaconf import OmegaConf

from qs3.config.compose import composed
from qs3.config.hydra import build
from qs3.config.location import CONF
from tests.sensors.scenery import box_of, square

SCENE = """
import json, math, struct, sys
import bpy, numpy as np
folder = sys.argv[1]
bpy.ops.wm.read_factory_settings(use_empty=True)

def of_2_93(watts):
    # An area lamp as a file of 2.93 has it. Blender writes what old versions should read beside
    # its own number, and converts that when the file's version is old.
    lamp = bpy.data.lights.new("fill", "AREA")
    lamp.shape, lamp.size, lamp.energy, lamp.use_fake_user = "SQUARE", 24.34, watts, True
    bpy.ops.wm.save_as_mainfile(filepath=folder + "/new.blend", compress=False)
    data = open(folder + "/new.blend", "rb").read()
    for_old = struct.pack("<f", watts * 4 / math.pi)
    assert data[:12] == b"BLENDER-v405" and data.count(for_old) == 1
    data = b"BLENDER-v293" + data[12:].replace(for_old, struct.pack("<f", watts))
    open(folder + "/old.blend", "wb").write(data)
    bpy.data.lights.remove(lamp)
    with bpy.data.libraries.load(folder + "/old.blend") as (there, here):
        here.lights = there.lights
    return here.lights[0]

fill = of_2_93(1000)
scene = bpy.context.scene
scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", 256
scene.cycles.use_adaptive_sampling = scene.cycles.use_denoising = False
scene.render.threads_mode, scene.render.threads = "FIXED", 1
scene.render.resolution_x = scene.render.resolution_y = 8
scene.render.image_settings.file_format = "OPEN_EXR"
scene.render.image_settings.color_depth = "32"
scene.world = bpy.data.worlds.new("grey")
scene.world.use_nodes = False

def put(name, data, height):
    thing = bpy.data.objects.new(name, data)
    thing.location = (0, 0, height)
    scene.collection.objects.link(thing)
    return thing

material = bpy.data.materials.new("white")
material.use_nodes = True
tree = material.node_tree
tree.nodes.clear()
white, out = tree.nodes.new("ShaderNodeBsdfDiffuse"), tree.nodes.new("ShaderNodeOutputMaterial")
white.inputs["Color"].default_value = (1, 1, 1, 1)
tree.links.new(white.outputs[0], out.inputs["Surface"])
mesh = bpy.data.meshes.new("square")
corners = [(-0.2, -0.2, 0), (0.2, -0.2, 0), (0.2, 0.2, 0), (-0.2, 0.2, 0)]
mesh.from_pydata(corners, [], [(0, 1, 2, 3)])
mesh.materials.append(material)
put("square", mesh, 0)
lens = bpy.data.cameras.new("eye")
lens.lens, lens.sensor_width = 400, 36
scene.camera = put("eye", lens, 0.7)

spot = bpy.data.lights.new("spot", "SPOT")
spot.energy, spot.spot_size, spot.spot_blend, spot.shadow_soft_size = 300, 2.0944, 0.15, 0
spot.use_nodes = True  # a white slide
spot.node_tree.nodes["Emission"].inputs["Strength"].default_value = 6
lamps = {"fill": put("fill", fill, float(sys.argv[2])), "dot": put("spot", spot, 4)}

def radiance(lit):
    for name, lamp in lamps.items():
        lamp.hide_render = name != lit
    scene.world.color = (0.0509,) * 3 if lit == "world" else (0, 0, 0)
    scene.render.filepath = folder + "/seen.exr"
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    pixels = np.array(image.pixels[:]).reshape(-1, 4)
    bpy.data.images.remove(image)
    return float(pixels[:, 0].mean())

found = {name: radiance(name) for name in ("fill", "dot", "world")}
json.dump({"watts": fill.energy, **found}, open(folder + "/found.json", "w"))
"""


@pytest.fixture(scope="module")
def light():
    return build(OmegaConf.load(CONF / "light" / "area.yaml").light)


@pytest.fixture(scope="module")
def seen(light, tmp_path_factory):
    """Radiances of white, level below the lamp and facing the spot 4 m away."""
    folder = tmp_path_factory.mktemp("lamps")
    command = [sys.executable, "-c", SCENE, str(folder), str(light.height_m)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert (folder / "found.json").is_file(), done.stderr[-2000:]
    return json.loads((folder / "found.json").read_text())


def test_the_light_above_is_as_strong_as_the_released_lamp(seen, light):
    """In units of a lit dot on white at 4 m, as `sensor.ambient` is."""
    sensor = composed(None, "+sensor=speckle_stereo").sensor
    assert sensor.projector_strength / 4**2 == 1
    assert light.strength == pytest.approx(seen["fill"] / seen["dot"], rel=0.01)
    assert light.ambient == pytest.approx(seen["world"] / seen["dot"], rel=0.01)


def test_the_numbers_of_the_page_of_the_released_code_are_blender_s(seen, light):
    """docs/reference/released.md: 45.6 at 1 m, a fill light of radiance 0.422."""
    assert seen["watts"] == pytest.approx(785.4, rel=1e-4)  # of 1000 W before Blender 4.0
    assert seen["dot"] * 4**2 == pytest.approx(45.6, rel=0.002)
    area = light.over(box_of(square(0.0))).area
    below = light.strength / area.radiance  # the share of the view that the lamp fills
    assert seen["fill"] / below == pytest.approx(0.422, rel=0.002)
