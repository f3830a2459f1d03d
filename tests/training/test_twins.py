"""A run with twins: it is begun with them, and neither continued nor shared with others."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from qs3.config import hashing
from qs3.errors import DataError
from qs3.runs.folder import read_started
from qs3.store.store import open_pointset, read_manifest, write_pointset
from qs3.training.command import train
from qs3.training.shared_warmup import warmup_sha256
from tests.training.toy import MADE_OF, TWIN, toy_config, write_toy
from tests.training.watching import interrupt

WORDS = (
    *(*TWIN, "data.source.views=random", "selftraining=none", "protocol.epochs=2"),
    "model._target_=tests.training.nets.featured",
)


def test_other_twins_are_another_run(tmp_path):
    """The clouds are the same, so is the dataset's hash; what the teacher saw is not."""
    write_toy(tmp_path / "data")
    cfg = toy_config(tmp_path, *WORDS)
    interrupt(cfg, epoch=1)
    started = read_started(hashing.run_folder(cfg))
    with_other_twins(tmp_path / "data/specklenet10")
    with pytest.raises(DataError, match="another version of what lies beside specklenet10"):
        train(cfg)
    hashes = {warmup_sha256(cfg, {**started, "beside": x}) for x in ("a", "b")}
    assert len({*hashes, warmup_sha256(cfg, {k: started[k] for k in ("data", "versions")})}) == 3


def with_other_twins(folder):
    """Write a dataset anew: the same clouds, so its hash is the same, and other twins."""
    before = open_pointset(folder)
    arrays = {
        name: np.array(open_pointset(folder, name).points) for name in ("points", "points_exact")
    }
    arrays["points_exact"] += 1
    rows = read_manifest(folder, before.classes)
    made = write_pointset(
        folder, name=before.name, classes=before.classes, arrays=arrays, rows=rows,
        meta=MADE_OF["specklenet10"].meta,
    )  # fmt: skip
    assert made.sha256 == before.sha256


def test_a_finished_run_is_not_that_of_other_twins(tmp_path):
    write_toy(tmp_path / "data")
    cfg = toy_config(tmp_path, *WORDS)
    before = train(cfg)
    assert train(cfg).final == before.final  # they are there, and the same
    with_other_twins(tmp_path / "data/specklenet10")
    with pytest.raises(DataError, match="another version of what lies beside specklenet10"):
        train(cfg)
    shutil.rmtree(tmp_path / "data/specklenet10")
    assert train(cfg).final == before.final  # put away: the result stands


def test_a_run_without_twins_notes_none(toy, tmp_path):
    cfg = toy("method=source_only", "selftraining=none", "protocol.epochs=2")
    interrupt(cfg, epoch=1)
    assert "beside" not in read_started(hashing.run_folder(cfg))
