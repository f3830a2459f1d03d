"""The makers of the calibration: what a run's net knows, agreement, and weights left out."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from scipy.stats import spearmanr

from qs3.errors import DataError, MissingDataError
from qs3.evaluation.trust import expected
from qs3.evaluation.trust_file import PATH, write_calibration
from qs3.inference.predictor import load
from qs3.runs.metrics import METRICS
from tests.composing import compose
from tests.inference.conftest import overrides_of

ROOT = Path(__file__).parents[2]
TABLES = ROOT / "docs" / "results" / "trust"

pytestmark = pytest.mark.skipif(not (ROOT / ".ci").is_dir(), reason="an sdist has none of it")
if (ROOT / ".ci").is_dir():
    sys.path.append(str(ROOT / ".ci"))
    import trust_cases
    import trust_domain
    import trust_fit
    import trust_known
    import trust_targets


@pytest.fixture
def whole(run: Path, data_dir: Path, tmp_path: Path) -> Path:
    """A run with the config that Hydra leaves beside it."""
    copy = Path(shutil.copytree(run, tmp_path / "whole" / run.name))
    config = OmegaConf.to_yaml(compose("train", overrides_of(data_dir, run.parents[1])))
    (copy / ".hydra").mkdir(exist_ok=True)
    (copy / ".hydra" / "config.yaml").write_text(config)
    return copy


def changed(run: Path, folder: Path, change) -> Path:
    """A copy of a run whose metrics say something else."""
    copy = Path(shutil.copytree(run, folder / "run"))
    metrics = json.loads((copy / METRICS).read_text())
    change(metrics)
    (copy / METRICS).write_text(json.dumps(metrics))
    return copy


def test_a_run_s_net_knows_what_its_own_file_says(whole):
    net, held_out = trust_known.run_net(whole), load(whole).held_out
    np.testing.assert_allclose(net.known.probabilities, held_out.probabilities, atol=1e-6)
    np.testing.assert_array_equal(net.known.labels, held_out.labels)
    np.testing.assert_allclose(net.known.measures, held_out.measures, atol=1e-6)
    assert len(net.held_out) == len(held_out.labels)
    assert net.held_out[0].shape == (64, 3)
    assert (net.name, net.source, net.seed) == trust_known.run_name(whole) == ("dgcnn", "S", 0)
    assert (net.points, net.scale) == (32, "unit_ball")
    assert net.features.shape == (len(held_out.labels), 256)


def test_a_case_has_all_columns_and_its_domain_is_told_by_features(whole):
    net = trust_known.run_net(whole, turns=False)
    flat = torch.from_numpy(np.stack(net.held_out)[:, :32]) * torch.tensor([1.0, 1.0, 0.01])
    target = trust_targets.Target("T", "T", [*flat.numpy()], np.zeros(len(flat), dtype=int))
    row, _ = trust_cases.case(net, target, trust_targets.View(flat, net.known.measures))
    assert [*row] == [name for name in trust_cases.COLUMNS if name != "turns"]
    other = trust_domain.last_inputs(net.module, flat)
    assert row["domain"] == trust_domain.told_apart(net.features, other)


def test_names_tell_adapted_nets_and_nets_of_real_sizes_apart(whole, tmp_path):
    def change(about):
        about["selftraining"], about["loading"]["scale"] = "qbst", "above_floor"

    assert trust_known.run_name(changed(whole, tmp_path, change)) == ("dgcnn_qbst", "S_m", 0)


def test_runs_with_labels_of_the_target_or_another_source_are_refused(whole, tmp_path):
    supervised = changed(whole, tmp_path / "a", lambda about: about.update(method="supervised"))
    with pytest.raises(DataError, match="labels of the target"):
        trust_known.run_net(supervised)
    other = changed(whole, tmp_path / "b", lambda about: about["data"].update(source="0" * 64))
    with pytest.raises(MissingDataError, match="another version"):
        trust_known.run_net(other)


def test_finished_runs_are_found_by_folder_and_by_experiment(run, tmp_path):
    half = tmp_path / "experiment" / "seed1-00000000"
    half.mkdir(parents=True)
    shutil.copytree(run, tmp_path / "experiment" / "seed0-00000000")
    found = trust_cases.runs_in(f"{tmp_path / 'experiment'},{run}")
    assert found == [tmp_path / "experiment" / "seed0-00000000", run]
    assert trust_cases.runs_in("") == []


def test_agreement_by_hand(tmp_path):
    def answers(seed: int, *named: str) -> None:
        keys = ("held_out", "T", "second/held_out", "second/T")
        arrays = dict(zip(keys, [np.array([*map(int, one)]) for one in named], strict=True))
        np.savez(tmp_path / f"n-S-{seed}.npz", **arrays)

    answers(0, "0123", "0123", "0129", "0999")
    answers(2, "0123", "0199", "9999", "0123")
    cases = tmp_path / "cases.csv"
    cases.write_text("net,source,seed,target\nn,S,0,T\nn,S,2,T\nother,S,0,T\n")
    given = {"answers": str(tmp_path), "cases": str(tmp_path)}
    trust_cases.make_agreement(given)
    first, second = trust_cases.read(tmp_path / "agreement.csv")
    assert (first["second"], first["seeds"]) == ("0.5000", "0.5000")  # 3/4 - 1/4, 1 - 1/2
    assert (second["second"], second["seeds"]) == ("0.0000", "0.5000")  # more than held out: 0
    arrays = dict(np.load(tmp_path / "n-S-0.npz"))
    np.savez(tmp_path / "n-S-0.npz", **arrays, U=arrays["T"], **{"second/U": arrays["second/T"]})
    cases.write_text("net,source,seed,target\nn,S,0,U\nn,S,2,T\n")
    trust_cases.make_agreement(given)
    alone, _ = trust_cases.read(tmp_path / "agreement.csv")  # seed 2 was not asked about U
    assert (alone["second"], alone["seeds"]) == ("0.5000", "")


def test_what_comes_with_qs3_is_what_the_kept_cases_give(tmp_path):
    rows, adapted = trust_fit.cases_in(TABLES)
    names = trust_fit.RULES[trust_fit.SHIPPED]
    shipped = trust_fit.left_out(names, rows)
    found = trust_fit.calibration(shipped, trust_fit.weights_of(names, rows))
    write_calibration(tmp_path / "weights.json", found)
    assert (tmp_path / "weights.json").read_bytes() == PATH.read_bytes()
    every = trust_fit.left_out(names, rows, rows + adapted)
    assert trust_fit.estimates_of(every) == (TABLES / "estimates.csv").read_text()
    for row, estimate in list(zip(rows, shipped.found, strict=True))[::10]:  # fitted once a case
        weights = trust_fit.weights_of(
            names, [one for one in rows if one["left_out"] != row["left_out"]]
        )
        found = {name: float(row[name]) for name in names}
        assert estimate == pytest.approx(expected(float(row["held_out"]), found, weights))


def test_the_domain_classifier_was_worth_what_the_page_says():
    """No weight beside the other shifts; of the kept cases those have it that came out equal."""
    found = trust_cases.read(TABLES / "domain.csv")
    assert len(found) == 20
    assert trust_fit.weights_of(trust_fit.RULES["domain"], found)["domain"] == 0
    real = [row for row in found if row["net"] == "narrow" and row["left_out"] == "real"]
    rank = spearmanr(*(trust_fit.column(real, key) for key in ("domain", "accuracy"))).statistic
    assert rank == pytest.approx(0.24, abs=0.005)
    kept = [row for row in trust_cases.read(TABLES / "cases.csv") if row["domain"]]
    assert len(kept) == 4
    assert all(row in found for row in kept)


def test_a_case_is_judged_without_those_of_its_target():
    """One target alone breaks the rule: its cases cannot have taught what it is worth."""
    rng = np.random.default_rng(0)
    rows = [
        {"left_out": name, "held_out": "0.9", "accuracy": right, "shapes": str(rng.random())}
        for name, right in [("odd", "0.1")] * 20 + [(f"t{i % 4}", "0.9") for i in range(40)]
    ]
    assert trust_fit.left_out(["shapes"], rows).found[:20] == pytest.approx(0.9)


def test_a_case_is_judged_without_its_kind_of_net():
    rows, _ = trust_fit.cases_in(TABLES)
    names, keys = trust_fit.ALONE, (trust_fit.target_of, trust_fit.kind_of)
    some = [row for i, row in enumerate(rows) if i % 3 == 0]
    asked = next(row for row in some if trust_fit.kind_of(row) == "DGCNN")
    (before,) = trust_fit.left_out(names, some, [asked], keys).found

    def other(row: dict[str, str]) -> bool:
        return trust_fit.kind_of(row) == "DGCNN" or row["left_out"] == asked["left_out"]

    lies = [{**row, "accuracy": "0.05"} if other(row) else row for row in some]
    assert trust_fit.left_out(names, lies, [asked], keys).found == before
    lies = [row if other(row) else {**row, "accuracy": "0.05"} for row in some]
    assert trust_fit.left_out(names, lies, [asked], keys).found < before
    few = [row for row in some if trust_fit.kind_of(row) == "DGCNN"]
    assert trust_fit.left_out(names, few, [asked], keys).rows == []
