"""Simple scenes before a camera at the origin that looks along +x, and parts of images."""

import numpy as np

from qs3.geometry.cameras import look_at
from qs3.meshes.mesh import Mesh
from qs3.sensors.renderers.base import Body

POSE = look_at(np.zeros(3), np.array([1.0, 0.0, 0.0]))


def rectangle(depth_m, left_m, right_m, low_m=-0.3, high_m=0.3, albedo=0.8, label=1):
    """Faces the camera; `left_m` and `right_m` along the camera's x, which is the world's -y."""
    y = (-left_m, -right_m, -right_m, -left_m)
    z = (low_m, low_m, high_m, high_m)
    vertices = np.column_stack([np.full(4, depth_m), y, z]).astype(np.float64)
    return Body(Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]])), albedo=albedo, label=label)


def square(depth_m, half_m=0.3, albedo=0.8):
    return rectangle(depth_m, -half_m, half_m, -half_m, half_m, albedo)


def plane(depth_m, half_m=0.5, tilt_deg=0.0):
    """A square in front of the camera, turned about the vertical axis."""
    angle = np.deg2rad(tilt_deg)
    side = np.array([np.sin(angle), np.cos(angle), 0.0]) * half_m
    up = np.array([0.0, 0.0, half_m])
    centre = np.array([depth_m, 0.0, 0.0])
    vertices = [centre - side - up, centre + side - up, centre + side + up, centre - side + up]
    return Body(Mesh(np.array(vertices), np.array([[0, 1, 2], [0, 2, 3]])))


def box_of(*bodies):
    vertices = np.concatenate([body.mesh.vertices for body in bodies])
    return np.stack([vertices.min(axis=0), vertices.max(axis=0)])


def middle(image, share=0.6):
    rows, cols = (round(n * (1 - share) / 2) for n in image.shape[-2:])
    return image[..., rows : image.shape[-2] - rows, cols : image.shape[-1] - cols]


def scan(sensor, bodies, renderer, seed=0, box=None, **more):
    """One frame of bodies, looked at where they are."""
    where = box_of(*bodies) if box is None else box
    return sensor.scan(tuple(bodies), where, POSE, renderer, np.random.default_rng(seed), **more)
