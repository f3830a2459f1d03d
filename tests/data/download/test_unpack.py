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

from qs3.data.download.unpack import Limits, kind_of, safe_path, unpack
from qs3.errors import DataError, Qs3Error

FILES = {"top/chair/train/a.xyz": b"1 2 3\n" * 1000, "top/chair/test/b.xyz": b"", "readme": b"hi"}


def make_zip(path, files=FILES, **more):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def make_tar(path, files=FILES, mode="w:gz", extra=()):
    with tarfile.open(path, mode) as archive:
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
        for info in extra:
            archive.addfile(info)
    return path


def below(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.mark.parametrize("mode", ["zip", "w", "w:gz", "w:bz2", "w:xz"])
def test_what_is_inside_comes_out(tmp_path, mode):
    path = tmp_path / "archive"  # the kind is told by the bytes, not by the name
    path = make_zip(path) if mode == "zip" else make_tar(path, mode=mode)
    told = []
    assert unpack(path, tmp_path / "out", report=lambda *a: told.append(a)) == 3
    assert below(tmp_path / "out") == FILES
    assert told[-1][0] == sum(map(len, FILES.values()))


def test_rights_and_companions_are_left_behind(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        info = zipfile.ZipInfo("run.sh")
        info.external_attr = (stat.S_IFREG | 0o6777) << 16
        archive.writestr(info, "echo")
        for name in ("__MACOSX/chair/._a.xyz", "chair/._a.xyz", ".DS_Store", "empty/"):
            archive.writestr(name, "")
    unpack(path, tmp_path / "out")
    assert below(tmp_path / "out") == {"run.sh": b"echo"}
    assert (tmp_path / "out" / "run.sh").stat().st_mode & 0o7111 == 0


OUTSIDE = ["../evil", "a/../../evil", "/tmp/evil", "..", "C:/evil", "a\\..\\..\\evil", "a\x07b"]


@pytest.mark.parametrize("name", OUTSIDE)
@pytest.mark.parametrize("make", [make_zip, make_tar])
def test_names_that_lead_out(tmp_path, make, name):
    path = make(tmp_path / "archive", {"ok": b"1", name: b"evil"})
    with pytest.raises(DataError, match=r"archive, member .*refused"):
        unpack(path, tmp_path / "in" / "out")
    assert set(below(tmp_path)) <= {"archive", "in/out/ok"}


def special(kind, name="link", target=""):
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, target
    return info


@pytest.mark.parametrize(
    ("kind", "target"),
    [
        (tarfile.SYMTYPE, "/etc/passwd"),
        (tarfile.SYMTYPE, "../../outside"),
        (tarfile.SYMTYPE, "readme"),
        (tarfile.LNKTYPE, "/etc/passwd"),
        (tarfile.LNKTYPE, "readme"),
        (tarfile.CHRTYPE, ""),
        (tarfile.BLKTYPE, ""),
        (tarfile.FIFOTYPE, ""),
        (b"?", ""),
    ],
)
def test_links_and_devices_in_a_tar(tmp_path, kind, target):
    path = make_tar(tmp_path / "a.tar", mode="w", extra=[special(kind, "link", target)])
    with pytest.raises(DataError, match=r"member 'link': a link, a device or a sparse file; ref"):
        unpack(path, tmp_path / "out")
    assert not os.path.lexists(tmp_path / "out" / "link")


def test_a_file_through_a_link_to_a_folder_outside(tmp_path):
    (tmp_path / "outside").mkdir()
    path = tmp_path / "a.tar"
    with tarfile.open(path, "w") as archive:
        archive.addfile(special(tarfile.SYMTYPE, "d", str(tmp_path / "outside")))
        archive.addfile(tarfile.TarInfo("d/evil"))
    with pytest.raises(DataError, match="'d': a link"):
        unpack(path, tmp_path / "out")
    assert list((tmp_path / "outside").iterdir()) == []


def test_a_link_in_a_zip(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        info = zipfile.ZipInfo("link")
        info.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(info, "/etc/passwd")
    with pytest.raises(DataError, match="a link or a device; refused"):
        unpack(path, tmp_path / "out")


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_members_of_one_name(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/b", "1")
        archive.writestr("a/./b", "2")
    with pytest.raises(DataError, match="a second file of this name"):
        unpack(path, tmp_path / "out")
    make_tar(path, {"a": b"1", "a/b": b"2"})
    with pytest.raises(DataError, match="the same name is also that of a folder or file"):
        unpack(path, tmp_path / "out2")


def test_bombs(tmp_path):
    zeros = bytes(100 << 20)
    for path in (make_zip(tmp_path / "z", {"bomb": zeros}), make_tar(tmp_path / "t", {"b": zeros})):
        assert path.stat().st_size < 1 << 20
        with pytest.raises(DataError, match=r"unpacks to more than 0\.07 GB"):
            unpack(path, tmp_path / "out" / path.name)
    written = sum(len(content) for content in below(tmp_path / "out").values())
    assert written <= 64 << 20


def test_many_members(tmp_path):
    path = make_zip(tmp_path / "z", {f"f{i}": b"" for i in range(20)})
    unpack(path, tmp_path / "enough", Limits(members=20))
    with pytest.raises(DataError, match="more than 19 members"):
        unpack(path, tmp_path / "out", Limits(members=19))


def test_a_header_that_lies(tmp_path):
    path = make_zip(tmp_path / "z", {"a": bytes(range(256)) * 4096})
    data = bytearray(path.read_bytes())
    at = data.index(b"PK\x01\x02") + 24  # uncompressed size in the central directory
    data[at : at + 4] = (1000).to_bytes(4, "little")
    path.write_bytes(data)
    with pytest.raises(DataError, match="is damaged"):
        unpack(path, tmp_path / "out")


def test_encrypted(tmp_path):
    path = make_zip(tmp_path / "z", {"a": b"1"})
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\x01\x02") + 8] |= 1
    data[6] |= 1
    path.write_bytes(data)
    with pytest.raises(DataError, match="'a': encrypted; refused"):
        unpack(path, tmp_path / "out")


@pytest.mark.parametrize("mode", ["zip", "w", "w:gz", "w:bz2", "w:xz"])
def test_any_truncation_is_an_error_that_names_the_archive(tmp_path, mode):
    content = {"top/a": os.urandom(20_000), "top/b": b"x" * 5000}
    path = tmp_path / "whole"
    data = (
        make_zip(path, content) if mode == "zip" else make_tar(path, content, mode)
    ).read_bytes()
    sizes = [0, 3, 100, 600, len(data) // 2, len(data) * 8 // 10]
    if mode == "w":  # exactly behind the first member, and in the header of the second
        sizes += [512 + 20_480, 512 + 20_480 + 100]
    for number, size in enumerate(sizes):
        cut = tmp_path / f"cut{number}"
        cut.write_bytes(data[:size])
        with pytest.raises(DataError, match=f"cut{number}.* (is damaged|no zip and no tar)"):
            unpack(cut, tmp_path / f"out{number}")


@pytest.mark.parametrize("mode", ["zip", "w:gz", "w:bz2", "w:xz"])
def test_a_flipped_bit_is_found(tmp_path, mode):
    content = {"a": os.urandom(50_000)}
    path = tmp_path / "whole"
    data = (
        make_zip(path, content) if mode == "zip" else make_tar(path, content, mode)
    ).read_bytes()
    damaged = bytearray(data)
    damaged[len(data) // 2] ^= 4
    path.write_bytes(damaged)
    with pytest.raises(DataError, match="is damaged"):
        unpack(path, tmp_path / "out")


@pytest.mark.parametrize("behind", [8, 4])
def test_the_checksum_behind_a_tar_is_read(tmp_path, behind):
    """It lies where tarfile does not look: here even behind a full buffer of ours."""
    size = (5 << 20) - 512 - 1024  # with header and end a multiple of all block sizes
    path = make_tar(tmp_path / "a", {"a": bytes(range(256)) * (size // 256)})
    unpack(path, tmp_path / "whole")
    data = bytearray(path.read_bytes())
    data[-behind] ^= 1  # CRC-32 or length of what was packed
    path.write_bytes(data)
    with pytest.raises(DataError, match="is damaged"):
        unpack(path, tmp_path / "out")


@pytest.mark.parametrize(
    ("head", "message"),
    [
        (b"Rar!\x1a\x07\x00", "is a rar archive"),
        (b"7z\xbc\xaf\x27\x1c", "is a 7z archive"),
        (b"\n<!DOCTYPE html><html>", "but a web page"),
        (b"hello", "no zip and no tar archive;"),
        (b"", "no zip and no tar archive;"),
    ],
)
def test_other_files(tmp_path, head, message):
    (tmp_path / "a").write_bytes(head)
    with pytest.raises(DataError, match=message):
        kind_of(tmp_path / "a")


def test_a_gzip_that_is_no_tar(tmp_path):
    (tmp_path / "a").write_bytes(gzip.compress(b"hello" * 1000))
    with pytest.raises(DataError, match="is damaged"):
        unpack(tmp_path / "a", tmp_path / "out")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_no_permission(tmp_path):
    path = make_zip(tmp_path / "z")
    (tmp_path / "shut").mkdir(mode=0o500)
    with pytest.raises((Qs3Error, OSError)):
        unpack(path, tmp_path / "shut" / "out")


@given(st.text(st.characters(blacklist_categories=["Cs"]), max_size=40))
def test_no_name_leads_out(name):
    try:
        path = safe_path(name, "here")
    except DataError:
        return
    if path is not None:
        assert os.path.normpath(os.path.join("/in", str(path))).startswith("/in/")


@given(st.lists(st.sampled_from(["..", ".", "a", "", "/", "\\", "C:", "~"]), max_size=6))
def test_no_path_leads_out(parts):
    test_no_name_leads_out.hypothesis.inner_test("/".join(parts))
