"""Which object is of which class."""

import json

import pytest

from qs3.classes import CLASSES
from qs3.datasets.scannet.labels import (
    NAMES,
    Labelled,
    read_label_map,
    read_objects,
    read_scene_list,
)
from qs3.errors import DataError, MissingDataError
from tests.datasets.scannet.writing import LABELS, write_aggregation, write_label_map


@pytest.fixture
def label_map(tmp_path):
    write_label_map(tmp_path / "labels.tsv")
    return read_label_map(tmp_path / "labels.tsv")


def test_the_ten_names_are_the_ten_classes_in_order():
    renamed = {"shelf": "bookshelf", "couch": "sofa"}
    assert tuple(renamed.get(name, name) for name in NAMES) == CLASSES


def test_names_are_taken_exactly_after_tidying(label_map):
    words = label_map.class_of_label
    assert words["chairs"] == "chair"
    assert words["sofa"] == words["couch"] == "sofa"
    assert words["shelf"] == "bookshelf"
    assert "bookshelf" not in words  # PointDA-10 takes "shelf" alone
    assert not {"wall", "box"} & set(words)
    assert label_map.class_of_id[23] == "chair"
    assert 18 not in label_map.class_of_id


def test_the_annotators_very_words_are_fewer(tmp_path):
    write_label_map(tmp_path / "labels.tsv")
    words = read_label_map(tmp_path / "labels.tsv", "raw_category").class_of_label
    assert set(words) == set(NAMES)


def test_scannet_v1s_map_has_only_a_category(tmp_path):
    lines = ["id\tcategory\tcount", *(f"{i}\t{raw}\t3" for i, raw, _ in LABELS)]
    (tmp_path / "v1.tsv").write_text("\n".join(lines))
    assert set(read_label_map(tmp_path / "v1.tsv").class_of_label) == set(NAMES)


def test_a_map_that_is_none_is_told(tmp_path):
    path = tmp_path / "labels.tsv"
    with pytest.raises(MissingDataError, match="the label map"):
        read_label_map(path)
    path.write_text("id,category\n1,chair\n")
    with pytest.raises(DataError, match=r"no columns .*is it scannetv2-labels"):
        read_label_map(path)
    write_label_map(path, [row for row in LABELS if row[2] != "lamp"])
    with pytest.raises(DataError, match="no label of the classes lamp in 'category'"):
        read_label_map(path)
    write_label_map(path, [*LABELS, (70000, "bed", "bed")])
    with pytest.raises(DataError, match=r"line 19: the id is '70000'"):
        read_label_map(path)
    write_label_map(path, [*LABELS, ("1" * 5000, "bed", "bed")])
    with pytest.raises(DataError, match=r"line 19: the id is '1{20}', not 1 to 65535"):
        read_label_map(path)


def test_objects_of_an_aggregation(tmp_path, label_map):
    path = tmp_path / "a.aggregation.json"
    write_aggregation(path, "scene0000_00", {3: "couch ", 0: "wall", 1: "chairs"})
    objects, notes = read_objects(path, label_map)
    assert objects == [Labelled(1, "chairs", "chair"), Labelled(3, "couch", "sofa")]
    assert notes == []


def test_an_object_with_two_classes_is_left_out_and_noted(tmp_path, label_map):
    """As in scene0217_00, whose list holds objects twice: the same class twice does no harm."""
    groups = [(0, "chair"), (1, "bed"), (0, "chairs"), (1, "table"), (2, "wall"), (2, "lamp")]
    document = {"segGroups": [{"objectId": n, "label": w, "segments": []} for n, w in groups]}
    path = tmp_path / "a.aggregation.json"
    path.write_text(json.dumps(document))
    objects, notes = read_objects(path, label_map)
    assert objects == [Labelled(0, "chair", "chair")]
    assert notes == ["objectId 1 has labels of two classes", "objectId 2 has labels of two classes"]


def test_an_id_that_is_not_the_object_id_is_noted(tmp_path, label_map):
    groups = [{"id": 5, "objectId": 0, "label": "chair"}, {"id": 1, "objectId": 1, "label": "bed"}]
    path = tmp_path / "a.aggregation.json"
    path.write_text(json.dumps({"segGroups": groups}))
    objects, notes = read_objects(path, label_map)
    assert [one.object_id for one in objects] == [0, 1]
    assert notes == ["1 object has another id than objectId"]


@pytest.mark.parametrize(
    "text",
    [
        "", "[1]", "{}", '{"segGroups": 3}', '{"segGroups": [{"label": "a"}]}', "[" * 100_000,
        '{"segGroups": [{"objectId": -1, "label": "a"}]}',
        '{"segGroups": [{"objectId": true, "label": "a"}]}',
        '{"segGroups": [{"objectId": 1e9, "label": "a"}]}',
        '{"segGroups": [{"objectId": 70000, "label": "a"}]}',
        '{"segGroups": [{"objectId": 1, "label": ["a"]}]}',
    ],
)  # fmt: skip
def test_what_is_no_aggregation_is_told(tmp_path, label_map, text):
    path = tmp_path / "a.aggregation.json"
    path.write_text(text)
    with pytest.raises(DataError, match=r"a\.aggregation\.json"):
        read_objects(path, label_map)


def test_scene_lists(tmp_path):
    path = tmp_path / "train.txt"
    path.write_text("scene0191_00\r\nscene0191_01\n\n")
    assert read_scene_list(path) == ["scene0191_00", "scene0191_01"]
    path.write_text("scene0191_00\n../etc\n")
    with pytest.raises(DataError, match=r"'\.\./etc' is not a scene"):
        read_scene_list(path)
    path.write_text("\n")
    with pytest.raises(DataError, match="names no scenes"):
        read_scene_list(path)
