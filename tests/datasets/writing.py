"""Writes scenes in ScanNet's real formats, by itself and not with the code that reads them."""

import io
import json
import struct
import zipfile
import zlib
from dataclasses import dataclass, field

import cv2
import numpy as np

LOST = np.full((4, 4), -np.inf)


def intrinsics(fx, fy, cx, cy):
    matrix = np.eye(4)
    matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2] = fx, fy, cx, cy
    return matrix


@dataclass
class Recording:
    """What a .sens holds; `depth` are uint16 images, `poses` take depth cameras to the world."""

    depth: list
    poses: list
    k_depth: np.ndarray
    k_colour: np.ndarray
    colour_size: tuple  # width, height
    base_from_depth: np.ndarray = field(default_factory=lambda: np.eye(4))
    base_from_colour: np.ndarray = field(default_factory=lambda: np.eye(4))
    shift: float = 1000.0
    compression: int = 1
    name: bytes = b"StructureSensor"
    version: int = 4

    def write(self, path):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(self.header() + b"".join(map(self.frame, range(len(self.depth)))) + IMU)

    def header(self):
        height, width = self.depth[0].shape
        matrices = (self.k_colour, self.base_from_colour, self.k_depth, self.base_from_depth)
        return b"".join(
            [
                struct.pack("<I", self.version),
                struct.pack("<Q", len(self.name)) + self.name,
                *(matrix.astype("<f4").tobytes() for matrix in matrices),
                struct.pack("<ii", 2, self.compression),
                struct.pack("<IIII", *self.colour_size, width, height),
                struct.pack("<f", self.shift),
                struct.pack("<Q", len(self.depth)),
            ]
        )

    def frame(self, index):
        width, height = self.colour_size
        grey = np.full((height, width, 3), 40 * index % 256, np.uint8)
        colour = cv2.imencode(".jpg", grey)[1].tobytes()
        depth = self.depth[index].astype("<u2").tobytes()
        if self.compression == 1:
            depth = zlib.compress(depth)
        sizes = struct.pack("<QQQQ", 33 * index, 33 * index + 1, len(colour), len(depth))
        return self.poses[index].astype("<f4").tobytes() + sizes + colour + depth


IMU = struct.pack("<Q", 0)


def png(image):
    return cv2.imencode(".png", image)[1].tobytes()


def write_zip(path, folder, images):
    """`images` by frame number: arrays, or bytes as they are."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(f"{folder}/", b"")
        for frame, image in images.items():
            data = image if isinstance(image, bytes) else png(image)
            file.writestr(f"{folder}/{frame}.png", data)


def write_aggregation(path, scene, labels):
    """`labels` by objectId."""
    groups = [
        {"id": number, "objectId": number, "segments": [number], "label": label}
        for number, label in labels.items()
    ]
    document = {
        "sceneId": scene,
        "appId": "Aggregator.v2",
        "segGroups": groups,
        "segmentsFile": f"{scene}_vh_clean_2.0.010000.segs.json",
    }
    path.write_text(json.dumps(document))


# id, raw_category, category; as in the real file, not in the order of the classes
LABELS = (
    (1, "wall", "wall"), (2, "chair", "chair"), (3, "floor", "floor"), (4, "table", "table"),
    (6, "couch", "couch"), (7, "cabinet", "cabinet"), (8, "shelf", "shelf"), (9, "sofa", "couch"),
    (11, "bed", "bed"), (18, "bookshelf", "bookshelf"), (19, "monitor", "monitor"),
    (23, "chairs", "chair"), (28, "lamp", "lamp"), (40, "plant", "plant"),
    (136, "bathtub", "bathtub"), (1337, "lamp ", "lamp"), (26, "box", "box"),
)  # fmt: skip
ID_OF = {raw.strip(): number for number, raw, _ in reversed(LABELS)}


def write_label_map(path, rows=LABELS):
    text = io.StringIO()
    text.write("id\traw_category\tcategory\tcount\tnyu40id\tShapeNetCore55\n")
    for number, raw, category in rows:
        text.write(f'{number}\t{raw}\t{category}\t1\t40\tit"s\n')
    path.write_text(text.getvalue())
