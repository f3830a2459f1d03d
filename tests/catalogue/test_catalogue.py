"""The catalogue: whose objects it holds, that they never change, and what they are made of."""

import hashlib
import pickle
import subprocess
import sys
from collections import Counter

from qs3.catalogue import Catalogue, families
from qs3.classes import CLASSES

SOME = ("lamp", "monitor", "plant")


def test_items_are_ordered_by_class_split_and_index():
    items = Catalogue(train=2, test=1, classes=("plant", "lamp")).items()
    assert [item.id for item in items] == [
        f"{cls}/{split}/{cls}_{i:04d}"
        for cls in ("lamp", "plant")
        for split, n in (("train", 2), ("test", 1))
        for i in range(n)
    ]
    assert {item.origin.split("/")[0] for item in items} == {"catalogue:lamp", "catalogue:plant"}
    catalogue = Catalogue(
        train={"lamp": 3, "plant": 0, "bed": 9}, test=1, classes=["lamp", "plant"]
    )
    items = catalogue.items()
    assert catalogue.classes == ("lamp", "plant")
    assert Counter((i.cls, i.split) for i in items) == {
        ("lamp", "train"): 3,
        ("lamp", "test"): 1,
        ("plant", "test"): 1,
    }


def test_more_objects_never_change_the_earlier_ones():
    small = Catalogue(train=2, test=1, classes=SOME).items()
    large = {item.id: item for item in Catalogue(train=9, test=5, classes=CLASSES[5:]).items()}
    for item in small:
        assert large[item.id].origin == item.origin
        travelled = pickle.loads(pickle.dumps(large[item.id]))  # as to a worker
        assert travelled.load().sha256 == item.load().sha256


def test_a_split_uses_its_families_evenly():
    items = Catalogue(train=60, test=60).items()
    used = Counter((item.cls, item.split, item.origin.split("/")[1]) for item in items)
    for cls in CLASSES:
        for split in ("train", "test"):
            counts = [used[cls, split, f.name] for f in families(cls) if f.split == split]
            assert max(counts) - min(counts) <= 1
            assert sum(counts) == 60  # hence no family of the other split


def test_shared_families_are_in_both_splits_and_their_meshes_in_one():
    items = Catalogue(train=40, test=40, classes=("lamp",), families="shared").items()
    used = {split: {i.origin for i in items if i.split == split} for split in ("train", "test")}
    assert used["train"] == used["test"] == {f"catalogue:lamp/{f.name}" for f in families("lamp")}
    assert len({item.load().sha256 for item in items}) == 80


def test_every_class_has_families_for_both_splits():
    for cls in CLASSES:
        split = Counter(family.split for family in families(cls))
        assert set(split) == {"train", "test"}, cls
        assert split["train"] >= 3, cls  # accuracy on real CAD models suffers with fewer
        assert split["test"] >= 2, cls
        assert len({family.name for family in families(cls)}) == len(families(cls)), cls


def test_two_seeds_share_no_mesh_and_order_families_each_in_its_way():
    items = [Catalogue(seed=seed, train=1, test=1).items() for seed in (0, 1)]
    hashes = [item.load().sha256 for some in items for item in some]
    assert len(set(hashes)) == len(hashes)
    assert [item.origin for item in items[0]] != [item.origin for item in items[1]]


SCRIPT = """
import hashlib, sys
from qs3.catalogue import Catalogue
items = Catalogue(seed=3, train=1, test=1).items()
text = " ".join(f"{i.id} {i.origin} {i.load().sha256}" for i in items)
print(hashlib.sha256(text.encode()).hexdigest())
print(sorted({'torch', 'bpy', 'mitsuba', 'lightning', 'scipy'} & set(sys.modules)))
"""


def test_the_same_meshes_in_another_process_without_a_heavy_library():
    command = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    items = Catalogue(seed=3, train=1, test=1).items()
    text = " ".join(f"{i.id} {i.origin} {i.load().sha256}" for i in items)
    assert done.stdout.split("\n")[:2] == [hashlib.sha256(text.encode()).hexdigest(), "[]"]
