"""Two processes (DDP on the CPU, as a user starts them): one selection, one set of weights."""

from __future__ import annotations

import csv
import json
import shutil
import signal
import subprocess
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from qs3.config.hydra import run_folder
from qs3.runs.checkpoints import load
from qs3.store.store import open_pointset
from qs3.training.command import train
from tests.running import command
from tests.training.conftest import result_of
from tests.training.toy import CLASSES, overrides, toy_config, write_domain
from tests.training.watching import interrupt, seen_by

TWO = ("trainer.devices=2", "trainer.strategy=ddp")
WARMUP, EPOCHS = 6, 2
# The same clouds whoever draws them, so that a process's clouds can be told by their coordinates.
PLAIN = (
    *("data.points=64", "data.fps_starts=1", "paths.warmup_dir=null"),
    *("protocol.augment.rotate_z=false", "protocol.augment.jitter_sigma=0.0"),
)
SETTINGS = ("method=source_only", f"protocol.epochs={WARMUP}", "protocol.optimizer.lr=0.05", *PLAIN)
FEATURED = "model._target_=tests.training.nets.featured"
LOW = "method.theta=0.3"  # of its selector
STEPS = "selftraining.selector.steps=3"  # of the graph's net
LRENT = ("selftraining.selector.labels=lrent", "selftraining.theta=0")


@dataclass(frozen=True)
class Both:
    """Two runs continued from one checkpoint: in one process (`one`) and in two (`two`)."""

    one: Path
    two: Path
    watched: Path
    ids: tuple[str, ...]


def watch(folder: Path) -> str:
    return f"callbacks.progress={{_target_: tests.training.watching.Watch, folder: {folder}}}"


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Both:
    """75 target clouds: two processes cannot share them out evenly.

    One process trains until its warm-up has found weights that no later epoch can beat (100 % of
    the validation clouds; ties go to the earlier epoch). From that checkpoint one process goes on,
    and two do: their later weights differ, but those that label the target in round 0 are the same.
    """
    root = tmp_path_factory.mktemp("ddp")
    write_domain(root / "data", "specklenet10", noise=0.05)
    write_domain(root / "data", "kinectsim10", noise=0.15, train=25)
    cfg = toy_config(root, *SETTINGS)
    interrupt(cfg, "on_train_epoch_start", WARMUP)  # in the last epoch of the warm-up
    one, two = run_folder(cfg), run_folder(toy_config(root, *SETTINGS, *TWO))
    selected = load(one / "last.ckpt")["callbacks"]["WarmupSelection"]
    assert selected["accuracy"] == 1.0
    two.mkdir(parents=True)
    shutil.copy(one / "last.ckpt", two / "last.ckpt")

    train(cfg)
    done = command(root, *overrides(root, *SETTINGS, *TWO, watch(root / "watched")))
    assert done.returncode == 0, done.stderr
    assert (two / "metrics.json").is_file()  # it went on there
    return Both(
        one, two, root / "watched", open_pointset(root / "data/kinectsim10").split("train").ids
    )


def rows(folder: Path, round_: int) -> list[dict[str, str]]:
    text = (folder / f"round_{round_:02d}" / "pseudo_labels.csv").read_text()
    return list(csv.DictReader(text.splitlines()))


@pytest.mark.slow
def test_same_weights_same_selection(both: Both) -> None:
    one, two = (load(folder / "warmup_selected.pt") for folder in (both.one, both.two))
    assert all(torch.equal(one[name], two[name]) for name in one)
    last_one, last_two = (load(folder / "warmup_last.pt") for folder in (both.one, both.two))
    assert any(not torch.equal(last_one[name], last_two[name]) for name in last_one)
    file = Path("round_00") / "pseudo_labels.csv"
    assert (both.one / file).read_bytes() == (both.two / file).read_bytes()
    records = [json.loads((f / "metrics.json").read_text())["rounds"] for f in (both.one, both.two)]
    assert records[0][0] == records[1][0]
    assert 10 < records[0][0]["total_selected"] < 75


@pytest.mark.slow
@pytest.mark.parametrize("round_", [0, 1])
def test_both_train_on_the_selected_and_on_nothing_else(both: Both, round_: int) -> None:
    """75 clouds in the table, each once; the selected ones shared out."""
    table = rows(both.two, round_)
    assert [row["id"] for row in table] == list(both.ids)
    assert len(set(both.ids)) == 75
    selected = [i for i, row in enumerate(table) if row["selected"] == "1"]
    labels = [CLASSES.index(table[i]["label"]) for i in selected]
    for epoch in range(WARMUP + EPOCHS * round_, WARMUP + EPOCHS * (round_ + 1)):
        processes = seen_by(both.watched, epoch)
        for process in processes:
            assert process["selection"]["index"].tolist() == selected
            assert process["selection"]["labels"].tolist() == labels
            assert process["clouds"]["source"] == []
        shares = [process["clouds"]["target"] for process in processes]
        assert len(shares[0]) == len(shares[1])
        times = Counter(shares[0] + shares[1])
        assert sorted(times) == selected
        assert sum(times.values()) - len(selected) == len(selected) % 2  # made even, by one cloud


@pytest.mark.slow
def test_weights_are_the_same_in_both(both: Both) -> None:
    """At the end of every epoch; running statistics, too, of which the first process's count."""
    for epoch in range(WARMUP - 1, WARMUP + 2 * EPOCHS):
        one, two = (process["weights"] for process in seen_by(both.watched, epoch))
        for name in one:
            assert torch.equal(one[name], two[name]), (epoch, name)
    student, last = load(both.two / "student.pt"), seen_by(both.watched, WARMUP + 2 * EPOCHS - 1)[0]
    assert all(torch.equal(student[name], last["weights"][name]) for name in student)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "epoch"),
    [
        ((), WARMUP),  # in the epoch after the first selection; students from scratch
        ((), WARMUP + EPOCHS + 1),  # in round 1
        # heads of its own; the teacher goes on, with the source; soft labels
        (("method=gast", "selftraining=spst", FEATURED), WARMUP + 1),
        # a teacher and a pool of the warm-up, in buffers; the pool is of epoch 1
        (("method=sd", "selftraining=spst", FEATURED), 2),
        (("method=pcfea", "method.every=1.0", "selftraining=spst", FEATURED), 3),
        (("method=dann", "selftraining=cbst", *LRENT, FEATURED), 2),
        (("method=cpcm", "selftraining=spst", "evaluation.norms=tent"), 2),
        (("selftraining=sd", "selftraining.theta=0", STEPS, FEATURED), WARMUP + EPOCHS + 1),
    ],
    ids=lambda value: "" if isinstance(value, int) else " ".join(value[:2]) or "qbst",
)
def test_a_killed_run_goes_on(tmp_path: Path, settings: tuple[str, ...], epoch: int) -> None:
    """Both processes killed; continued, they end as if they had not been, to the bit.

    And at the end of every epoch both hold the same: teachers, pools and heads of the method, too.
    """
    write_domain(tmp_path / "data", "specklenet10", noise=0.05)
    write_domain(tmp_path / "data", "kinectsim10", noise=0.15, train=25)

    def run(name: str, *extra: str) -> subprocess.CompletedProcess:
        logs = f"paths.log_dir={tmp_path / name}"
        more = (f"protocol.epochs={WARMUP}", *settings, *TWO, logs, *extra)
        return command(tmp_path, *overrides(tmp_path, *more))

    def folder(name: str) -> Path:
        (found,) = (tmp_path / name / "quickstart").iterdir()
        return found

    watched = tmp_path / "watched"
    whole = run(
        "whole",
        f"callbacks.progress={{_target_: tests.training.watching.WatchWeights, folder: {watched}}}",
    )
    assert whole.returncode == 0, whole.stderr
    epochs = len(list(watched.iterdir())) // 2
    assert epochs > WARMUP
    for seen in range(epochs):
        one, two = (process["weights"] for process in seen_by(watched, seen))
        different = [name for name in one if not torch.equal(one[name], two[name])]
        assert different == [], (seen, different)
    kill = f"{{_target_: tests.training.watching.KillAt, epoch: {epoch}, batch: 0}}"
    killed = run("killed", f"callbacks.progress={kill}")
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert load(folder("killed") / "last.ckpt")["epoch"] == epoch - 1
    again = run("killed")
    assert again.returncode == 0, again.stderr
    assert result_of(folder("killed")) == result_of(folder("whole"))
    for file in ("student.pt", "result.pt"):  # of the latter the norms may be of the target
        ours, theirs = (load(folder(name) / file) for name in ("killed", "whole"))
        ours, theirs = (found.get("weights", found) for found in (ours, theirs))
        assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
