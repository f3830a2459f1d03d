"""Names, tiers and sensors of cut objects, as inspection shows them."""

from qs3.report.inspection import columns
from qs3.store.manifest import ManifestRow


def row(i, cls, status="ok", **more):
    reason = "" if status == "ok" else "too small"
    return ManifestRow(f"{cls}/test/{i}", cls, "test", status=status, reason=reason, more=more)


def test_counts_by_class_with_names_that_do_not_occur():
    rows = [
        row(0, "cabinet", sub="dresser", tier="clean"),
        row(1, "cabinet", sub="dresser", tier="hard"),
        row(2, "chair", sub="chair", tier="hard"),
        row(3, "chair", status="skipped", sub="chair"),
    ]
    meta = {"imported": {"names": {"dresser": "cabinet", "night stand": "cabinet"}}}
    facts = columns.columns(rows, meta)
    assert facts["names"] == {"cabinet": {"dresser": 2, "night stand": 0}, "chair": {"chair": 1}}
    assert facts["counts"] == {"tier": {"cabinet": {"clean": 1, "hard": 1}, "chair": {"hard": 1}}}
    assert facts["refused"] == {"chair": 1}
    said = "\n".join(columns.text(facts))
    assert "cabinet: dresser 2, night stand 0" in said
    assert "all          1     2" in said
    assert "left out, for reasons that manifest.csv gives: chair 1" in said


def test_classes_have_one_order_in_all_tables():
    """As in the other tables, also where a class is in one split alone."""
    rows = [row(0, "sofa", tier="clean"), row(1, "bed", tier="hard"), row(2, "lamp", "skipped")]
    facts = columns.columns([*rows, row(3, "bathtub", "skipped")], {})
    assert list(facts["counts"]["tier"]) == ["bed", "sofa"]
    assert list(facts["refused"]) == ["bathtub", "lamp"]


def test_other_datasets_have_nothing_to_say():
    assert columns.columns([ManifestRow("a", "chair", "test")], {}) == {}
    assert columns.text({}) == []
