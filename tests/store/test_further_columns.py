"""Columns that only some datasets have: read as written, and others keep their bytes."""

import pytest

from qs3.errors import DataError
from qs3.store.manifest import ManifestRow, number, read_manifest, to_csv


def rows(*more):
    return number(
        [ManifestRow(f"chair/test/{i}", "chair", "test", more=of) for i, of in enumerate(more)]
    )


def test_as_written(tmp_path):
    made = rows({"tier": "clean"}, {}, {"sensor": "kv1", "tier": 'a "quoted", one'})
    (tmp_path / "manifest.csv").write_text(to_csv(made))
    assert read_manifest(tmp_path, ["chair"]) == made
    assert hash(made[0]) == hash(rows({})[0])


def test_without_them_nothing_is_added(tmp_path):
    text = to_csv(rows({}, {}))
    assert text.splitlines()[0].endswith("status,reason")
    (tmp_path / "manifest.csv").write_text(text.replace("status,reason", "status,reason,id"))
    with pytest.raises(DataError, match="line 1: the columns"):
        read_manifest(tmp_path, ["chair"])
    (tmp_path / "manifest.csv").write_text(text.replace("status,reason", "status,reason,tier"))
    with pytest.raises(DataError, match="11 columns, not 12"):
        read_manifest(tmp_path, ["chair"])
