"""The tone curve against Blender's own, and the camera that uses it."""

import subprocess
import sys

import numpy as np
import pytest

from qs3.sensors.optics.infrared import FilmicCamera, filmic

BLENDER = """
import sys
import bpy, numpy as np
values = np.load(sys.argv[1])
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.view_settings.view_transform = "Filmic"
scene.view_settings.look = "None"
scene.render.dither_intensity = 0
settings = scene.render.image_settings
settings.file_format, settings.color_mode, settings.color_depth = "PNG", "RGB", "16"
image = bpy.data.images.new("greys", len(values), 1, float_buffer=True)
pixels = np.ones((len(values), 4), dtype=np.float32)
pixels[:, :3] = values[:, None]
image.pixels.foreach_set(pixels.ravel())
image.update()
image.save_render(sys.argv[2], scene=scene)
"""


@pytest.mark.blender
def test_the_curve_is_blenders(tmp_path):
    """At values between those of the table."""
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(5)
    values = np.concatenate([[0.0], np.exp2(rng.uniform(-14, 5, 999))]).astype(np.float32)
    np.save(tmp_path / "values.npy", values)
    picture = tmp_path / "greys.png"
    arguments = [sys.executable, "-c", BLENDER, str(tmp_path / "values.npy"), str(picture)]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=300)
    assert picture.is_file(), done.stderr[-500:]
    theirs = cv2.imread(str(picture), cv2.IMREAD_UNCHANGED)[0, :, 0] / 257.0
    np.testing.assert_allclose(filmic(values), theirs, atol=0.1)


def test_pictures_have_no_noise_and_draw_nothing():
    camera = FilmicCamera()
    radiance = np.geomspace(0.01, 20, 64, dtype=np.float32).reshape(8, 8)
    rng = np.random.default_rng(0)
    picture = camera.expose(radiance, 1.0, rng)
    assert picture.dtype == np.uint8
    np.testing.assert_array_equal(picture, np.rint(filmic(radiance)))
    assert rng.bit_generator.state == np.random.default_rng(0).bit_generator.state


def test_the_background_shows_where_the_object_does_not_cover_the_pixel():
    camera = FilmicCamera(background=0.05, faintest=0.2)
    covered = np.array([0.0, 0.5, 1.0], dtype=np.float32)
    picture = camera.expose(0.2 * covered, 1.0, np.random.default_rng(0))
    wanted = filmic(0.2 * covered + 0.05 * (1 - covered))
    np.testing.assert_array_equal(picture, np.rint(wanted))
