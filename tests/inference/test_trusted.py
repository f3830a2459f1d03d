"""What predict says of how many are right, and what it does where it cannot tell."""

from __future__ import annotations

import json
import re
import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from qs3.errors import DataError
from qs3.evaluation.estimates_text import DO_NOT_TRUST
from qs3.evaluation.trust import Seen, judge
from qs3.evaluation.trust_file import read_calibration
from qs3.inference import units
from qs3.inference.export import export_folder
from qs3.inference.held_out import MOST, checked_tensors, known_of, tensors_of
from qs3.inference.model_file import read_result, write_result
from qs3.inference.model_folder import HELD_OUT
from qs3.inference.predictor import load
from qs3.kernels.norms import DomainNorm
from qs3.runs.metrics import read_metrics
from qs3.store.store import open_pointset
from tests.inference.conftest import trained
from tests.running import main


def nested(one: torch.Tensor) -> torch.Tensor:
    """A tensor that has no shape."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # they are a prototype
        return torch.nested.nested_tensor([one])


def predict(net: Path, clouds: np.ndarray, folder: Path, capsys) -> tuple[str, dict, str]:
    """The text, the JSON and the page."""
    np.save(folder / "clouds.npy", clouds)
    out = folder / "said.json"
    assert main(["predict", f"ckpt={net}", f"input={folder / 'clouds.npy'}", f"out={out}"]) == 0
    page = out.with_suffix(".html").read_text()
    return capsys.readouterr().out, json.loads(out.read_text()), page


def test_a_run_s_own_source_gets_an_estimate_and_noise_a_refusal(run, data_dir, tmp_path, capsys):
    source = np.array(open_pointset(data_dir / "specklenet10").points)[::2]
    text, said, page = predict(run, source, tmp_path, capsys)
    known = load(run).held_out
    assert said["trust"]["expected"] <= said["trust"]["held_out"] == pytest.approx(known.accuracy)
    assert f"about {said['trust']['expected']:.0%} expected to be right" in text
    flat = np.random.default_rng(0).normal(size=(40, 64, 3)) * [1, 1, 1e-4]
    text, noise, page = predict(run, flat, tmp_path, capsys)
    assert noise["trust"]["trusted"] is False
    assert noise["trust"]["expected"] < said["trust"]["expected"]
    (line,) = (line for line in text.splitlines() if line.startswith(DO_NOT_TRUST))
    assert "shaped unlike the labelled ones" in line
    assert line.split(": ")[1] in page


def test_beside_a_count_of_right_ones_it_is_said_to_be_without_labels(run, tmp_path, capsys):
    clouds = np.random.default_rng(0).normal(size=(40, 64, 3))
    text, _, page = predict(run, clouds, tmp_path, capsys)
    assert "look at labels" not in text + page
    np.savez(tmp_path / "labelled.npz", points=clouds, label=np.arange(40) % 3)
    words = [f"input={tmp_path / 'labelled.npz'}", f"out={tmp_path / 'said.csv'}"]
    assert main(["predict", f"ckpt={run}", *words]) == 0
    (line,) = re.findall("^Without a look at labels: .*$", capsys.readouterr().out, re.MULTILINE)
    assert "expected to be right" in line
    assert (tmp_path / "said.html").read_text().count("Without a look at labels: ") == 1


def test_few_clouds_and_older_files_say_that_it_cannot_be_told(run, tmp_path, capsys):
    clouds = np.random.default_rng(0).normal(size=(29, 64, 3))
    text, said, _ = predict(run, clouds, tmp_path, capsys)
    assert said["trust"] is None
    assert "cannot be told of fewer than 30 clouds" in text
    older = tmp_path / "result.pt"
    write_result(older, replace(read_result(run), held_out=None))
    text, said, _ = predict(older, np.concatenate([clouds, clouds]), tmp_path, capsys)
    assert said["trust"] is None
    assert "how many are right cannot be told: the classifier's file does not say" in text


def test_a_run_keeps_what_its_net_says_of_the_labelled_clouds(run):
    known, quality = load(run).held_out, read_metrics(run).quality
    assert len(known.labels) == quality.validation_clouds
    right = (known.probabilities.argmax(axis=1) == known.labels).mean()
    assert right == pytest.approx(quality.validation_accuracy)


def test_an_exported_folder_keeps_it_and_another_one_s_is_refused(run, tmp_path):
    export_folder(run, tmp_path / "model")
    ours, theirs = load(run).held_out, load(tmp_path / "model").held_out
    np.testing.assert_array_equal(ours.probabilities, theirs.probabilities)
    np.testing.assert_array_equal(ours.measures, theirs.measures)
    damaged = shutil.copytree(tmp_path / "model", tmp_path / "damaged")
    data = bytearray((damaged / HELD_OUT).read_bytes())
    data[-1] ^= 1
    (damaged / HELD_OUT).write_bytes(data)
    with pytest.raises(DataError, match=r"held_out\.safetensors is damaged"):
        load(damaged)
    (damaged / HELD_OUT).unlink()  # a hub may carry the weights alone
    assert load(damaged).held_out is None


def test_of_norms_that_follow_the_target_it_tells_by_those_of_training(
    run, adapted_run, data_dir, tmp_path, capsys
):
    """They make a net surer than it is right."""
    before, after = load(run), load(adapted_run)
    target = np.array(open_pointset(data_dir / "kinectsim10").points)
    target = np.concatenate([target] * 3)[:90]
    points = torch.stack([before.prepare(cloud).points for cloud in target])
    np.testing.assert_array_equal(after.asked(points), before.without_prior(points))
    assert np.abs(after.without_prior(points) - before.without_prior(points)).max() > 0.01
    np.testing.assert_array_equal(after.held_out.probabilities, before.held_out.probabilities)
    assert before.before_target is None

    _, plain, _ = predict(run, target, tmp_path, capsys)
    export_folder(adapted_run, tmp_path / "model")
    for file in (adapted_run, tmp_path / "model"):
        text, said, page = predict(file, target, tmp_path, capsys)
        assert said["trust"] == plain["trust"]
        assert said["clouds"] != plain["clouds"]
        line = next(line for line in text.splitlines() if "expected to be right" in line)
        assert line.endswith(" (of the net with the norms it was trained with)")
        assert "norms it was trained with" in page
    (tmp_path / "model" / "trained_norms.safetensors").unlink()  # then nobody can be asked
    _, said, _ = predict(tmp_path / "model", target, tmp_path, capsys)
    assert said["trust"] is None

    older = replace(read_result(adapted_run), trained_norms=None)
    write_result(tmp_path / "older.pt", older)
    text, said, _ = predict(tmp_path / "older.pt", target, tmp_path, capsys)
    assert said["trust"] != plain["trust"]
    assert "norms it was trained with" not in text


def test_norms_of_each_domain_are_the_target_s_in_all_threads(
    data_dir, tmp_path, capsys, monkeypatch
):
    """With norms of the target that have seen it, and had other means in training."""
    of_source = trained(data_dir, tmp_path / "logs", "model.norm=domain")
    result, run = read_result(of_source), tmp_path / "result.pt"
    weights, norms = dict(result.weights), {}
    for name, one in result.weights.items():
        if name.endswith("target.num_batches_tracked"):
            weights[name] = torch.ones_like(one)
        if name.endswith("target.running_mean"):
            norms[name] = one + 0.1
    write_result(run, replace(result, weights=weights, trained_norms=norms))
    target = np.concatenate([np.array(open_pointset(data_dir / "kinectsim10").points)] * 6)
    net = load(run)
    ready = [net.prepare(cloud) for cloud in target]
    asked = net.asked(torch.stack([each.points for each in ready]))
    seen = Seen(asked, np.array([each.measures for each in ready]))
    expected = judge(net.held_out, seen, read_calibration())
    used = []

    def judged(predictor, *more):
        nets = (predictor.net, predictor.before_target)
        norms = [m for one in nets for m in one.modules() if isinstance(m, DomainNorm)]
        used.append({norm.domain for norm in norms})  # before any thread changes them
        return of_batch(predictor, *more)

    of_batch = units._judged
    monkeypatch.setattr(units, "_judged", judged)
    _, said, _ = predict(run, target, tmp_path, capsys)
    assert len(used) > 1
    assert used == [{"target"}] * len(used)
    assert said["trust_without_norms"] is True
    assert said["trust"]["shifts"] == pytest.approx(expected.shifts, abs=1e-4)
    assert said["trust"]["expected"] == pytest.approx(expected.expected, abs=1e-4)


def test_norms_that_diverged_cost_the_verdict_and_nothing_else(adapted_run, tmp_path, capsys):
    result = read_result(adapted_run)
    norms = {name: torch.full_like(one, -1) for name, one in result.trained_norms.items()}
    write_result(tmp_path / "result.pt", replace(result, trained_norms=norms))
    clouds = np.random.default_rng(0).normal(size=(40, 64, 3))
    text, said, _ = predict(tmp_path / "result.pt", clouds, tmp_path, capsys)
    assert said["trust"] is None
    assert "before its norms were the target's it diverged" in text
    assert [one["status"] for one in said["clouds"]] == ["ok"] * 40


def test_another_net_s_norms_do_not_stay_in_a_folder(run, adapted_run, tmp_path):
    norms = tmp_path / "model" / "trained_norms.safetensors"
    export_folder(adapted_run, tmp_path / "model")
    assert norms.exists()
    assert load(tmp_path / "model").before_target is not None
    export_folder(run, tmp_path / "model")
    assert not norms.exists()


@pytest.mark.parametrize(
    "changes",
    [
        {"more": torch.ones(1)},
        {"name": torch.ones(2)},
        {"name": torch.ones(3, dtype=torch.float64)},
        {"name": torch.ones(3).to_sparse()},
        {"name": nested(torch.ones(3))},
        {},
    ],
)
def test_norms_of_training_are_some_of_the_weights(run, tmp_path, changes):
    result = read_result(run)
    name = next(name for name in result.weights if name.endswith("running_mean"))
    weights = {**result.weights, name: torch.zeros(3)}
    norms = {name if key == "name" else key: one for key, one in changes.items()}
    write_result(tmp_path / "result.pt", replace(result, weights=weights, trained_norms=norms))
    with pytest.raises(DataError, match="trained_norms: "):
        read_result(tmp_path / "result.pt")


def tensors(**changes) -> dict[str, torch.Tensor]:
    whole = {
        "probabilities": torch.full((6, 3), 1 / 3),
        "labels": torch.arange(6) % 3,
        "measures": torch.ones(9, 4),
    }
    return whole | changes


def test_statistics_survive_their_file(tmp_path):
    found = known_of(checked_tensors(tensors(turns=torch.tensor([0.5]))))
    again = tensors_of(found)
    assert all(torch.equal(again[name], tensor) for name, tensor in tensors().items())
    assert found.turns == 0.5
    assert known_of(tensors()).turns is None
    large = replace(found, measures=np.ones((3 * MOST, 4)))
    assert len(tensors_of(large)["measures"]) == MOST


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"more": torch.ones(1)}, "should be labels"),
        ({"labels": torch.ones(6)}, "int64"),
        ({"labels": torch.arange(5) % 3}, "should be .v, C"),
        ({"labels": torch.tensor(1)}, "should be .v, C"),
        ({"probabilities": torch.tensor(0.5)}, "should be .v, C"),
        ({"probabilities": torch.full((6, 3), 0.3).to_sparse()}, "plain tensors"),
        ({"labels": (torch.arange(6) % 3).to_sparse()}, "plain tensors"),
        ({"measures": torch.ones(9, 4).to_sparse()}, "plain tensors"),
        ({"measures": nested(torch.ones(9, 4))}, "plain tensors"),
        ({"measures": torch.ones(9, 3)}, "should be .v, C"),
        ({"measures": torch.full((9, 4), torch.inf)}, "finite"),
        ({"measures": torch.ones(0, 4)}, "1 to 4096"),
        ({"probabilities": torch.full((6, 3), torch.nan)}, "shares"),
        ({"probabilities": torch.full((6, 3), 2.0)}, "shares"),
        ({"labels": torch.arange(6)}, "numbers of classes"),
        ({"labels": torch.arange(6) - 3}, "numbers of classes"),
        ({"turns": torch.ones(2)}, "should be .v, C"),
    ],
)
def test_damaged_statistics_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        checked_tensors(tensors(**changes))


def test_a_file_with_statistics_of_other_classes_is_refused(run, tmp_path):
    result = read_result(run)
    write_result(tmp_path / "odd.pt", replace(result, held_out=tensors_of(known_of(
        tensors(probabilities=torch.full((6, 4), 0.25))))))  # fmt: skip
    with pytest.raises(DataError, match=r"odd\.pt.*held_out: should have a probability for each"):
        read_result(tmp_path / "odd.pt")
