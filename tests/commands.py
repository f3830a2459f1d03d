"""`qs3 WORDS` in this process."""

from __future__ import annotations

from collections.abc import Sequence

from qs3.__main__ import QS3
from qs3.utils.cli import run


def main(argv: Sequence[str]) -> int:
    return run(QS3, argv)
