"""A folder of meshes: layouts, splits, halves, and what must not be in it."""

import collections
import pickle

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.classes import CLASSES
from qs3.errors import ConfigError, MissingDataError
from qs3.meshes.folder import MeshFolder

OFF = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"


def make(root, *names):
    """Create files; those of a mesh format hold a triangle."""
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(OFF)
    return root


def ids(root, **settings):
    settings.setdefault("classes", ("chair",))
    return [item.id for item in MeshFolder(root, **settings).items()]


def chairs(n):
    return [f"chair/c{i:03d}.off" for i in range(n)]


def test_given_splits_are_kept_and_validation_is_train(tmp_path):
    make(
        tmp_path,
        *("chair/Train/b.off", "chair/train/a.off", "chair/test/z.ply", "chair/val/v.OBJ"),
        *("chair/validation/w.off", "table/train/t.off", "table/test/t.off"),
    )
    items = MeshFolder(tmp_path, classes=("table", "chair")).items()
    assert [item.id for item in items] == [
        *("chair/train/a", "chair/train/b", "chair/train/v", "chair/train/w", "chair/test/z"),
        *("table/train/t", "table/test/t"),
    ]
    assert [item.origin for item in items][:3] == [
        *("chair/train/a.off", "chair/Train/b.off", "chair/val/v.OBJ"),
    ]
    assert (items[0].cls, items[0].split) == ("chair", "train")
    assert len(pickle.loads(pickle.dumps(items[0])).load().faces) == 1


def test_names_of_other_datasets(tmp_path):
    make(tmp_path, "Night_Stand/a.off", "night stand/b.off", "CABINET/c.off", "couch/d.off")
    make(tmp_path, "shelf/e.off")
    found = MeshFolder(tmp_path, classes=("sofa", "cabinet", "bookshelf")).items()
    assert sorted(item.id.replace("/test/", "/train/") for item in found) == [
        *("bookshelf/train/e", "cabinet/train/a", "cabinet/train/b", "cabinet/train/c"),
        "sofa/train/d",
    ]


def test_unknown_folders(tmp_path):
    others = [name for name in CLASSES if name != "cabinet"]
    make(tmp_path, *(f"{name}/a.off" for name in others), "toilet/a.off", "cabinets/a.off")
    make(tmp_path, "docs/read.me")
    with pytest.raises(MissingDataError, match="cabinets, toilet"):
        MeshFolder(tmp_path).items()
    make(tmp_path, "night_stand/train/a.off")
    folder = MeshFolder(tmp_path)
    assert [item.cls for item in folder.items()] == list(CLASSES)
    assert folder.left_alone() == ["cabinets", "toilet"]
    assert ids(tmp_path) == ["chair/train/a"]
    assert len(MeshFolder(tmp_path, classes=("chair",)).left_alone()) == 11


@pytest.mark.parametrize("settings", [{}, {"classes": ("chair", "plant")}])
def test_missing_classes_and_roots(tmp_path, settings):
    with pytest.raises(MissingDataError):
        MeshFolder(tmp_path / "gone", **settings).items()
    make(tmp_path, *(f"{name}/a.off" for name in CLASSES if name != "plant"))
    with pytest.raises(MissingDataError, match="plant"):
        MeshFolder(tmp_path, **settings).items()
    make(tmp_path, "plant/readme.txt")
    with pytest.raises(MissingDataError, match="plant"):
        MeshFolder(tmp_path, **settings).items()


def test_optional_classes_may_lack(tmp_path):
    make(tmp_path, "chair/train/a.off", "chair/train/b.off", "lamp/train/a.off")
    some = MeshFolder(tmp_path, optional=CLASSES)
    assert [item.id for item in some.items()] == [
        *("chair/train/a", "chair/train/b", "lamp/train/a"),
    ]
    # The odd lamp is in the first half.
    second = MeshFolder(tmp_path, optional=CLASSES, half="second")
    assert [item.cls for item in second.items()] == ["chair"]
    with pytest.raises(MissingDataError, match="bed"):
        MeshFolder(tmp_path, classes=("bed", "chair"), optional=("lamp",)).items()
    with pytest.raises(MissingDataError, match="bed"):  # not one of them
        MeshFolder(tmp_path, classes=("bed",), optional=CLASSES).items()


@pytest.mark.parametrize(
    "names",
    [
        ["chair/a.off", "chair/train/b.off"],  # two layouts
        ["chair/train/a.off", "chair/train/a.obj"],  # two files for one object
        ["chair/train/a.off", "chair/val/a.off"],
        ["Chair/a.off", "chair/a.ply"],
        ["chair/good/a.off"],  # neither a class nor a split
        ["chair/train/a.off", "chair/train/more/b.off"],
        ["chair/a.off", "chair/more/models/b.off"],
    ],
)
def test_ambiguous_folders_are_refused(tmp_path, names):
    make(tmp_path, *names)
    with pytest.raises(ConfigError):
        ids(tmp_path)


@settings(max_examples=30, deadline=None)
@given(n=st.integers(1, 40), fraction=st.floats(0.01, 0.99))
def test_split_has_the_fraction_and_leaves_neither_side_empty(tmp_path_factory, n, fraction):
    root = make(tmp_path_factory.mktemp("split"), *chairs(n))
    found = ids(root, test_fraction=fraction)
    tests = sum("/test/" in name for name in found)
    assert len(found) == n
    assert abs(tests - n * fraction) <= 1
    if n >= 2:
        assert 0 < tests < n


def test_split_depends_on_names_only_and_hardly_on_company(tmp_path):
    first = ids(make(tmp_path / "a", *chairs(50)))
    second = ids(make(tmp_path / "b", *(n.replace(".off", ".ply") for n in reversed(chairs(50)))))
    assert first == second
    more = ids(make(tmp_path / "b", "chair/another.off"))
    assert len(set(first) - set(more)) <= 1  # at most one file changes sides
    tables = ids(
        make(tmp_path / "c", *(n.replace("chair", "table") for n in chairs(50))), classes=("table",)
    )
    assert [n.replace("table", "chair") for n in tables] != first


@pytest.mark.parametrize("n", [2, 7])
def test_halves_share_nothing_and_miss_nothing(tmp_path, n):
    make(tmp_path, *(f"chair/{split}/c{i}.off" for split in ("train", "test") for i in range(n)))
    first, second = ids(tmp_path, half="first"), ids(tmp_path, half="second")
    assert not set(first) & set(second)
    assert sorted(first + second) == sorted(ids(tmp_path))
    counts = collections.Counter(name.split("/")[1] for name in second)
    assert counts == {"train": n // 2, "test": n // 2}
