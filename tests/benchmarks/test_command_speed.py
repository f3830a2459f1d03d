"""How soon the commands answer, against importing torch, which they must not wait for."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

ROOT = Path(__file__).parents[2]


def _run(folder: Path, *words: str) -> None:
    subprocess.run(
        [sys.executable, *words], cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True, check=False,
    )  # fmt: skip


@pytest.mark.parametrize(
    "words",
    [
        (str(ROOT / "train.py"), "--help"),
        (str(ROOT / "train.py"), "experiment=qs3_s2d"),  # its data are not there
        (str(ROOT / "generate.py"), "--help"),
        ("-m", "qs3", "predict", "--help"),
        ("-m", "qs3", "--help"),
    ],
    ids=["train --help", "train without data", "generate --help", "predict --help", "qs3 --help"],
)
def test_first_answer(
    words: tuple[str, ...], benchmark: BenchmarkFixture, tmp_path: Path,
    capsys: pytest.CaptureFixture,
) -> None:  # fmt: skip
    benchmark.pedantic(lambda: _run(tmp_path, *words), rounds=3)
    if not benchmark.enabled:
        return
    times = []
    for _ in range(3):
        begin = time.perf_counter()
        _run(tmp_path, "-c", "import torch")
        times.append(time.perf_counter() - begin)
    ours = benchmark.stats.stats.min
    benchmark.extra_info["of_importing_torch"] = ours / min(times)
    with capsys.disabled():
        print(  # noqa: T201
            f"\n{' '.join(word.rpartition('/')[2] for word in words)}: {ours:.2f} s, "
            f"{ours / min(times):.2f} of importing torch"
        )
