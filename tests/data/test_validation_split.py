"""The lineage rule: which labelled clouds validate."""

from __future__ import annotations

import pytest
import torch

from qs3.data.datamodule import Labelled, split_lineage
from qs3.errors import DataError


def clouds(ids: list[str]) -> Labelled:
    return Labelled(torch.zeros(len(ids), 1, 3), tuple(ids), torch.arange(len(ids)))


def test_ninth_and_tenth_of_the_sorted_ids_validate():
    ids = [f"chair/train/{i:03d}" for i in range(25)]
    train, validation = split_lineage(clouds(ids[::-1]))
    assert validation.ids == tuple(ids[i] for i in (8, 9, 18, 19))
    assert train.ids == tuple(i for i in ids if i not in validation.ids)
    assert validation.labels.tolist() == [16, 15, 6, 5]


def test_all_scans_of_a_mesh_stay_on_one_side():
    meshes = [f"chair/train/chair_{i:04d}" for i in range(1, 31)]
    scans = [f"{mesh}{more}" for mesh in meshes for more in ("", "~1", "~2", "~10")]
    train, validation = split_lineage(clouds(scans))
    assert len(train.ids) + len(validation.ids) == len(scans)
    sides = [{name.partition("~")[0] for name in part.ids} for part in (train, validation)]
    assert not sides[0] & sides[1]
    assert sides[1] == {meshes[i] for i in (8, 9, 18, 19, 28, 29)}
    once, _ = split_lineage(clouds(meshes))
    assert set(once.ids) == sides[0]  # as with one scan of each


def test_scans_do_not_replace_objects():
    with pytest.raises(DataError, match="only 8 labelled training objects"):
        split_lineage(clouds([f"{i}{more}" for i in range(8) for more in ("", "~1")]))
