"""Mesh files of two plates side by side, x < 0 dark and x > 0 bright, that say what they are of."""

import json
import struct

import numpy as np

_SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
PLATES = np.concatenate([_SQUARE + np.array([left, 0, 0]) for left in (-1.1, 0.1)])
FACES = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
DARK, BRIGHT = (0.05, 0.2, 0.1), (0.8, 0.5, 0.1)
MTL = """# of the plates
newmtl dark
Kd 0.05 0.2 0.1
Ks 0.25 0.25 0.25
Ns 6
newmtl bright one
Kd 0.8 0.5 0.1
Pr 0.4
Pm 1
d 0.75
newmtl printed
Kd 1 1 1
map_Kd wood.png
"""
MODELS = (
    {"baseColorFactor": [*DARK, 1], "metallicFactor": 0, "roughnessFactor": 0.9},
    {"baseColorFactor": [*BRIGHT, 0.75], "metallicFactor": 1, "roughnessFactor": 0.4},
)


def obj(first="dark", second="bright one", library="plates.mtl"):
    """The plates as a triangle pair and a quad, each behind its own usemtl, in the plane z = 0."""
    points = "".join(f"v {x} {y} {z}\n" for x, y, z in PLATES)
    return (
        f"mtllib {library}\n{points}usemtl {first}\nf 1 2 3\nf 1 3 4\nusemtl {second}\nf 5 6 7 8\n"
    )


def glb(materials=None, tree=None):
    """The plates as two meshes; y is up in the file, so their normals are up."""
    if materials is None:
        dark, bright = ({"pbrMetallicRoughness": model} for model in MODELS)
        materials = [dark, {**bright, "alphaMode": "BLEND"}]
    points = PLATES[:, [0, 2, 1]] * [1, 1, -1]
    blob = points.astype("<f4").tobytes() + FACES.astype("<u2").tobytes()
    parts = [
        {"attributes": {"POSITION": 0}, "indices": 1 + i, "material": i}
        for i in range(2)
        if i < len(materials)
    ]
    parts += [{"attributes": {"POSITION": 0}, "indices": 1 + i} for i in range(len(materials), 2)]
    found = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [1, 0]}],
        "nodes": [{"mesh": 0}, {"mesh": 1}],
        "meshes": [{"primitives": [part]} for part in parts],
        "materials": materials,
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 8},
            *(
                {"bufferView": 1, "byteOffset": 12 * i, "componentType": 5123, "type": "SCALAR"}
                | {"count": 6}
                for i in range(2)
            ),
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 96},
            {"buffer": 0, "byteOffset": 96, "byteLength": 24},
        ],
        "buffers": [{"byteLength": len(blob)}],
        **(tree or {}),
    }
    text = json.dumps(found).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(blob), b"BIN\0") + blob
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def ply(of="face", kind="uchar", colours=((10, 100, 10), (255, 255, 255))):
    """The plates in text or binary, with colours of faces or of vertices."""
    names = "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 8\n"
    head += "property float x\nproperty float y\nproperty float z\n" + names * (of == "vertex")
    head += "element face 4\nproperty list uchar int vertex_indices\n" + names * (of == "face")
    code = {"uchar": "3B", "float": "3f"}[kind]
    body = b""
    for i, point in enumerate(PLATES):
        body += struct.pack("<3f", *point)
        body += struct.pack(f"<{code}", *colours[i // 4]) if of == "vertex" else b""
    for i, face in enumerate(FACES):
        body += struct.pack("<B3i", 3, *face)
        body += struct.pack(f"<{code}", *colours[i // 2]) if of == "face" else b""
    return f"{head}end_header\n".encode() + body
