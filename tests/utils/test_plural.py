"""Numbers with their nouns: by hand."""

from qs3.utils.plural import counted


def test_only_one_is_one():
    assert [counted(n, "cloud") for n in (0, 1, 2)] == ["0 clouds", "1 cloud", "2 clouds"]
    assert counted(0.5, "card") == "0.5 cards"


def test_other_words():
    assert counted(1, "mesh is", "meshes are") == "1 mesh is"
    assert counted(11, "mesh is", "meshes are") == "11 meshes are"
