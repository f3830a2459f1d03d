"""Clouds in every format that folders of own clouds may have."""

from __future__ import annotations

import struct
from pathlib import Path

import h5py
import numpy as np

from qs3.datasets.clouds import CloudFolder, checked, parse_cloud, with_depth
from qs3.datasets.domain import Domain

TWO = ("bed", "chair")
CLOUD = np.arange(12, dtype=np.float64).reshape(4, 3) / 8  # exact in float32 and in text


def write(path: Path, cloud: np.ndarray = CLOUD) -> Path:
    """One cloud in the format of the path's extension."""
    path.parent.mkdir(parents=True, exist_ok=True)
    kind = path.suffix.lower()
    if kind == ".xyz":
        np.savetxt(path, cloud)
    elif kind == ".txt":  # with normals, commas and a header
        lines = [",".join(map(str, [*row, 0, 0, 1])) for row in cloud.tolist()]
        path.write_text("\n".join(["# x,y,z,nx,ny,nz", *lines, "// the end"]) + "\n")
    elif kind == ".npy":
        np.save(path, cloud.astype("f4"))
    elif kind == ".npz":
        np.savez(path, points=cloud, colours=np.zeros((len(cloud), 3)))
    elif kind == ".ply":
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(cloud)}\n"
        head += "property float x\nproperty float y\nproperty float z\nproperty uchar red\n"
        rows = b"".join(struct.pack("<fffB", *row, 7) for row in cloud.tolist())
        path.write_bytes((head + "end_header\n").encode() + rows)
    elif kind == ".pcd":  # an image of two rows, one pixel more without a measurement
        rows = [*cloud.tolist(), *[[np.nan] * 3] * (len(cloud) % 2 or 2)]
        head = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        head += f"WIDTH {len(rows) // 2}\nHEIGHT 2\nVIEWPOINT 0 0 0 1 0 0 0\n"
        body = "\n".join(" ".join(map(str, row)) for row in rows)
        path.write_text(f"{head}POINTS {len(rows)}\nDATA ascii\n{body}\n")
    elif kind == ".h5":
        with h5py.File(path, "w") as file:
            file["data"] = cloud
    return path


def read_cloud(path: Path) -> np.ndarray:
    """[n, 3] float32: the one cloud of a file, as importers and predictions read it."""
    return checked(with_depth(parse_cloud(path), str(path))[0], str(path))


FORMATS = (".xyz", ".txt", ".npy", ".npz", ".ply", ".pcd", ".h5")


def own(tmp_path: Path, **settings) -> Domain:
    """The domain of tmp_path/in."""
    published = CloudFolder(folder=tmp_path / "in", points=4, **settings)
    return Domain("own", "O", "own clouds", tmp_path / "store", published=published, classes=TWO)
