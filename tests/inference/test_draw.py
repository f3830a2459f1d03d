"""`sample=` of `qs3 predict`: as many objects as asked for, whatever holds them."""

from __future__ import annotations

import numpy as np

from tests.fixtures.frame_files import write_archive
from tests.inference.test_depth_command import (
    CAMERA,
    frame,  # noqa: F401 (fixture)
    predict,
    seen,
    table,
)


def test_a_sample_is_always_the_same(run, tmp_path):
    write_archive(tmp_path / "objects.npz", {"train": 2, "test": 1})
    for out in ("a.csv", "b.csv"):
        words = (f"input={tmp_path}/objects.npz", "sample=7", "page=false")
        assert predict(run, tmp_path / out, *words) == 0
    assert len(table(tmp_path / "a.csv")) == 7
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_a_sample_is_of_the_objects_whatever_holds_them(run, frame):  # noqa: F811
    _, mask = seen()
    parts = np.where(mask > 0, 2 * mask - (np.arange(mask.shape[1]) % 2), 0)  # four numbers
    np.save(frame / "parts.npy", parts)
    words = (f"intrinsics={CAMERA}", "up=-y", "page=false")
    one = (f"depth={frame}/depth.png", f"mask={frame}/parts.npy", *words)
    everything, some, same = frame / "all.csv", frame / "some.csv", frame / "same.csv"
    assert predict(run, everything, *one) == 0
    for out in (some, same):
        assert predict(run, out, *one, "sample=3") == 0
    rows = table(everything)
    assert len(rows) == 4
    assert len(table(some)) == 3
    assert {row["file"] for row in table(some)} < {row["file"] for row in rows}
    assert some.read_text() == same.read_text()
    # Of a list, too: 4 objects, 1, a picture that is not there, and one that is broken.
    (frame / "broken.png").write_bytes(b"not a picture")
    (frame / "objects.csv").write_text(
        "depth,mask,object,box\ndepth.png,parts.npy,,\ndepth.png,mask.png,2,\n"
        "gone.png,gone.npy,,\nbroken.png,parts.npy,,\n"
    )
    listed = (f"depth={frame}/objects.csv", *words)
    assert predict(run, everything, *listed) == 1
    names = [row["file"] for row in table(everything)]
    assert len(names) == 7
    assert predict(run, some, *listed, "sample=9") == 1
    drawn = [row["file"] for row in table(some)]
    assert set(drawn) <= {*names}
    assert "broken.png" in drawn


def test_a_sample_is_of_the_clouds_of_files(run, tmp_path):
    clouds = np.random.default_rng(0).normal(size=(6, 64, 3))
    np.save(tmp_path / "a.npy", clouds)
    np.savez(tmp_path / "b.npz", points=clouds[:2])
    np.save(tmp_path / "c.npy", clouds[0])
    (tmp_path / "d.npz").write_bytes(b"damaged")
    said = tmp_path / "out" / "said.csv"
    words = (f"input={tmp_path}", "page=false")
    assert predict(run, said, *words) == 1
    names = [row["file"] for row in table(said)]
    assert len(names) == 10
    predict(run, said, *words, "sample=5")
    drawn = [row["file"] for row in table(said)]
    assert len(drawn) == 5
    assert set(drawn) < {*names}
    assert predict(run, said, *words, "sample=10") == 1
    assert [row["file"] for row in table(said)] == names
