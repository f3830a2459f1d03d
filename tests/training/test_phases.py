"""What a phase begins with and leaves: fresh students, whole checkpoints, a teacher apart."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import open_dict

from qs3.config.hydra import build, run_folder
from qs3.datamodules.clouds import Clouds, load_clouds
from qs3.evaluation.metrics import predict
from qs3.runs.checkpoints import load
from qs3.runs.metrics import RunMetrics
from qs3.runs.predictions import read_pseudo_labels
from qs3.store.store import open_pointset
from qs3.training.command import train
from qs3.utils.seeding import derive
from tests.training.toy import CLASSES, toy_config

# 7 epochs: 0-2 warm-up, 3-4 round 0, 5-6 round 1
STARTS, ENDS = (0, 3, 5), (2, 4, 6)
PERSISTENT = ("selftraining.init=persistent", "selftraining.theta=0.35")


@dataclass(frozen=True)
class Kept:
    """A finished run, and what `watching.Keep` kept of it."""

    cfg: Any
    folder: Path
    kept: Path
    metrics: RunMetrics
    target: Clouds

    def before(self, epoch: int, batch: int = 0) -> dict[str, Any]:
        return load(self.kept / f"{epoch}-{batch}.pt")

    def checkpoint(self, epoch: int) -> dict[str, Any]:
        return load(self.kept / f"{epoch}.ckpt")

    def held_out(self, round_: int) -> tuple[torch.Tensor, torch.Tensor]:
        """As the checkpoint of the round's first epoch has it."""
        callbacks = self.checkpoint(3 + 2 * round_)["callbacks"]
        pair: Any = callbacks["SelfTraining"]["held_out"]
        return pair

    def net(self, epoch: int) -> dict[str, torch.Tensor]:
        """The weights in an epoch's checkpoint."""
        state = self.checkpoint(epoch)["state_dict"]
        return {k.removeprefix("net."): v for k, v in state.items() if k.startswith("net.")}


def kept_run(root: Path, toy_data: Path, *settings: str) -> Kept:
    cfg = toy_config(root, f"paths.data_dir={toy_data}", *settings)
    with open_dict(cfg):
        target = "tests.training.watching.Keep"
        cfg.callbacks.progress = {"_target_": target, "folder": str(root / "kept")}
    metrics = train(cfg)
    clouds = load_clouds(open_pointset(toy_data / "kinectsim10"), "train", 32, scale="unit_ball")
    return Kept(cfg, run_folder(cfg), root / "kept", metrics, clouds)


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory, toy_data: Path) -> Kept:
    return kept_run(tmp_path_factory.mktemp("scratch"), toy_data)


@pytest.fixture(scope="module")
def continued(tmp_path_factory: pytest.TempPathFactory, toy_data: Path) -> Kept:
    root = tmp_path_factory.mktemp("continued")
    return kept_run(root, toy_data, "selftraining=spst", "selftraining.share=0.6")


@pytest.fixture(scope="module")
def persistent(tmp_path_factory: pytest.TempPathFactory, toy_data: Path) -> Kept:
    return kept_run(tmp_path_factory.mktemp("persistent"), toy_data, *PERSISTENT)


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    assert a.keys() == b.keys()
    return all(torch.equal(a[name], b[name]) for name in a)


def test_each_student_is_new(scratch: Kept) -> None:
    first = [scratch.before(epoch)["weights"] for epoch in STARTS]
    norms = {k: v for k, v in first[0].items() if "running" in k or "num_batches" in k}
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert not torch.equal(first[a]["lift.weight"], first[b]["lift.weight"])
        assert not torch.equal(first[a]["head.weight"], first[b]["head.weight"])
    for weights in first:  # no statistics of the teacher's
        assert all(torch.equal(weights[key], value) for key, value in norms.items())
        assert weights["norm.num_batches_tracked"] == 0
    for start, end in zip(STARTS[1:], ENDS, strict=False):
        assert not same(scratch.before(start)["weights"], scratch.net(end))


@pytest.mark.parametrize("name", ["scratch", "continued"])
def test_the_optimiser_begins_anew(name: str, request: pytest.FixtureRequest) -> None:
    run: Kept = request.getfixturevalue(name)
    for start in STARTS:
        assert run.before(start)["moments"] == 0
        assert run.before(start, 1)["moments"] > 0
        assert run.before(start + 1)["moments"] > 0  # in a phase's other epochs they are kept


def test_continued_students_begin_with_their_teacher(continued: Kept) -> None:
    """Round 0 with the selected weights of the warm-up, not its last; round 1 with the student."""
    selected = load(continued.folder / "warmup_selected.pt")
    assert same(continued.before(3)["weights"], selected)
    assert same(continued.before(5)["weights"], continued.net(4))
    assert not same(selected, continued.net(2))


def test_a_persistent_student_is_new_in_round_0_and_kept_afterwards(persistent: Kept) -> None:
    """The released code's: the same weights and moments in all rounds."""
    torch.manual_seed(derive(0, "init", 1))
    assert same(persistent.before(3)["weights"], build(persistent.cfg.model).state_dict())
    assert persistent.before(3)["moments"] == 0
    assert same(persistent.before(5)["weights"], persistent.net(4))
    assert persistent.before(5)["moments"] > 0
    steps = {e: persistent.checkpoint(e)["optimizer_states"][0]["state"][0]["step"] for e in (4, 5)}
    assert steps[5] > steps[4] > 0


@pytest.fixture(scope="module")
def released(tmp_path_factory: pytest.TempPathFactory, toy_data: Path) -> Kept:
    root = tmp_path_factory.mktemp("released")
    rounds = ("selftraining=qbst_released", "selftraining.theta=0.35", "selftraining.rounds=3")
    return kept_run(root, toy_data, *rounds)


def test_the_released_rounds_hold_out_a_fifth_of_what_a_pool_gives(released: Kept) -> None:
    """Only the best student by held-out pseudo-labels teaches, and it is the result."""
    states = [released.checkpoint(epoch) for epoch in (4, 6, 8)]
    rounds = [state["callbacks"]["SelfTraining"] for state in states]
    assert rounds[0]["best"] <= rounds[1]["best"] <= rounds[2]["best"]
    teachers = [load(released.folder / "warmup_selected.pt"), *(r["weights"] for r in rounds[:2])]
    for round_, teacher in enumerate(teachers):
        table = read_pseudo_labels(released.folder / f"round_{round_:02d}" / "pseudo_labels.csv")
        assert table["label"].tolist() == [row[1] for row in table_by(released, teacher)]
        pool = np.arange(len(table)) % 10 < 8
        assert not table["selected"][~pool].any()
        chosen, (index, _) = table["selected"].sum(), released.held_out(round_)
        assert len(index) == (np.arange(chosen) % 10 >= 8).sum()
        assert table["selected"].to_numpy()[index.numpy()].all()
        trained = released.checkpoint(3 + 2 * round_)["AdaptationData"]["index"]
        assert not set(trained.tolist()) & set(index.tolist())
        assert len(trained) + len(index) == chosen
    assert same(load(released.folder / "student.pt"), rounds[2]["weights"])


@pytest.mark.parametrize("name", ["scratch", "continued"])
def test_checkpoints_hold_what_was_trained(name: str, request: pytest.FixtureRequest) -> None:
    """At the end of a phase, too: steps of its own in the optimiser, trained weights."""
    run: Kept = request.getfixturevalue(name)
    for epoch in range(7):
        start = max(s for s in STARTS if s <= epoch)
        checkpoint = run.checkpoint(epoch)
        assert checkpoint["epoch"] == epoch
        steps = {int(s["step"]) for s in checkpoint["optimizer_states"][0]["state"].values()}
        batches = sum(len(list(run.kept.glob(f"{e}-*.pt"))) for e in range(start, epoch + 1))
        assert steps == {batches}
        assert not same(run.net(epoch), run.before(start)["weights"])
        if epoch + 1 not in (*STARTS, 7):  # the next epoch goes on with just these
            assert same(run.net(epoch), run.before(epoch + 1)["weights"])
    assert same(run.net(6), load(run.folder / "student.pt"))
    assert same(run.net(2), load(run.folder / "warmup_last.pt"))


def table_by(run: Kept, weights: dict[str, torch.Tensor]) -> list[tuple[str, str, float]]:
    net = build(run.cfg.model)
    net.load_state_dict(weights)
    p = predict(net, run.target.points, 64)
    labels = (CLASSES[k] for k in p.argmax(axis=1))
    return list(zip(run.target.ids, labels, p.max(axis=1).tolist(), strict=True))


@pytest.mark.parametrize("name", ["scratch", "continued"])
def test_each_round_is_labelled_by_its_teacher(name: str, request: pytest.FixtureRequest) -> None:
    """Round 0 by the warm-up's selected epoch, although the last one stands in the trainer."""
    run: Kept = request.getfixturevalue(name)
    selected = load(run.folder / "warmup_selected.pt")
    epoch = run.metrics.warmup.selected.epoch
    assert epoch < ENDS[0]
    assert same(selected, run.net(epoch))
    for round_, teacher in ((0, selected), (1, run.net(ENDS[1]))):
        file = run.folder / f"round_{round_:02d}" / "pseudo_labels.csv"
        table = [
            (row.id, row.label, row.confidence) for row in read_pseudo_labels(file).itertuples()
        ]
        assert table == table_by(run, teacher)
        assert table != table_by(run, run.net(ENDS[0]))
