"""From a name to the folder that a domain reads; archives as they might be published."""

import io
import json
import re
import tarfile
import zipfile
from pathlib import Path

import pytest

from qs3.datasets.download import catalogue
from qs3.datasets.download.catalogue import SOURCES, find
from qs3.datasets.download.cli import listing
from qs3.datasets.download.provide import MARK, AgreementError, provide
from qs3.datasets.importers import NpyTree, PointDAH5, XyzTree
from qs3.errors import ConfigError, DataError
from tests.datasets.download.server import File
from tests.fixtures import published as fixtures
from tests.running import main

SPLITS = {"train": 2, "test": 1}


def zipped(folder, inside=""):
    """A folder's files as the bytes of a .zip, below `inside`."""
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                archive.write(path, inside + str(path.relative_to(folder)))
    return memory.getvalue()


@pytest.fixture
def speckle(tmp_path_factory):
    """SpeckleNet10 as an archive with a folder too many, a list and Mac OS's companions."""
    folder = tmp_path_factory.mktemp("author")
    fixtures.write_xyz_tree(folder / "sim2real" / "raw_pc_multiview_point_at", SPLITS)
    (folder / "sim2real" / "list.txt").write_text("a list")
    (folder / "__MACOSX").mkdir()
    (folder / "__MACOSX" / "._list.txt").write_text("")
    return zipped(folder)


def get(site, name, folder, **more):
    return provide(find(name), folder, mirror=site.address, **more)


def visible(folder):
    return sorted(p.name for p in folder.iterdir() if not p.name.startswith("."))


def test_from_the_server_to_the_domain(site, tmp_path, speckle):
    site.files["/specklenet10.zip"] = File(speckle, drops=[len(speckle) // 2])
    place = tmp_path / "published" / "specklenet10"
    place.mkdir(parents=True)  # an empty folder is not in the way
    left = tmp_path / "published" / ".specklenet10.unpacking" / "half"  # of a killed run
    left.mkdir(parents=True)
    assert get(site, "specklenet10", tmp_path) == [place]
    assert not left.exists()
    _, rows = XyzTree(place).read(fixtures.CLASSES)
    assert len(rows) == 30
    assert visible(tmp_path / "published") == ["specklenet10"]
    assert visible(tmp_path / "downloads") == ["specklenet10.zip"]
    mark = json.loads((place / MARK).read_text())
    assert mark["root"] == "sim2real/raw_pc_multiview_point_at"
    assert mark["size"] == len(speckle)
    asked, stamp = len(site.requests), place.stat().st_mtime_ns
    get(site, "specklenet10", tmp_path)  # there is nothing left to do
    assert (len(site.requests), place.stat().st_mtime_ns) == (asked, stamp)


def test_a_lost_folder_comes_from_the_archive_that_was_kept(site, tmp_path, speckle):
    site.files["/specklenet10.zip"] = File(speckle)
    (place,) = get(site, "specklenet10", tmp_path)
    place.rename(tmp_path / "attic")
    assert get(site, "specklenet10", tmp_path) == [place]
    assert len(site.requests) == 1
    place.rename(tmp_path / "attic2")
    (tmp_path / "downloads" / "specklenet10.zip").write_bytes(speckle[:-99])
    with pytest.raises(DataError, match=r"specklenet10\.zip is damaged"):
        get(site, "specklenet10", tmp_path)
    assert visible(tmp_path / "published") == []


def test_what_somebody_put_there_is_left_alone(site, tmp_path, caplog):
    mine = tmp_path / "published" / "specklenet10" / "chair"
    mine.mkdir(parents=True)
    get(site, "specklenet10", tmp_path)
    assert "specklenet10 is there already (not put there by this command)" in caplog.text
    assert site.requests == []
    assert mine.is_dir()


def test_scannet_needs_an_agreement(site, tmp_path, speckle):
    site.files["/depthscannet10.zip"] = File(speckle)
    for word in ("", "yes"):
        again = re.escape(f"accept_terms=scannet into={tmp_path}\n")
        with pytest.raises(AgreementError, match=rf"(?s)ScanNet_TOS\.pdf.*{again}"):
            get(site, "depthscannet10", tmp_path, accept_terms=word)
    assert site.requests == []
    assert list(tmp_path.iterdir()) == []
    (place,) = get(site, "depthscannet10", tmp_path, accept_terms="scannet", keep=False)
    assert place.name == "depthscannet10"
    assert visible(tmp_path / "downloads") == []


def test_whatever_is_made_from_scannet_needs_it():
    need = {source.name for source in SOURCES if source.agreement}
    assert need == {"depthscannet10", "scannet10", "pointda10"}
    assert all("scannet" not in d for s in SOURCES if not s.agreement for d in s.domains)


def test_pointda_is_taken_apart(site, tmp_path, tmp_path_factory):
    folder = tmp_path_factory.mktemp("author") / "PointDA_data"
    fixtures.write_npy_tree(folder / "modelnet", SPLITS)
    three = {"validation": 1, **SPLITS}
    fixtures.write_npy_tree(folder / "shapenet", three, points=1024, up="y")
    fixtures.write_pointda_h5(folder / "scannet", SPLITS)
    memory = io.BytesIO()
    with tarfile.open(fileobj=memory, mode="w:gz") as archive:
        archive.add(folder, "PointDA_data")
    site.files["/pointda10.zip"] = File(memory.getvalue())
    places = get(site, "pointda10", tmp_path, accept_terms="scannet")
    assert [place.name for place in places] == ["modelnet10", "shapenet10", "scannet10"]
    assert len(NpyTree(places[0]).read(fixtures.CLASSES)[1]) == 30
    assert len(NpyTree(places[1], points=1024).read(fixtures.CLASSES)[1]) == 40
    assert len(PointDAH5(places[2]).read(fixtures.CLASSES)[1]) == 30


def test_archives_with_no_tree_or_several(site, tmp_path, tmp_path_factory):
    folder = tmp_path_factory.mktemp("author")
    fixtures.write_npy_tree(folder / "a", SPLITS)
    site.files["/specklenet40.zip"] = File(zipped(folder))
    with pytest.raises(DataError, match=r"(?s)Wanted is <class>.*a/chair/train: 2 files"):
        get(site, "specklenet40", tmp_path)
    assert visible(tmp_path / "published") == []
    for name in ("noisy", "clean"):
        fixtures.write_xyz_tree(folder / name, SPLITS)
    site.files["/specklenet10.zip"] = File(zipped(folder))
    with pytest.raises(DataError, match=r"several folders .* clean/, noisy/: give root="):
        get(site, "specklenet10", tmp_path)
    with pytest.raises(DataError, match="root=noise: no folder with files"):
        get(site, "specklenet10", tmp_path, root="noise")
    (place,) = get(site, "specklenet10", tmp_path, root="noisy/")
    assert json.loads((place / MARK).read_text())["root"] == "noisy"
    assert len(site.requests) == 2
    with pytest.raises(ConfigError, match="several parts"):
        get(site, "pointda10", tmp_path, root="a", accept_terms="scannet")


def test_an_unsafe_archive_leaves_nothing(site, tmp_path):
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w") as archive:
        archive.writestr("chair/train/a.xyz", "1 2 3")
        archive.writestr("../../evil", "evil")
    site.files["/specklenet10.zip"] = File(memory.getvalue())
    with pytest.raises(DataError, match="leads out of the folder"):
        get(site, "specklenet10", tmp_path)
    assert list((tmp_path / "published").iterdir()) == []


def test_an_archive_of_ones_own(tmp_path, speckle, capsys):
    (tmp_path / "from browser.zip").write_bytes(speckle)
    words = [f"into={tmp_path}", f"archive={tmp_path / 'from browser.zip'}"]
    assert main(["download", "specklenet10", *words, "keep=false"]) == 0
    assert "specklenet10 is there, for domain=specklenet10" in capsys.readouterr().out
    assert (tmp_path / "from browser.zip").exists()
    assert visible(tmp_path / "downloads") == []
    with pytest.raises(ConfigError, match="there is no such file"):
        provide(find("specklenet40"), tmp_path, archive=tmp_path / "no")
    with pytest.raises(ConfigError, match="not both"):
        provide(find("specklenet40"), tmp_path, archive=tmp_path, mirror="http://a")


def test_the_command(site, tmp_path, speckle, monkeypatch, capsys):
    monkeypatch.setenv("QS3_DOWNLOAD_MIRROR", site.address)
    site.files["/specklenet10.zip"] = File(speckle)
    assert main(["download", "specklenet10", f"into={tmp_path}"]) == 0
    assert f"{tmp_path}/published/specklenet10 is there" in capsys.readouterr().out
    assert main(["download", "specklenet40", f"into={tmp_path}"]) == 1
    assert "answered 404" in capsys.readouterr().err
    assert main(["download", "scannet10", f"into={tmp_path}"]) == 1
    assert "accept_terms=scannet" in capsys.readouterr().out
    assert main(["download", "chair"]) == 1
    assert "known are modelnet40_off" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["scannet", "shapenet", "scanobjectnn"])
def test_what_is_fetched_by_hand(name, capsys):
    assert main(["download", name]) == 1
    text = capsys.readouterr().out
    assert "http" in text
    assert "qs3 " in text or "domain scanobjectnn" in text


def test_list_and_help(capsys):
    assert main(["download"]) == 0
    text = capsys.readouterr().out
    assert text.strip() == listing().strip()
    for source in SOURCES:
        assert f"\n{source.name}\n" in text
        assert source.terms.split()[0] in text
    assert main(["download", "--help"]) == 0
    assert "accept_terms=" in capsys.readouterr().out


def test_names_and_files_are_unique():
    for field in ("name", "file"):
        values = [getattr(source, field) for source in SOURCES]
        assert len(set(values)) == len(values)
    assert not {source.name for source in SOURCES} & set(catalogue.BY_HAND)


def test_what_is_fetched_by_hand_is_listed_by_what_it_asks_for():
    """ScanNet's terms are signed; NYU asks for nothing but a citation."""
    _, after, without = listing().split("\nBy hand, ")
    assert after.startswith("after an agreement")
    assert without.startswith("without an agreement")
    for name, one in catalogue.BY_HAND.items():
        listed = after if one.asks == "after an agreement" else without
        assert f"\n    {name}: {one.terms.split()[0]}" in listed
    for name in ("scannet", "shapenet", "scanobjectnn"):
        assert name in after
    assert "nyuv2: no licence is stated; asks for a citation" in without
    assert "sunrgbd: asks for a citation" in without
    assert all(source.address.startswith("http") for source in SOURCES)
    assert all(source.agreement in ("", *catalogue.AGREEMENTS) for source in SOURCES)


def test_addresses_of_modelnet_are_those_of_pyg():
    from torch_geometric.datasets import ModelNet

    for name in ("10", "40"):
        source = find(f"modelnet{name}_off")
        assert source.address == ModelNet.urls[name]
        assert source.address.endswith(f"/{source.file}")


def test_nothing_in_a_run_imports_the_download():
    root = Path(__file__).parents[3]
    files = [*root.glob("*.py"), *(root / "qs3").rglob("*.py")]
    assert len(files) > 100
    own = root / "qs3" / "data" / "download"
    imports = re.compile(
        r"^\s*(from|import) +qs3\.data(\.download| import .*download)", re.MULTILINE
    )
    using = {file for file in files if imports.search(file.read_text())}
    assert using
    assert all(file.is_relative_to(own) for file in using)
