"""Rendered rooms with known objects, recorded as ScanNet would have recorded them."""

from dataclasses import dataclass

import numpy as np

from qs3.catalogue import Catalogue
from qs3.geometry.cameras import Camera, Intrinsics, look_at, rotation_xyz
from qs3.meshes.mesh import Mesh
from qs3.sensors.renderers.base import Body, Scene
from tests.datasets.writing import (
    ID_OF,
    LOST,
    Recording,
    intrinsics,
    write_aggregation,
    write_label_map,
    write_zip,
)

DEPTH = Intrinsics(240, 180, 215.0, 120.3, 88.2)
COLOUR = Intrinsics(486, 364, 440.0, 240.0, 185.1)  # another resolution, focal length, centre


def rigid(angles_deg, shift_m):
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_xyz(np.deg2rad(angles_deg))
    matrix[:3, 3] = shift_m
    return matrix


# Neither camera is the base, so that their order and direction matter.
BASE_FROM_DEPTH = rigid((0.5, -0.7, 0.3), (0.011, 0.002, -0.003))
BASE_FROM_COLOUR = rigid((-0.4, 0.6, 0.2), (-0.014, -0.001, 0.004))
COLOUR_FROM_DEPTH = np.linalg.inv(BASE_FROM_COLOUR) @ BASE_FROM_DEPTH


@dataclass
class Room:
    """Bodies by objectId (their render label is that + 1), each with ScanNet's word for it."""

    bodies: dict
    words: dict

    @property
    def scene(self):
        return Scene(tuple(Body(m.mesh, label=k + 1) for k, m in self.bodies.items()), ambient=0.5)


def catalogue_mesh(cls, index=0):
    items = Catalogue(train=index + 1, test=0, classes=(cls,)).items()
    return items[index].load()


def slab(x, y, z):
    """A box over three ranges."""
    corners = np.array([[a, b, c] for a in x for b in y for c in z], dtype=np.float64)
    faces = [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]  # fmt: skip
    return Mesh(corners, np.array(faces))


def placed(mesh, x, y, yaw_deg=0.0):
    return mesh.transformed(rigid((0, 0, yaw_deg), (x, y, 0)))


def room(*, chair=0):
    """Floor, two walls, a chair before a sofa, a small table, and a box that is of no class."""
    meshes = {
        0: (slab((-2.5, 2.5), (-2.5, 2.5), (-0.1, 0.0)), "floor"),
        1: (slab((-2.5, 2.5), (2.4, 2.5), (0, 2.5)), "wall"),
        2: (placed(catalogue_mesh("chair", chair), -0.1, -0.35, 30), "chairs"),
        4: (placed(catalogue_mesh("sofa"), 0.3, 1.2, 180), "couch"),
        5: (placed(catalogue_mesh("table"), 1.2, -0.3, 20), "table"),
        7: (slab((-1.6, -1.2), (-0.2, 0.2), (0, 0.4)), "box"),
    }
    return Room(
        {number: Body(mesh, label=number + 1) for number, (mesh, _) in meshes.items()},
        {number: word for number, (_, word) in meshes.items()},
    )


def poses(count, turn_deg=200.0, height_m=1.5, radius_m=2.1):
    """Cameras on an arc about the middle of the room that look at it."""
    found = []
    for i in range(count):
        angle = np.deg2rad(-90 + turn_deg * (i / max(count - 1, 1) - 0.5))
        eye = [radius_m * np.cos(angle), radius_m * np.sin(angle), height_m + 0.2 * (i % 3)]
        found.append(look_at(np.array(eye), np.array([0.2, 0.2, 0.35])))
    return found


def exact_depth(the_room, pose, renderer):
    """[h, w] what a perfect depth camera sees, metres."""
    (image,) = renderer.render(the_room.scene, [Camera(DEPTH, pose)], seed=1, geometry=[True])
    return image.depth_m


def mask_of(the_room, pose, renderer):
    """[h, w] uint8 instance mask of the colour camera, which is elsewhere than the depth camera."""
    colour_pose = pose @ np.linalg.inv(COLOUR_FROM_DEPTH)
    camera = Camera(COLOUR, colour_pose)
    (image,) = renderer.render(the_room.scene, [camera], seed=1, geometry=[True])
    return image.label


def millimetres(depth_m):
    return np.rint(np.where(np.isfinite(depth_m), depth_m, 0) * 1000).astype(np.uint16)


def label_image(the_room, mask):
    lut = np.zeros(256, np.uint16)
    for number, word in the_room.words.items():
        lut[number + 1] = ID_OF[word]
    return lut[mask]


def record(the_room, where, renderer, *, lost=()):
    """A `Recording` and its masks; frames of `lost` have no pose and, as there, empty masks."""
    depths, masks, believed = [], {}, []
    for index, pose in enumerate(where):
        depths.append(millimetres(exact_depth(the_room, pose, renderer)))
        mask = mask_of(the_room, pose, renderer)
        masks[index] = np.zeros_like(mask) if index in lost else mask
        believed.append(LOST if index in lost else pose)
    recording = Recording(
        depths, believed,
        intrinsics(DEPTH.focal_px, DEPTH.focal_px, DEPTH.cx_px, DEPTH.cy_px),
        intrinsics(COLOUR.focal_px, COLOUR.focal_px, COLOUR.cx_px, COLOUR.cy_px),
        (COLOUR.width_px, COLOUR.height_px),
        BASE_FROM_DEPTH, BASE_FROM_COLOUR,
    )  # fmt: skip
    return recording, masks


def write_scene(scans, scene, the_room, recording, masks):
    folder = scans / scene
    recording.write(folder / f"{scene}.sens")
    write_zip(folder / f"{scene}_2d-instance-filt.zip", "instance-filt", masks)
    labels = {frame: label_image(the_room, mask) for frame, mask in masks.items()}
    write_zip(folder / f"{scene}_2d-label-filt.zip", "label-filt", labels)
    write_aggregation(folder / f"{scene}.aggregation.json", scene, the_room.words)


def write_lists(root, train, val):
    (root / "train.txt").write_text("\n".join(train) + "\n")
    (root / "val.txt").write_text("\n".join(val) + "\n")
    write_label_map(root / "labels.tsv")
