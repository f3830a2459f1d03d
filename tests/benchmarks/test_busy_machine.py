"""What one other busy process on each core costs, beside the fair share of the machine.

python -m pytest tests/benchmarks/test_busy_machine.py --benchmark-enable -s

With as many others as cores, each of which wants a whole one, half of the machine is left: a fair
share takes twice the time that the same work takes alone. What comes on top is lost by waiting.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from qs3.utils.threads import WAITING, cores
from tests.training.toy import overrides, write_toy

ROOT = Path(__file__).parents[2]
FAIR = 2.0  # times as long: half of each core

_OTHER = """
import os, sys
os.sched_setaffinity(0, [int(sys.argv[1])])
print(flush=True)
while True: pass
"""

# Seconds of the median step; threads: all cores. "ours": as qs3's commands begin.
_STEPS = """
import statistics, sys, time
if sys.argv[1] == "ours":
    from qs3.utils.threads import let_waiting_threads_sleep
    let_waiting_threads_sleep()
import torch
from qs3.models.dgcnn import dgcnn
from qs3.utils.allocator import keep_freed_memory
from qs3.utils.threads import cores
keep_freed_memory()
torch.set_num_threads(len(cores()))
torch.manual_seed(0)
net = dgcnn(10).train()
points, labels = torch.randn(16, int(sys.argv[2]), 3), torch.arange(16) % 10
optimizer = torch.optim.Adam(net.parameters())
def step():
    optimizer.zero_grad()
    torch.nn.functional.cross_entropy(net(points), labels).backward()
    optimizer.step()
for _ in range(2): step()
times = []
while len(times) < 3 or sum(times) < float(sys.argv[3]):
    begin = time.perf_counter()
    step()
    times.append(time.perf_counter() - begin)
print(statistics.median(times))
"""


@contextmanager
def others() -> Iterator[None]:
    """A process on each core that never rests, in a session of its own, as other users have."""
    running = [
        subprocess.Popen(
            [sys.executable, "-c", _OTHER, str(core)],
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        for core in cores()
    ]
    try:
        for one in running:
            assert one.stdout is not None
            one.stdout.read(1)
        yield
    finally:
        for one in running:
            one.kill()
            one.wait()
            assert one.stdout is not None
            one.stdout.close()


def _run(*command: str) -> str:
    environment = {k: v for k, v in os.environ.items() if k not in (*WAITING, "OMP_NUM_THREADS")}
    words = [sys.executable, *command]
    done = subprocess.run(
        words, cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout


def _compared(
    what: str,
    call: Callable[[str], float],
    benchmark: BenchmarkFixture,
    capsys: pytest.CaptureFixture,
) -> None:
    """Print what others cost; `call` is given a word for the place of its files."""
    alone = call("alone")

    def beside_others() -> float:
        with others():
            return call("beside")

    beside = benchmark.pedantic(beside_others, rounds=1)
    if not benchmark.enabled:
        return
    times = beside / alone / FAIR
    benchmark.extra_info["times_the_fair_share"] = times
    with capsys.disabled():
        print(  # noqa: T201
            f"\n{what}: alone {alone:.3g} s, beside a busy process on each core {beside:.3g} s, "
            f"{times:.2f} times the fair share"
        )


@pytest.mark.parametrize("points", [256, 1024])
@pytest.mark.parametrize("how", ["torch", "ours"])
def test_training_step(
    how: str, points: int, benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture
) -> None:
    """All cores; as torch has its threads wait, and as qs3's commands do."""
    seconds, points = ("6", points) if benchmark.enabled else ("0", 64)
    what = f"DGCNN, 16 x {points}, threads that wait as {how}"
    _compared(
        what, lambda _: float(_run("-c", _STEPS, how, str(points), seconds)), benchmark, capsys
    )


def _timed(*command: str) -> float:
    begin = time.perf_counter()
    _run(*command)
    return time.perf_counter() - begin


def test_generation(
    tmp_path: Path, benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture
) -> None:
    """The whole command, with its imports; a worker on each core."""
    limit = 20 if benchmark.enabled else 1
    words = (
        *("generate.py", "domain=specklenet10", "renderer=mitsuba", "renderer.samples=4"),
        *("classes=[chair,table]", "splits=[train]", f"limit={limit}", f"workers={len(cores())}"),
    )
    what = f"generate.py, {2 * limit} objects"
    where = "paths.data_dir={}".format
    _compared(what, lambda word: _timed(*words, where(tmp_path / word)), benchmark, capsys)


def test_prediction(
    tmp_path: Path, benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture
) -> None:
    """The whole command, of clouds in files, with a DGCNN that has hardly learnt anything."""
    write_toy(tmp_path / "data")
    words = overrides(tmp_path, "selftraining=none", "protocol.epochs=1")
    _run("train.py", *(w for w in words if "model." not in w), "model=dgcnn")
    (run,) = (tmp_path / "logs").glob("quickstart/seed0-*")
    clouds = tmp_path / "clouds"
    clouds.mkdir()
    rng = np.random.default_rng(0)
    count = 1000 if benchmark.enabled else 2
    for i in range(count):
        np.save(clouds / f"{i:04d}.npy", rng.normal(size=(2048, 3)).astype(np.float32))
    words = ["-m", "qs3", "predict", f"ckpt={run}", f"input={clouds}"]
    out = "out={}.csv".format
    what = f"qs3 predict, {count} clouds"
    _compared(what, lambda word: _timed(*words, out(tmp_path / word)), benchmark, capsys)
