"""What a run is worth: equal nets are asked once, with the target's norms, with a prior."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch

import qs3
from qs3.config.hydra import run_folder
from qs3.datamodules.clouds import load_clouds
from qs3.errors import ConfigError
from qs3.evaluation.metrics import predict
from qs3.evaluation.norms import adapt_norms
from qs3.evaluation.prior import read_prior
from qs3.inference.model_file import read_result
from qs3.runs.checkpoints import load
from qs3.runs.metrics import read_metrics
from qs3.runs.predictions import FILE, read_predictions
from qs3.store.store import open_pointset
from qs3.training import evaluate as stage
from qs3.training.command import headline, train
from tests.training.toy import CLASSES, TinyNet, write_domain

PACKAGES = ("qs3.models", "tests")

WORDS = ("method=source_only", "selftraining=none", "protocol.epochs=1")


@pytest.fixture
def passes(monkeypatch):
    """Passes of the evaluation over sets of 24 clouds, the test set's size."""
    seen = Counter()

    def plain(net, points, *more, **named):
        seen["test"] += len(points) == 24
        return predict(net, points, *more, **named)

    monkeypatch.setattr(stage, "predict", plain)
    return seen


# The student, the warm-up's selected and last epochs: 3 nets. Without rounds the student is the
# last epoch.
@pytest.mark.parametrize(
    ("more", "nets"),
    [
        (("selftraining.rounds=1",), 3),
        (("selftraining=none", "evaluation.norms=adabn"), 2),
        (("selftraining=none", "protocol.epochs=1"), 1),
    ],
)
def test_equal_weights_predict_equal_clouds_once(toy, passes, more, nets):
    cfg = toy("force=true", *more)
    metrics = train(cfg)
    assert +passes == {"test": nets}
    folder = run_folder(cfg)
    predictions = read_predictions(folder / FILE)
    right = (predictions.predicted == predictions.labels).mean()
    assert metrics.final.accuracy == pytest.approx(right)


def test_statistics_are_the_targets_and_weights_the_sources(toy, toy_data):
    plain, adapted = toy(*WORDS), toy(*WORDS, "evaluation.norms=adabn")
    plain_metrics, metrics = train(plain), train(adapted)
    assert plain_metrics.evaluation.norms == "trained"
    assert metrics.evaluation.norms == "adabn"
    before = load(run_folder(plain) / "result.pt")["weights"]
    after = load(run_folder(adapted) / "result.pt")["weights"]
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed >= {"norm.running_mean", "norm.running_var"}
    assert changed <= {"norm.running_mean", "norm.running_var", "norm.num_batches_tracked"}

    target = load_clouds(open_pointset(toy_data / "kinectsim10"), "train", 32, scale="unit_ball")
    x = torch.relu(target.points @ after["lift.weight"].T + after["lift.bias"]).amax(1)  # [n, 16]
    torch.testing.assert_close(after["norm.running_mean"], x.mean(0), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(after["norm.running_var"], x.var(0), rtol=1e-4, atol=1e-5)


def test_order_of_clouds_is_mixed_and_batches_are_even():
    seen = []

    class Net(TinyNet):
        def forward(self, points):
            seen.append(points[:, 0, 0].tolist())
            return super().forward(points)

    points = torch.arange(65.0)[:, None, None].expand(65, 4, 3)
    adapt_norms(Net(3), points, 16, seed=0)
    assert [len(batch) for batch in seen] == [17, 16, 16, 16]  # never one of a single cloud
    flat = [value for batch in seen for value in batch]
    assert sorted(flat) == list(range(65))
    assert flat != sorted(flat)
    seen.clear()
    adapt_norms(Net(3), points[:7], 2, seed=0)  # 3.5 batches, which rounds to 4
    assert [len(batch) for batch in seen] == [3, 2, 2]


def test_the_reported_probabilities_are_weighed_and_estimates_are_not(toy) -> None:
    plain = toy(*WORDS)
    told = toy(*WORDS, "evaluation.prior={rod: 9, slab: 0}", "evaluation.prior_power=1.0")
    before, after = train(plain), train(told)
    of_plain, of_told = (
        read_predictions(run_folder(cfg) / "predictions.csv") for cfg in (plain, told)
    )
    prior = read_prior({"rod": 9, "slab": 0}, CLASSES, power=1.0)  # toys are balanced
    expected = prior(of_plain.probabilities)
    np.testing.assert_allclose(of_told.probabilities, expected)
    assert not (of_told.probabilities.argmax(axis=1) == CLASSES.index("slab")).any()
    right = (of_told.probabilities.argmax(axis=1) == of_told.labels).mean()
    assert after.final.accuracy == pytest.approx(right)
    assert after.warmup.selected.scores == after.final
    assert after.evaluation.prior == prior.words
    assert before.evaluation.prior == ""
    assert "; with evaluation.prior; data: " in headline(after)
    assert "evaluation.prior" not in headline(before)
    assert after.quality == before.quality
    assert after.infomax == before.infomax


@pytest.fixture(scope="module")
def uneven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A source of 40 balls, 20 rods and 10 slabs, of which a fifth is held out."""
    data = tmp_path_factory.mktemp("uneven")
    write_domain(data, "specklenet10", noise=0.3, train=(40, 20, 10))
    write_domain(data, "kinectsim10", noise=0.6)
    return data


def factors_of(toy, uneven: Path, *words: str) -> tuple[np.ndarray, Path]:
    """By what the reported probabilities are weighed, and the run that is told."""
    runs = []
    for more in ((), ("evaluation.prior={ball: 1}", "evaluation.prior_power=1.0")):
        cfg = toy(f"paths.data_dir={uneven}", *words, *more)
        train(cfg)
        runs.append(run_folder(cfg))
    plain, told = (read_predictions(run / "predictions.csv").probabilities for run in runs)
    ratio = told / plain
    return (ratio / ratio.max(axis=1, keepdims=True))[0], runs[1]


def test_classes_count_as_the_net_met_them_and_load_does_the_same(toy, uneven: Path) -> None:
    """All alike there: by (n + 1) of the 32, 16 and 8 clouds that it learnt from."""
    factors, run = factors_of(toy, uneven, *WORDS)
    np.testing.assert_allclose(factors, [9 / 33, 9 / 17, 1], rtol=1e-5)
    net = qs3.load(run, packages=PACKAGES, prior={"ball": 1}, prior_power=1.0)
    np.testing.assert_allclose(net.prior.factors, [9 / 33, 9 / 17, 1])
    clouds = open_pointset(uneven / "kinectsim10").split("test").points
    found = read_predictions(run / "predictions.csv")
    np.testing.assert_allclose(net(list(np.array(clouds))), found.probabilities, atol=1e-6)


def test_a_student_has_met_its_pseudo_labels(toy, uneven: Path) -> None:
    """From scratch and without the source; beside it, the mean of both."""
    rounds = ("method=source_only", "protocol.epochs=2", "selftraining.rounds=1")
    factors, run = factors_of(toy, uneven, *rounds)
    selected = read_metrics(run).rounds[-1].selected
    counts = np.array([selected[name] for name in CLASSES]) + 1.0
    np.testing.assert_allclose(factors, counts.min() / counts, rtol=1e-5)
    assert read_result(run).learnt == pytest.approx(counts / counts.sum())
    cfg = toy(f"paths.data_dir={uneven}", *rounds, "selftraining.use_source=true")
    metrics = train(cfg)
    counts = np.array([metrics.rounds[-1].selected[name] for name in CLASSES]) + 1.0
    both = (counts / counts.sum() + np.array([33, 17, 9]) / 59) / 2
    assert read_result(run_folder(cfg)).learnt == pytest.approx(both)


@pytest.mark.parametrize("words", ["rooms", "{unicorn: 2}", "{rod: -1}"])
def test_what_is_no_prior_ends_a_run_before_it_trains(toy, words: str) -> None:
    cfg = toy(*WORDS, f"evaluation.prior={words}")
    with pytest.raises(ConfigError, match="prior="):
        train(cfg)
    assert not list(run_folder(cfg).glob("*.ckpt"))
