"""Infrared pictures of walls by a simulated camera whose numbers one knows, for `qs3 fit images=`.

python -m tests.sensors.fit.simulated_pictures into=pictures speckle_contrast=0.3 read_noise_e=25
python -m tests.sensors.fit.simulated_pictures into=pictures cameras=1 # no right pictures
qs3 fit images=pictures base=realsense_d415 out=found.yaml
"""

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from qs3.calibration.bench.cached_renderer import StillRenderer
from qs3.calibration.fit.infrared import Pictures
from qs3.config.compose import composed
from qs3.config.hydra import build
from qs3.sensors.matching import StereoBlockMatcher
from qs3.sensors.optics.misalignment import Misalignment
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.sensors.scenery import POSE, box_of, square

BASE = build(composed(None, "+sensor=realsense_d415").sensor)
HIDDEN = {
    "ambient": 1.2,
    "infrared.psf_px": 1.2,
    "infrared.speckle_contrast": 0.0,
    "infrared.electrons_at_white": 2500.0,
    "infrared.read_noise_e": 40.0,
}


def camera(hidden, fixed_gain):
    """The preset with other light, lens and noise, and other dots of the same kind."""
    infrared = {key.split(".")[1]: value for key, value in hidden.items() if "." in key}
    return replace(
        BASE,
        ambient=hidden["ambient"],
        infrared=replace(BASE.infrared, fixed_gain=fixed_gain, **infrared),
        pattern=replace(BASE.pattern, seed=77),
        misalignment=Misalignment(),
        matcher=StereoBlockMatcher(num_disparities=128),  # its disparity is not looked at
        filters=(),
    )


def pictures(sensor, depth_m, name, renderer, frames=8, half_px=220):
    """Frames of a wall that faces both cameras, its depth, and one with the projector off.

    The right camera's are the same columns as the left's, and dark where these show more than the
    wall: no pixel of the left image lies there.
    """
    half = half_px * depth_m / sensor.focal_px
    wall = square(depth_m, 2 * half)
    box = box_of(square(depth_m, half))
    off = replace(sensor, projector_strength=1e-9)
    # Frames of a still scene: the renderer's own sampling noise is the same in all of them.
    still, taken = StillRenderer(renderer, seed=round(100 * depth_m)), []
    for i, one in enumerate([sensor] * frames + [off]):
        if one is sensor:
            still.rewind()
        rng = np.random.default_rng([i, round(100 * depth_m)])
        taken.append(one.scan((wall,), box, POSE, still if one is sensor else renderer, rng))
    *lit, dark = (frame.images for frame in taken)
    left, right = ([each[side] for each in lit] for side in ("left", "right"))
    return Pictures(name, left, right, [dark["left"]], taken[0].clean_m)


def three_walls(hidden, renderer):
    """Two that are well lit, near and far, and a dim one between them."""
    bright, dim = camera(hidden, 35.0), camera(hidden, 15.0)
    return [
        pictures(bright, 0.9, "near", renderer),
        pictures(bright, 1.5, "far", renderer),
        pictures(dim, 1.1, "dim", renderer),
    ]


def save(folder, scenes):
    """As files that `qs3 fit images=` reads."""
    folder.mkdir(parents=True)
    for scene in scenes:
        for kind, images in (("left", scene.left), ("right", scene.right), ("off", scene.off)):
            for i, image in enumerate(images):
                cv2.imwrite(str(folder / f"{scene.name}_{kind}_{i}.png"), image)
        if scene.depth_m is not None:
            np.save(folder / f"{scene.name}_depth.npy", scene.depth_m)


def main(*words: str) -> None:
    """Write pictures by what is given, else by HIDDEN."""
    given = dict(word.partition("=")[::2] for word in words)
    into, cameras = Path(given.pop("into")), given.pop("cameras", "2")
    hidden = {key: float(given.pop(key.split(".")[-1], value)) for key, value in HIDDEN.items()}
    assert not given, f"unknown: {', '.join(given)}"
    assert cameras in ("1", "2"), f"cameras={cameras}: 1 or 2"
    scenes = three_walls(hidden, MitsubaRenderer(samples=16))
    save(into, [replace(scene, right=()) if cameras == "1" else scene for scene in scenes])
    sys.stdout.write(f"{into}: {', '.join(f'{key} {value:g}' for key, value in hidden.items())}\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
