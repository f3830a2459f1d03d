"""Materials of glTF 2.0: the metallic-roughness model's factors. Pictures are not opened.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html#materials
"""

from __future__ import annotations

import math
from typing import Any

from qs3.errors import MeshError
from qs3.meshes.finishes import Finish


def finish_of(material: Any) -> tuple[Finish | None, bool]:
    """What a material says, and whether its colour lies in a picture.

    None where it does not use the model. Roughness and metal that lie in a picture are taken for
    0.5 and no metal: their factors are 1 in most such files, and mean the picture's.

    Raises:
        MeshError: a value is not of its kind.
    """
    if not isinstance(material, dict):
        raise MeshError("has a material that is not an object")
    model = material.get("pbrMetallicRoughness")
    if model is None:
        return None, False
    if not isinstance(model, dict):
        raise MeshError("has a material whose pbrMetallicRoughness is not an object")
    factors = model.get("baseColorFactor", [1, 1, 1, 1])
    if not isinstance(factors, list) or len(factors) != 4:
        raise MeshError("has a baseColorFactor that is not four numbers")
    red, green, blue, alpha = (_unit(value, "baseColorFactor") for value in factors)
    roughness, metal = 0.5, False
    if "metallicRoughnessTexture" not in model:
        roughness = _unit(model.get("roughnessFactor", 1.0), "roughnessFactor")
        metal = _unit(model.get("metallicFactor", 1.0), "metallicFactor") >= 0.5
    mode, clear = material.get("alphaMode", "OPAQUE"), 0.0
    if mode == "BLEND":
        clear = 1 - alpha
    elif mode == "MASK":  # all or nothing
        clear = float(alpha < _unit(material.get("alphaCutoff", 0.5), "alphaCutoff"))
    finish = Finish((red, green, blue), roughness, 0.5, metal, clear)
    return finish, "baseColorTexture" in model


def _unit(value: Any, name: str) -> float:
    """Within 0..1, as the format demands."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise MeshError(f"has a {name} that is no number")
    return min(max(float(value), 0.0), 1.0)
