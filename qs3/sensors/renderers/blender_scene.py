"""A scene's bodies and lights in Blender. `bpy` is handed on: `blender` alone imports it."""

import math
from typing import Any

import numpy as np

from qs3.meshes.mesh import Mesh
from qs3.sensors.renderers.base import AreaLight, Body, Projector, Scene

# Cycles: a point light of P watts lights a white plane at 1 m to the radiance P / (4 pi^2).
_WATT_PER_RADIANCE = 4 * math.pi**2
# How far behind a surface its shadow caster lies, relative to the distance from the projector:
# 0.2 mm at 2 m, about the gap that Mitsuba leaves.
_SHADOW_GAP = 1e-4
_GLOW = "ambient"


def add_body(bpy: Any, target: Any, body: Body, scene: Scene) -> Any:
    """A body of a scene, with its material."""
    faces = body.mesh.faces
    if scene.area is not None:
        faces = _without_twins(body.mesh)
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]  # Blender's meshes may not repeat a corner
    mesh = bpy.data.meshes.new("body")
    mesh.vertices.add(len(body.mesh.vertices))
    mesh.vertices.foreach_set("co", body.mesh.vertices.astype(np.float32).ravel())
    mesh.loops.add(3 * len(faces))
    mesh.loops.foreach_set("vertex_index", faces.ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * len(faces), 3, dtype=np.int32))
    mesh.update(calc_edges=True)
    mesh.shade_flat()

    mesh.materials.append(_surface(bpy, body, scene.ambient))

    thing = bpy.data.objects.new("body", mesh)
    thing.pass_index = body.label
    thing.visible_diffuse = False  # Cycles follows a diffuse ray to what glows even at 0 bounces
    thing.visible_glossy = scene.plain
    target.collection.objects.link(thing)
    return thing


def _without_twins(mesh: Mesh) -> np.ndarray:
    """Faces [F, 3] without those at the place of another one.

    In the light of an area there is no place for shadow casters (`cast_shadow_by_copy`) that is
    behind the surface for all of it, so that twins would shadow each other.
    """
    _, place = np.unique(mesh.vertices.astype(np.float32), axis=0, return_inverse=True)
    _, first = np.unique(np.sort(place.ravel()[mesh.faces]), axis=0, return_index=True)
    return mesh.faces[np.sort(first)]


def cast_shadow_by_copy(target: Any, thing: Any, projector: Projector) -> Any:
    """Let an invisible copy cast the shadow, enlarged a little about the projector.

    CAD files often hold a face twice. Cycles starts a shadow ray on the surface itself, so
    the twins would shadow each other in half of all pixels. The copy lies just behind the
    surface as the projector sees it, and has the same outline from there.
    """
    centre, scale = np.asarray(projector.world_from_projector)[:3, 3], 1 + _SHADOW_GAP
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[:3, 3] = centre * (1 - scale)
    copy = thing.copy()
    copy.matrix_world = _matrix(matrix)
    copy.visible_camera = False
    thing.visible_shadow = False
    target.collection.objects.link(copy)
    return copy


def _surface(bpy: Any, body: Body, ambient: float) -> Any:
    """The material of a body: matt or glossy, with what ambient light adds as its own glow."""
    material = bpy.data.materials.new("diffuse")
    _use_nodes(material)
    material.cycles.emission_sampling = "NONE"  # the ambient term lights nothing else
    tree = material.node_tree
    tree.nodes.clear()
    node, link = tree.nodes.new, tree.links.new
    if body.gloss is None:
        bsdf, colour = node("ShaderNodeBsdfDiffuse"), "Color"
        bsdf.inputs["Roughness"].default_value = 0.0
    else:
        bsdf, colour = node("ShaderNodeBsdfPrincipled"), "Base Color"
        bsdf.distribution = "GGX"  # as `gloss`: light is not passed on from facet to facet
        bsdf.inputs["Roughness"].default_value = body.gloss.roughness
        bsdf.inputs["IOR"].default_value = 1.5  # of level 0.5, which scales its reflectance
        bsdf.inputs["Specular IOR Level"].default_value = body.gloss.specular
    bsdf.inputs[colour].default_value = (body.albedo, body.albedo, body.albedo, 1.0)
    glow = node("ShaderNodeEmission")
    glow.name = _GLOW
    glow.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    glow.inputs["Strength"].default_value = body.albedo * ambient
    total, output = node("ShaderNodeAddShader"), node("ShaderNodeOutputMaterial")
    link(bsdf.outputs[0], total.inputs[0])
    link(glow.outputs[0], total.inputs[1])
    link(total.outputs[0], output.inputs["Surface"])
    return material


def show_camera_only(thing: Any) -> None:
    """Let an object be black for all rays but a camera's, and without its glow of ambient light.

    With one bounce a ray that leaves a surface finds a light or nothing: direct light only.
    """
    tree = thing.data.materials[0].node_tree
    tree.nodes[_GLOW].inputs["Strength"].default_value = 0.0
    path, mix = tree.nodes.new("ShaderNodeLightPath"), tree.nodes.new("ShaderNodeMixShader")
    black = tree.nodes.new("ShaderNodeBsdfDiffuse")
    black.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    end = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL").inputs["Surface"]
    shown = end.links[0].from_socket
    tree.links.new(path.outputs["Is Camera Ray"], mix.inputs[0])
    tree.links.new(black.outputs[0], mix.inputs[1])
    tree.links.new(shown, mix.inputs[2])
    tree.links.new(mix.outputs[0], end)


def add_projector(bpy: Any, target: Any, projector: Projector) -> Any:
    """A spot that throws the slide."""
    height, width = projector.slide.shape
    tan_x = projector.tan_half_width
    tan_y = tan_x * height / width

    picture = bpy.data.images.new("slide", width, height, float_buffer=True, is_data=True)
    picture.use_half_precision = False
    pixels = np.ones((height, width, 4), dtype=np.float32)
    pixels[..., :3] = projector.slide[::-1, :, None]  # Blender's first row is the lowest
    picture.pixels.foreach_set(pixels.ravel())
    picture.update()

    light = bpy.data.lights.new("projector", "SPOT")
    light.energy = projector.strength * _WATT_PER_RADIANCE
    light.shadow_soft_size = 0.0  # a point: hard shadows
    light.spot_blend = 0.0
    # The cone only has to hold the slide; the slide's edge is the texture's.
    light.spot_size = min(2 * math.atan(math.hypot(tan_x, tan_y)) + 0.1, math.radians(179.0))
    _use_nodes(light)
    tree = light.node_tree
    tree.nodes.clear()
    node, link = tree.nodes.new, tree.links.new

    # The direction (x, y, z) in the light's frame (it looks along -z, y up) falls on the
    # slide at (x, y) / -z.
    coordinates, parts = node("ShaderNodeTexCoord"), node("ShaderNodeSeparateXYZ")
    divide, place = node("ShaderNodeVectorMath"), node("ShaderNodeVectorMath")
    divide.operation, place.operation = "DIVIDE", "MULTIPLY_ADD"
    place.inputs[1].default_value = (-0.5 / tan_x, -0.5 / tan_y, 0.0)
    place.inputs[2].default_value = (0.5, 0.5, 0.0)
    texture = node("ShaderNodeTexImage")
    texture.image, texture.interpolation, texture.extension = picture, "Linear", "CLIP"
    link(coordinates.outputs["Normal"], parts.inputs[0])
    link(coordinates.outputs["Normal"], divide.inputs[0])
    link(parts.outputs["Z"], divide.inputs[1])
    link(divide.outputs[0], place.inputs[0])
    link(place.outputs[0], texture.inputs["Vector"])

    # A point's light falls on a plane as cos^3 of the angle to the axis; a projector's lens
    # is built so that the plane is evenly bright.
    cosine, rise = node("ShaderNodeMath"), node("ShaderNodeMath")
    cosine.operation, rise.operation = "ABSOLUTE", "POWER"
    rise.inputs[1].default_value = -3.0
    emission, output = node("ShaderNodeEmission"), node("ShaderNodeOutputLight")
    link(parts.outputs["Z"], cosine.inputs[0])
    link(cosine.outputs[0], rise.inputs[0])
    link(texture.outputs["Color"], emission.inputs["Color"])
    link(rise.outputs[0], emission.inputs["Strength"])
    link(emission.outputs[0], output.inputs["Surface"])

    thing = bpy.data.objects.new("projector", light)
    thing.matrix_world = blender_pose(projector.world_from_projector)
    target.collection.objects.link(thing)
    return thing


def add_area(bpy: Any, target: Any, area: AreaLight) -> None:
    """The square light."""
    light = bpy.data.lights.new("area", "AREA")
    light.shape, light.size = "SQUARE", area.side_m
    light.energy = area.radiance * math.pi * area.side_m**2  # of a Lambertian source
    light.cycles.use_multiple_importance_sampling = True  # by its places and by the surface's
    thing = bpy.data.objects.new("area", light)
    thing.matrix_world = blender_pose(area.world_from_light)
    thing.visible_camera = False
    target.collection.objects.link(thing)


def blender_pose(world_from_local: np.ndarray) -> Any:
    """Pose of a camera or light in Blender: they look along -z with y up."""
    return _matrix(np.asarray(world_from_local) @ np.diag([1.0, -1.0, -1.0, 1.0]))


def _use_nodes(block: Any) -> None:
    if block.node_tree is None:  # Blender 5 makes one by itself, and warns
        block.use_nodes = True


def _matrix(matrix: np.ndarray) -> Any:
    import mathutils

    return mathutils.Matrix(matrix.tolist())
