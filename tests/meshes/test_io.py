"""Reading CAD files: what trimesh writes, and what the file itself can be."""

import errno
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from qs3.errors import MeshError, MeshUnavailableError
from qs3.meshes.formats import arrays
from qs3.meshes.io import load_mesh
from tests.meshes.written import EXPORTS, PYRAMID, SQUARE_OFF, corners, export, save, z_up


@pytest.mark.parametrize("name", EXPORTS)
def test_what_trimesh_writes_is_read(tmp_path, name):
    mesh = load_mesh(save(tmp_path, name, export(name)))
    expected = z_up(PYRAMID) if name.endswith("glb") else PYRAMID
    np.testing.assert_allclose(corners(mesh), corners(expected), atol=1e-6)


@pytest.mark.parametrize("newline", [b"\r\n", b"\r"])
def test_suffix_in_capitals_and_other_line_ends(tmp_path, newline):
    for name in ("a.off", "ascii.ply", "ascii.stl", "a.obj"):
        content = export(name).replace(b"\n", newline)
        mesh = load_mesh(save(tmp_path, name.upper(), content))
        np.testing.assert_allclose(corners(mesh), corners(PYRAMID), atol=1e-6)


def test_files_that_are_none(tmp_path):
    (tmp_path / "folder.off").mkdir()
    os.mkfifo(tmp_path / "fifo.off")
    for name, reason in [
        ("folder.off", "is not a file"),
        ("fifo.off", "is not a file"),
        ("gone.off", "does not exist"),
        ("a.step", "not of a known format"),
    ]:
        with pytest.raises(MeshError, match=reason):
            load_mesh(tmp_path / name)


def test_size_limits(tmp_path, monkeypatch):
    path = save(tmp_path, "a.off", SQUARE_OFF)
    monkeypatch.setattr(arrays, "MAX_FACES", 1)
    with pytest.raises(MeshError, match="limits"):
        load_mesh(path)
    monkeypatch.setenv("QS3_MEMORY_GB", "1e-7")
    with pytest.raises(MeshError, match=r"a\.off: takes .* of memory, more than 1e-07 GB"):
        load_mesh(path)


def test_huge_sparse_file_is_not_read(tmp_path):
    path = tmp_path / "huge.off"
    with path.open("wb") as handle:
        handle.truncate(600_000_000)
    with pytest.raises(MeshError, match=r"huge\.off: takes 2\.4 GB of memory, more than 2 GB"):
        load_mesh(path)


def test_loading_is_silent_and_errors_travel_between_processes(tmp_path, caplog, capfd):
    load_mesh(save(tmp_path, "a.off", SQUARE_OFF))
    with pytest.raises(MeshError) as caught:
        load_mesh(save(tmp_path, "a.glb", b"glTF" + bytes(30)))
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)
    assert not caplog.records
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("number", "kind", "reason"),
    [
        (errno.ESTALE, MeshUnavailableError, "cannot be read now"),
        (errno.EIO, MeshUnavailableError, "cannot be read now"),
        (errno.ENAMETOOLONG, MeshError, "cannot be read as OFF"),
    ],
)
def test_whether_the_disk_or_the_file_is_to_blame(tmp_path, monkeypatch, number, kind, reason):
    path = save(tmp_path, "a.off", SQUARE_OFF)
    broken = OSError(number, os.strerror(number))
    monkeypatch.setattr(Path, "read_bytes", lambda self: (_ for _ in ()).throw(broken))
    with pytest.raises(MeshError, match=rf"a\.off: {reason}") as caught:
        load_mesh(path)
    assert type(caught.value) is kind


def test_vertices_that_no_face_uses_change_nothing(tmp_path):
    """They would make furniture larger, and move where shadow rays begin."""
    square = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
    plain = load_mesh(save(tmp_path, "plain.obj", square + b"f 1 2 3 4\n"))
    stray = load_mesh(save(tmp_path, "stray.obj", b"v 500 0 0\n" + square + b"f 2 3 4 5\n"))
    assert stray.sha256 == plain.sha256
