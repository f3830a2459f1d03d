"""Archives that are as they should be, and those that want out of their folder."""

import gzip
import io
import os
import stat
import tarfile
import zipfile

import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.datasets.download import archives
from qs3.datasets.download.archives import _safe_path, find_folder, unpack
from qs3.errors import DataError

FILES = {"top/chair/train/a.xyz": b"1 2 3\n" * 1000, "top/chair/test/b.xyz": b"", "readme": b"hi"}
MODES = ["zip", "w", "w:gz", "w:bz2", "w:xz"]


def make(path, mode="zip", files=FILES, extra=()):
    """An archive with files by name, and in a tar members that are not files."""
    if mode == "zip":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in files.items():
                archive.writestr(name, content)
        return path
    with tarfile.open(path, mode) as archive:
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
        for info in extra:
            archive.addfile(info)
    return path


def below(folder):
    found = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


@pytest.mark.parametrize("mode", MODES)
def test_what_is_inside_comes_out(tmp_path, mode):
    path = make(tmp_path / "archive", mode)  # the kind is told by the bytes, not by the name
    assert unpack(path, tmp_path / "out") == list(FILES)
    assert below(tmp_path / "out") == FILES


def test_rights_and_companions_are_left_behind(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        info = zipfile.ZipInfo("run.sh")
        info.external_attr = (stat.S_IFREG | 0o6777) << 16
        archive.writestr(info, "echo")
        for name in ("__MACOSX/chair/._a.xyz", "chair/._a.xyz", "empty/"):
            archive.writestr(name, "")
    assert unpack(path, tmp_path / "out") == ["run.sh"]
    assert (tmp_path / "out" / "run.sh").stat().st_mode & 0o7111 == 0


OUTSIDE = ["../evil", "a/../../evil", "/nowhere/evil", "..", "C:/evil", "a\\..\\..\\evil", "a\x07b"]


@pytest.mark.parametrize("name", OUTSIDE)
@pytest.mark.parametrize("mode", ["zip", "w:gz"])
def test_names_that_lead_out(tmp_path, mode, name):
    path = make(tmp_path / "archive", mode, {"ok": b"1", name: b"evil"})
    with pytest.raises(DataError, match=r"archive, member .*refused"):
        unpack(path, tmp_path / "in" / "out")
    assert set(below(tmp_path)) <= {"archive", "in/out/ok"}


@pytest.mark.parametrize("target", ["/etc/passwd", "../../outside", "readme"])
@pytest.mark.parametrize(
    "kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.BLKTYPE, tarfile.FIFOTYPE]
)
def test_links_and_devices_in_a_tar(tmp_path, kind, target):
    special = tarfile.TarInfo("link")
    special.type, special.linkname = kind, target
    path = make(tmp_path / "a.tar", "w", extra=[special])
    with pytest.raises(DataError, match=r"member 'link': a link, a device or a sparse file; ref"):
        unpack(path, tmp_path / "out")
    assert not os.path.lexists(tmp_path / "out" / "link")


def test_a_link_in_a_zip(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        info = zipfile.ZipInfo("link/")
        info.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(info, "/etc/passwd")
    with pytest.raises(DataError, match=r"a link, a device .*refused"):
        unpack(path, tmp_path / "out")


@pytest.mark.parametrize("names", [("a/b", "a/./b"), ("a", "a/b"), ("a/b", "a")])
def test_two_members_of_one_name(tmp_path, names):
    path = make(tmp_path / "a", "w", dict.fromkeys(names, b"1"))
    with pytest.raises(DataError, match="two members have the name"):
        unpack(path, tmp_path / "out")


@pytest.mark.parametrize("mode", ["zip", "w:gz"])
def test_bombs(tmp_path, mode):
    path = make(tmp_path / "bomb", mode, {"small": b"1", "large": bytes(100 << 20)})
    assert path.stat().st_size < 1 << 20
    with pytest.raises(DataError, match=r"'large': the archive unpacks to more than 0\.07 GB"):
        unpack(path, tmp_path / "out")
    assert below(tmp_path / "out") == {"small": b"1"}


def test_many_members(tmp_path, monkeypatch):
    path = make(tmp_path / "z", files={f"f{i}": b"" for i in range(20)})
    monkeypatch.setattr(archives, "MAX_MEMBERS", 20)
    unpack(path, tmp_path / "enough")
    monkeypatch.setattr(archives, "MAX_MEMBERS", 19)
    with pytest.raises(DataError, match="or 19 files; refused"):
        unpack(path, tmp_path / "out")


@pytest.mark.parametrize(
    "change",
    [
        lambda data, at: data.__setitem__(slice(at + 24, at + 28), bytes([232, 3, 0, 0])),  # size
        lambda data, at: (data.__setitem__(at + 8, 1), data.__setitem__(6, 1)),  # encrypted
        lambda data, at: data.__setitem__(slice(at + 10, at + 12), b"\x63\x00"),  # compression
    ],
)
def test_headers_of_a_zip_that_lie(tmp_path, change):
    path = make(tmp_path / "z", files={"a": bytes(range(256)) * 4096})
    data = bytearray(path.read_bytes())
    change(data, data.index(b"PK\x01\x02"))
    path.write_bytes(data)
    with pytest.raises(DataError, match="is damaged"):
        unpack(path, tmp_path / "out")


@pytest.mark.parametrize("mode", MODES)
def test_damage_is_an_error_that_names_the_archive(tmp_path, mode):
    path = make(tmp_path / "whole", mode, {"top/a": os.urandom(20_000), "top/b": b"x" * 5000})
    data = path.read_bytes()
    versions = [data[:size] for size in (0, 3, 100, 600, len(data) // 2, len(data) * 8 // 10)]
    if mode != "w":  # a tar without compression has no checksum of contents
        flipped = bytearray(data)
        flipped[len(data) // 2] ^= 4
        versions.append(flipped)
    if mode == "w:gz":  # CRC-32 and length of what was packed
        versions += [data[:-8] + bytes([data[-8] ^ 1]) + data[-7:], data[:-1] + b"\x07"]
    for number, damaged in enumerate(versions):
        cut = tmp_path / f"cut{number}"
        cut.write_bytes(damaged)
        with pytest.raises(DataError, match=rf"cut{number} is damaged.*archive=PATH"):
            unpack(cut, tmp_path / f"out{number}")


@pytest.mark.parametrize(
    "content",
    [b"Rar!\x1a\x07\x00", b"<!DOCTYPE html><html>", b"", gzip.compress(b"hello" * 1000)],
    ids=["rar", "html", "empty", "gzip of no tar"],  # gzip writes the time into its bytes
)
def test_other_files(tmp_path, content):
    (tmp_path / "a").write_bytes(content)
    with pytest.raises(
        DataError, match=r"is not a \.zip or \.tar file .* in another format you can"
    ):
        unpack(tmp_path / "a", tmp_path / "out")


@given(
    st.text(st.characters(blacklist_categories=["Cs"]), max_size=40)
    | st.lists(st.sampled_from(["..", ".", "a", "", "\\", "C:", "~"]), max_size=6).map("/".join)
)
def test_no_name_leads_out(name):
    try:
        path = _safe_path(name, "here")
    except DataError:
        return
    assert (os.path.normpath(os.path.join("/in", str(path))) + "/").startswith("/in/")


def test_the_folder_is_found_by_what_it_holds():
    holds = r"[^/]+/(?i:train|test)/[^/]+\.(?i:xyz)"
    files = [f"deep/{top}/chair/train/{i}.XYZ" for top in ("noisy", "Clean") for i in range(10)]
    assert find_folder(files[:10], holds) == "deep/noisy"
    assert find_folder(["chair/Test/a.xyz"], holds, at_least=1) == ""
    assert find_folder(files, holds, named="clean") == "deep/Clean"
    with pytest.raises(DataError, match=r"several .*deep/Clean/, deep/noisy/: give root=FOLDER"):
        find_folder(files, holds)
    with pytest.raises(DataError, match="no folder with the wanted files"):
        find_folder(files[:9], holds)
