"""Which labelled clouds validate."""

from __future__ import annotations

import pytest

from qs3.datamodules.splits import lineage
from qs3.errors import DataError


def parts(ids: list[str]) -> tuple[list[str], list[str]]:
    train, validation = lineage(ids)
    assert sorted([*train, *validation]) == list(range(len(ids)))
    return [ids[i] for i in train], [ids[i] for i in validation]


def test_ninth_and_tenth_of_the_sorted_ids_validate():
    ids = [f"chair/train/{i:03d}" for i in range(25)]
    train, validation = parts(ids[::-1])
    assert validation == [ids[i] for i in (8, 9, 18, 19)]
    assert train == [i for i in ids if i not in validation]


def scans_of(objects: list[str]) -> list[str]:
    return [f"{name}{more}" for name in objects for more in ("", "~1", "~2", "~10")]


def test_all_scans_of_a_mesh_stay_on_one_side():
    meshes = [f"chair/train/chair_{i:04d}" for i in range(1, 31)]
    sides = [{name.partition("~")[0] for name in part} for part in parts(scans_of(meshes))]
    assert not sides[0] & sides[1]
    assert sides[1] == {meshes[i] for i in (8, 9, 18, 19, 28, 29)}
    once, _ = parts(meshes)
    assert set(once) == sides[0]  # as with one scan of each


def test_scans_do_not_replace_objects():
    with pytest.raises(DataError):
        parts([f"{i}{more}" for i in range(8) for more in ("", "~1")])
