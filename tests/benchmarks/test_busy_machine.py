"""What one other busy process on each core costs, beside the fair share of the machine.

python -m pytest tests/benchmarks/test_busy_machine.py --benchmark-enable -s

With as many others as cores, each of which wants a whole one, half of the machine is left: a fair
share takes twice the time that the same work takes alone. What comes on top is lost by waiting, and
may be at most three times as long, as commands begin.
"""

from __future__ import annotations

import math
import os
import signal
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
AT_MOST = 3.0  # times the fair share

# Ends with whoever started it, also where that one is killed.
_OTHER = """
import os, sys
os.sched_setaffinity(0, [int(sys.argv[1])])
print(flush=True)
while os.getppid() == int(sys.argv[2]):
    for _ in range(1_000_000): pass
"""

# Seconds of the median step, and its threads: by `trainer.threads`, where "all" is null.
# "ours": as qs3's commands begin.
_STEPS = """
import statistics, sys, time
if sys.argv[1] == "ours":
    from qs3.utils.threads import let_waiting_threads_sleep
    let_waiting_threads_sleep()
import torch
from qs3.models.dgcnn import dgcnn
from qs3.utils.allocator import keep_freed_memory
from qs3.utils.threads import number_of
keep_freed_memory()
torch.set_num_threads(number_of(None if sys.argv[4] == "all" else sys.argv[4]))
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
print(statistics.median(times), torch.get_num_threads())
"""


@contextmanager
def others() -> Iterator[None]:
    """A process on each core that never rests, in a session of its own, as other users have."""
    running = [
        subprocess.Popen(
            [sys.executable, "-c", _OTHER, str(core), str(os.getpid())],
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


def test_others_end_with_whoever_started_them() -> None:
    """A benchmark that is killed leaves no busy process behind."""
    starter = (
        "import os, subprocess, sys; code, core = sys.argv[1:]; "
        "words = [sys.executable, '-c', code, core, str(os.getpid())]; "
        "one = subprocess.Popen(words, stdout=subprocess.PIPE, start_new_session=True); "
        "one.stdout.read(1); print(one.pid, flush=True); input()"
    )
    words = [sys.executable, "-c", starter, _OTHER, str(cores()[0])]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as first:
        assert first.stdout is not None
        other = int(first.stdout.readline())
        state = Path(f"/proc/{other}/stat")
        runs = state.exists()
        first.kill()
    end = time.monotonic() + 60
    while _runs(state) and time.monotonic() < end:
        time.sleep(0.1)
    ended = not _runs(state)
    if not ended:
        os.kill(other, signal.SIGKILL)
    assert runs
    assert ended


def _runs(state: Path) -> bool:
    """By /proc; what nobody has waited for yet has ended."""
    try:
        return state.read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


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
    at_most: float = AT_MOST,
) -> None:
    """Print what others cost, and hold it; `call` is given a word for the place of its files."""
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
    assert times <= at_most


@pytest.mark.parametrize("points", [256, 1024])
@pytest.mark.parametrize(("how", "threads"), [("torch", "all"), ("ours", "all"), ("ours", "auto")])
def test_training_step(
    how: str,
    threads: str,
    points: int,
    benchmark: BenchmarkFixture,
    capsys: pytest.CaptureFixture,
) -> None:
    """As torch has its threads wait, and as qs3's commands do."""
    seconds, points = ("6", points) if benchmark.enabled else ("0", 64)
    taken: dict[str, int] = {}

    def step(word: str) -> float:
        median, number = _run("-c", _STEPS, how, str(points), seconds, threads).split()
        taken[word] = int(number)
        return float(median)

    what = f"DGCNN, 16 x {points}, trainer.threads={threads}, threads that wait as {how}"
    # The one thread of `auto` leaves to others what would be its share of more cores: only shown.
    held = how == "ours" and (threads == "all" or len(cores()) <= 2)
    _compared(what, step, benchmark, capsys, AT_MOST if held else math.inf)
    assert taken["beside"] == (1 if threads == "auto" else len(cores()))


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
