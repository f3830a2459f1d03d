"""What cannot run where shapes are checked (`make test-all`), and therefore is not slow."""

from __future__ import annotations

import os

import pytest

unchecked = pytest.mark.skipif(
    bool(os.environ.get("QS3_CHECK_SHAPES")),
    reason="torch's compiler cannot follow the checks of shapes, which refuse other types first",
)
