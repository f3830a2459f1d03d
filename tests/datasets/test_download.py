"""From a name to the folder that a domain reads; archives as they might be published."""

from __future__ import annotations

import dataclasses
import functools
import io
import tarfile
import threading
import zipfile
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest

from qs3.datasets.download import (
    BY_HAND,
    SOURCES,
    AgreementError,
    fetch,
    provide,
    unpack,
)
from qs3.datasets.published import PointDAH5, PublishedTree
from qs3.errors import DataError, Qs3Error
from tests.fixtures import published as fixtures
from tests.running import main

SPLITS = {"train": 2, "test": 1}


class Quiet(SimpleHTTPRequestHandler):
    """A server of a folder; after a request for it, `cut.zip` breaks off in its middle."""

    def log_message(self, *args):
        self.server.requests.append(self.path)

    def copyfile(self, source, target):
        data = source.read()
        target.write(data[: len(data) // 2] if self.path == "/cut.zip" else data)


@pytest.fixture
def site(tmp_path_factory, monkeypatch):
    """A folder that is served, and the server."""
    monkeypatch.setenv("no_proxy", "*")
    folder = tmp_path_factory.mktemp("site")
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=folder))
    server.folder, server.requests = folder, []
    server.address = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


def zipped(folder):
    """A folder's files as the bytes of a .zip."""
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                archive.write(path, path.relative_to(folder))
    return memory.getvalue()


@pytest.fixture(scope="module")
def speckle(tmp_path_factory):
    """SpeckleNet10 as an archive with a folder too many, a list and Mac OS's companions."""
    folder = tmp_path_factory.mktemp("author")
    fixtures.write_tree(folder / "sim2real" / "raw_pc_multiview_point_at", SPLITS)
    (folder / "sim2real" / "list.txt").write_text("a list")
    (folder / "__MACOSX").mkdir()
    (folder / "__MACOSX" / "._list.txt").write_text("")
    return zipped(folder)


def served(site, name):
    """A source, as if it were published there."""
    source = SOURCES[name]
    return dataclasses.replace(source, address=f"{site.address}/{source.file}", drive="")


def get(site, name, folder, **more):
    return provide(served(site, name), folder, **more)


def visible(folder):
    return sorted(p.name for p in folder.iterdir() if not p.name.startswith("."))


def test_from_the_server_to_the_domain(site, tmp_path, speckle):
    (site.folder / "specklenet10.zip").write_bytes(speckle)
    place = tmp_path / "published" / "specklenet10"
    place.mkdir(parents=True)  # an empty folder is not in the way
    left = tmp_path / "published" / ".specklenet10.unpacking" / "half"  # of a killed run
    left.mkdir(parents=True)
    assert get(site, "specklenet10", tmp_path) == [place]
    assert not left.exists()
    _, rows = PublishedTree(place).read(fixtures.CLASSES, tmp_path)
    assert len(rows) == 30
    assert visible(tmp_path / "published") == ["specklenet10"]
    assert visible(tmp_path / "downloads") == ["specklenet10.zip"]
    get(site, "specklenet10", tmp_path)  # there is nothing left to do
    assert len(site.requests) == 1
    place.rename(tmp_path / "attic")  # a lost folder comes from the archive that was kept
    assert get(site, "specklenet10", tmp_path) == [place]
    assert len(site.requests) == 1


def test_a_broken_download_is_no_file(site, tmp_path, speckle):
    source = SOURCES["specklenet10"]
    (site.folder / "cut.zip").write_bytes(speckle)
    cut = type(source)("cut", "", "", (), f"{site.address}/cut.zip")
    with pytest.raises(Qs3Error):
        fetch(cut, tmp_path / "cut.zip")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(Qs3Error):
        get(site, "specklenet40", tmp_path)  # is not there


def test_scannet_needs_an_agreement(site, tmp_path, speckle):
    (site.folder / "depthscannet10.zip").write_bytes(speckle)
    for word in ("", "yes"):
        with pytest.raises(AgreementError, match="accept_terms=scannet"):
            get(site, "depthscannet10", tmp_path, accept_terms=word)
    assert list(tmp_path.iterdir()) == []
    get(site, "depthscannet10", tmp_path, accept_terms="scannet")
    need = {source.name for source in SOURCES.values() if source.agreement}
    assert need == {"depthscannet10", "scannet10", "pointda10"}


def test_pointda_is_taken_apart(site, tmp_path, tmp_path_factory):
    folder = tmp_path_factory.mktemp("author") / "PointDA_data"
    fixtures.write_tree(folder / "modelnet", SPLITS, ".npy")
    three = {"validation": 1, **SPLITS}
    fixtures.write_tree(folder / "shapenet", three, ".npy", points=1024, up="y")
    fixtures.write_pointda_h5(folder / "scannet", SPLITS)
    with tarfile.open(site.folder / "pointda10.zip", "w:gz") as archive:
        archive.add(folder, "PointDA_data")
    places = get(site, "pointda10", tmp_path, accept_terms="scannet")
    assert [place.name for place in places] == ["modelnet10", "shapenet10", "scannet10"]
    assert len(PublishedTree(places[0]).read(fixtures.CLASSES, tmp_path)[1]) == 30
    assert len(PublishedTree(places[1], points=1024).read(fixtures.CLASSES, tmp_path)[1]) == 40
    assert len(PointDAH5(places[2]).read(fixtures.CLASSES, tmp_path)[1]) == 30


def test_archives_with_no_tree_or_several(site, tmp_path, tmp_path_factory):
    folder = tmp_path_factory.mktemp("author")
    fixtures.write_tree(folder / "a", SPLITS, ".npy")
    (site.folder / "specklenet10.zip").write_bytes(zipped(folder))
    with pytest.raises(DataError, match="specklenet10"):
        get(site, "specklenet10", tmp_path)
    assert visible(tmp_path / "published") == []
    for name in ("noisy", "clean"):
        fixtures.write_tree(folder / name, SPLITS, points=16)
    (tmp_path / "own.zip").write_bytes(zipped(folder))
    words = ["download", "specklenet10", f"into={tmp_path}", f"archive={tmp_path / 'own.zip'}"]
    assert main(words) == 1
    assert (tmp_path / "own.zip").exists()


def test_nothing_is_written_outside_of_the_folder(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for name in ("a.txt", "../evil", "/evil", "b/../../evil"):
            archive.writestr(name, "")
    unpack(tmp_path / "a.zip", tmp_path / "zip" / "in")
    evil, link = tarfile.TarInfo("../evil"), tarfile.TarInfo("link")
    link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
    for member in (evil, link):
        with tarfile.open(tmp_path / "a.tar", "w") as archive:
            archive.addfile(member)
        with pytest.raises(DataError, match=r"a\.tar"):
            unpack(tmp_path / "a.tar", tmp_path / "tar" / member.name[-4:])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.tar", "a.zip", "tar", "zip"]
    assert [p.name for p in (tmp_path / "zip").iterdir()] == ["in"]
    (tmp_path / "c.zip").write_bytes((tmp_path / "a.zip").read_bytes()[:-99])
    with pytest.raises(DataError, match=r"c\.zip"):
        unpack(tmp_path / "c.zip", tmp_path / "c")


def test_the_command(site, tmp_path, speckle, monkeypatch, capsys):
    monkeypatch.setitem(SOURCES, "specklenet10", served(site, "specklenet10"))
    (site.folder / "specklenet10.zip").write_bytes(speckle)
    assert main(["download", "specklenet10", f"into={tmp_path}"]) == 0
    assert f"{tmp_path}/published/specklenet10 is there" in capsys.readouterr().out
    assert main(["download", "scannet10", f"into={tmp_path}"]) == 1
    assert "accept_terms=scannet" in capsys.readouterr().out
    assert main(["download", "scannet11"]) == 1
    assert main(["download"]) == 0
    text = capsys.readouterr().out
    for name in (*SOURCES, *BY_HAND):
        assert name in text
        assert name in SOURCES or main(["download", name]) == 1
