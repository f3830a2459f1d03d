"""What is said of a place that is no finished dataset."""

import shlex
from pathlib import Path

import numpy as np
import pytest

from qs3.data.dataset_folder import RECIPE
from qs3.data.importers import CloudFolder, import_into
from qs3.data.inspection.cli import INSPECT
from qs3.data.inspection.open_dataset import open_named
from qs3.data.store import open_pointset
from qs3.errors import DataError, MissingDataError
from qs3.tools.large_jobs import measured
from tests.data.test_store import make
from tests.fixtures.published import write_domain


def said(place: Path, opened=open_pointset) -> str:
    with pytest.raises(MissingDataError) as caught:
        opened(place)
    return str(caught.value)


def typed(message: str) -> dict:
    """The arguments of the `qs3 inspect` that a message tells to type."""
    return INSPECT.parse(shlex.split(message.partition("qs3 inspect ")[2]))


def test_archive_of_objects(tmp_path, monkeypatch):
    write_domain("objects", tmp_path / "data")
    file = (tmp_path / "data" / "published" / "objects.npz").rename(tmp_path / "an archive.npz")
    message = said(file)
    assert message.startswith(f"{file} is an archive of objects, not a dataset's folder;")
    found = typed(message)
    assert found["domain"] == "objects"
    assert found["more"] == [f"published.file={file}"]
    monkeypatch.chdir(tmp_path)
    assert f"published.file='{file}'" in said(file.name, lambda name: open_named(name, {}))
    more = {"published.file": str(file), "paths.data_dir": "data"}
    assert open_named("objects", more).name == "objects"


def test_clouds(tmp_path):
    (tmp_path / "scans" / "monday").mkdir(parents=True)
    (tmp_path / "scans" / ".hidden.xyz").write_text("0 0 0\n")
    assert "is no dataset: it has no meta.yaml, and no clouds of .xyz" in said(tmp_path / "scans")
    cloud = tmp_path / "scans" / "monday" / "a.xyz"
    np.savetxt(cloud, np.eye(3))
    for opened in (open_pointset, measured):  # `qs3 inspect`, `qs3 plan`
        message = said(tmp_path / "scans", opened)
        assert "is a folder of clouds, not a dataset" in message
        assert "not finished" not in message
        assert typed(message)["more"] == [f"published.folder={tmp_path / 'scans'}"]
    assert "is a file, not a dataset's folder; a folder of clouds is" in said(cloud)


def test_folder_of_datasets(tmp_path):
    for name in ("a", "b"):
        make(tmp_path / name)
    message = said(tmp_path, measured)
    assert "holds datasets and is none itself; name one of them: " in message
    assert message.endswith(f"{tmp_path / 'a'}, {tmp_path / 'b'}")
    for number in range(6):
        make(tmp_path / f"c{number}")
    assert said(tmp_path).endswith(f"{tmp_path / 'c2'}, ...")


def test_only_what_was_begun_is_not_finished(tmp_path):
    assert said(tmp_path / "no").startswith("there is no dataset folder")
    make(tmp_path / "d")
    (tmp_path / "d" / "meta.yaml").unlink()
    assert "was not finished; run the same command again" in said(tmp_path / "d")
    generated = tmp_path / "g"
    generated.mkdir()
    (generated / RECIPE).write_text("{}")
    assert "was not finished; run the same command again" in said(generated)
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.xyz").write_text("0 0 zero\n")
    with pytest.raises(DataError):
        import_into(tmp_path / "i", CloudFolder(tmp_path / "in"), name="i", classes=("bed",))
    assert said(tmp_path / "i").startswith("there is no dataset folder")  # nothing was kept
    (tmp_path / ".i.parts").mkdir()
    assert "its import was not finished; run the same" in said(tmp_path / "i")
