"""Archives by others: what is read of them, and when they are refused."""

import gzip
import io
import tarfile

import pytest

from qs3.errors import DataError
from qs3.utils.tars import DAMAGE, is_whole, members_of, open_tar


def header(name, size):
    """Of a member that says it has so many bytes; GNU's way of writing numbers of any size."""
    info = tarfile.TarInfo(name)
    info.size = size
    return info.tobuf(tarfile.GNU_FORMAT)


@pytest.mark.parametrize("pack", [lambda data: data, gzip.compress], ids=["tar", "gz"])
def test_members_one_after_the_other(tmp_path, pack):
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w") as archive:
        for name, content in (("a", b"one"), ("folder/b", bytes(3000))):
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    path = tmp_path / "a"
    path.write_bytes(pack(file.getvalue()))
    with open_tar(path) as archive:
        found = [(info.name, info.size) for info in members_of(archive)]
        assert found == [("a", 3), ("folder/b", 3000)]
        assert is_whole(archive)


@pytest.mark.parametrize("size", [1 << 63, 1 << 80, (1 << 62) + 1, -(1 << 80)])
@pytest.mark.parametrize("pack", [lambda data: data, gzip.compress], ids=["tar", "gz"])
def test_a_member_longer_than_any_file_is_refused(tmp_path, pack, size):
    path = tmp_path / "a.tar"
    path.write_bytes(pack(header("a", size) + bytes(2048)))
    with (
        open_tar(path) as archive,
        pytest.raises(DataError, match=r"a\.tar: a member that ends at -?\d{19,}"),
    ):
        list(members_of(archive))


def test_a_header_whose_lines_have_no_end_is_damage(tmp_path):
    lines = f"{10**30} path=a\n".encode()
    about = tarfile.TarInfo("PaxHeaders/a")
    about.type, about.size = tarfile.XHDTYPE, len(lines)
    path = tmp_path / "a.tar"
    padding = bytes(-len(lines) % 512)
    path.write_bytes(about.tobuf(tarfile.USTAR_FORMAT) + lines + padding + header("a", 0))
    with pytest.raises(DAMAGE), open_tar(path) as archive:
        list(members_of(archive))
