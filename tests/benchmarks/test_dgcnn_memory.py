"""Peak memory of a training step of DGCNN against the straight network, each in its own process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

ROOT = Path(__file__).parents[2]
STEP = """
import re, sys
from pathlib import Path
import torch
from torch.nn import functional as F
from qs3.models.dgcnn import dgcnn
from tests.models.reference import NaiveDGCNN

def peak():  # kB; ru_maxrss would begin with the parent's
    return int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1])

side, b, n = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
net = dgcnn(10)
net = NaiveDGCNN(net) if side == "straight" else net
F.cross_entropy(net(torch.randn(2, 32, 3)), torch.arange(2)).backward()  # load all libraries
before = peak()
F.cross_entropy(net(torch.randn(b, n, 3) / 2), torch.arange(b) % 10).backward()
print(peak() - before)
"""


def _peak_mb(side: str, b: int, n: int) -> float:
    """What a step adds to the process's peak (MB)."""
    command = [sys.executable, "-W", "ignore", "-c", STEP, side, str(b), str(n)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return int(done.stdout) / 1024


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc/self/status")
def test_peak_memory(benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture) -> None:
    b, n = (4, 1024) if benchmark.enabled else (2, 256)
    ours = benchmark.pedantic(_peak_mb, args=("ours", b, n), rounds=1)
    straight = _peak_mb("straight", b, n)
    assert ours < straight / 4
    benchmark.extra_info.update(ours_mb=ours, straight_mb=straight)
    if benchmark.enabled:
        with capsys.disabled():
            print(  # noqa: T201
                f"\nDGCNN {b} x {n}: a training step adds {ours:.0f} MB, the straight net's "
                f"{straight:.0f}: {straight / ours:.1f} times less"
            )
