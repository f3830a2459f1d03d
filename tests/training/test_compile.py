"""`compile=true`: the same training through torch's compiler."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from qs3.config import hashing
from qs3.runs.checkpoints import load
from qs3.training.command import train


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch's compiler needs g++")
def test_compiled_training_comes_to_the_same(toy):
    # dropout is drawn otherwise, so weights are alike and not equal
    changes = ("selftraining=none", "method=source_only", "protocol.epochs=2")
    plain, compiled = toy(*changes), toy(*changes, "compile=true")
    assert hashing.run_folder(plain) != hashing.run_folder(compiled)
    assert train(plain).final.n == train(compiled).final.n
    a, b = (load(hashing.run_folder(cfg) / "student.pt") for cfg in (plain, compiled))
    assert a.keys() == b.keys()  # names of weights stay
    for name in a:
        np.testing.assert_allclose(a[name], b[name], atol=0.3, err_msg=name)
