"""Readers of what runs, exports and sweeps leave on the disk."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzzing.engine import Reader
from tests.fuzzing.inputs import TWO, bytes_of, folder_of, half_of_all, laid_out
from tests.fuzzing.mutate import MODEL_FOLDER, ZIP


def _runs(folder: Path) -> list[bytes]:
    from qs3.runs.metrics import write_metrics
    from qs3.runs.predictions import write_predictions
    from qs3.runs.pseudo_labels import path_of, write_pseudo_labels
    from tests.report.made_runs import metrics
    from tests.runs.test_predictions import predictions

    write_metrics(folder / "run", metrics())
    said = dataclasses.replace(predictions([2, 0]), tiers=("clean", "hard"))
    write_predictions(folder / "run" / "predictions.csv", said)
    rounds = path_of(folder / "run", 1)
    write_pseudo_labels(rounds, ["a", "b"], [0, 1], [0.5, 0.25], [True, False], TWO)
    (folder / "run" / "started.json").write_text('{"data": {"source": "a"}, "config": "b"}')
    (folder / "run" / "history.csv").write_text(
        "epoch,phase,lr,train_loss,source_val/acc\n0,0,0.1,1.5,0.5\n1,1,0.1,,0.75\n"
    )
    hydra = folder / "run" / ".hydra"
    hydra.mkdir()
    domain = {"name": "made", "symbol": "M", "title": "M", "path": "${paths.data_dir}/m"}
    cfg = {"paths": {"data_dir": "data"}, "data": {"source": domain, "target": domain}, "seed": 0}
    (hydra / "config.yaml").write_text(json.dumps(cfg))
    (hydra / "overrides.yaml").write_text("- seed=0\n- experiment=qs3_s2d\n")
    return [folder_of(folder / "run")]


def _read_run(path: Path) -> None:
    from qs3.engine.loggers import CsvHistory
    from qs3.errors import Qs3Error
    from qs3.inference.export import _command
    from qs3.report.figures.canvas import NothingToDrawError
    from qs3.report.runs.data import read_run, settings_of
    from qs3.report.runs.domains import domain_of
    from qs3.report.tables.aggregate import load_runs
    from qs3.runs.folder import read_started
    from qs3.runs.pseudo_labels import path_of, read_pseudo_labels

    folder = laid_out(path)
    _command(folder)
    for call in (
        lambda: read_started(folder),
        lambda: read_pseudo_labels(path_of(folder, 1)),
        lambda: CsvHistory(folder)._rows(),
        lambda: load_runs(folder.parent),
    ):
        with contextlib.suppress(Qs3Error):
            call()
    run = read_run(folder)
    settings_of(run)
    with contextlib.suppress(NothingToDrawError):  # which every caller expects
        domain_of(run, "target")


def _checkpoints(folder: Path) -> list[bytes]:
    import torch

    from qs3.runs.checkpoints import save

    save({"weights": {"a": torch.ones(2, 3)}, "epoch": 3, "n": [1, None, "x"]}, folder / "a.ckpt")
    return bytes_of(folder / "a.ckpt")


def _read_checkpoint(path: Path) -> None:
    from qs3.runs.checkpoints import check, load

    check(path, "again")
    load(path)


def _result() -> Any:
    import torch

    from qs3.inference.model_file import Result

    model = {"_target_": "qs3.models.pointnet.pointnet", "num_classes": 2, "variant": "basic"}
    usual = {"points": [8.0, float("inf")]}
    from qs3.evaluation.ood import ALL

    usual = {next(iter(ALL)): [0.0, float("inf")]}
    held_out = {
        "probabilities": torch.full((3, 2), 0.5),
        "labels": torch.tensor([0, 1, 1]),
        "measures": torch.ones(5, 4),
    }
    weights, norms = {"w": torch.ones(2, 3), "mean": torch.ones(2)}, {"mean": torch.zeros(2)}
    more: Any = {"held_out": held_out, "trained_norms": norms}
    return Result(model, TWO, 8, 16, "made", "z", "unit_ball", usual, weights, **more)


def _results(folder: Path) -> list[bytes]:
    from qs3.inference.model_file import write_result

    write_result(folder / "result.pt", _result())
    return bytes_of(folder / "result.pt")


def _read_result(path: Path) -> None:
    from qs3.errors import Qs3Error
    from qs3.inference.model_file import build_net, read_result

    result = read_result(path)
    if result.held_out:
        _judge(result.held_out)
    assert result.before_target.weights.keys() == result.weights.keys()
    with contextlib.suppress(Qs3Error):  # these weights are not those of the net
        build_net(result)


def _judge(held_out: dict[str, Any]) -> None:
    from qs3.evaluation.trust import Seen, judge
    from qs3.evaluation.trust_file import read_calibration
    from qs3.inference.held_out import known_of

    known = known_of(held_out)
    others = np.full((40, known.probabilities.shape[1]), 1 / known.probabilities.shape[1])
    trust = judge(known, Seen(others, np.ones((5, 4))), read_calibration())
    assert trust is not None
    assert 0 <= trust.expected <= 1


def _models(folder: Path) -> list[bytes]:
    from qs3.inference.model_file import values_of
    from qs3.inference.model_folder import write_folder

    write_folder(folder / "model", values_of(_result()), "card")
    return [folder_of(folder / "model")]


def _read_model(path: Path) -> None:
    resum, folder = half_of_all(path), laid_out(path)
    config, weights = folder / "config.json", folder / "model.safetensors"
    if resum and config.is_file() and weights.is_file():
        try:
            about = json.loads(config.read_bytes())
            about["weights_sha256"] = hashlib.sha256(weights.read_bytes()).hexdigest()
            for name in ("held_out", "trained_norms"):
                if (beside := folder / f"{name}.safetensors").is_file():
                    about[f"{name}_sha256"] = hashlib.sha256(beside.read_bytes()).hexdigest()
            config.write_text(json.dumps(about))
        except (ValueError, TypeError, RecursionError):
            pass
    _read_result(folder)


def _searches(folder: Path) -> list[bytes]:
    from qs3.tuning.state import State

    state = State("s", [0.5], [0.0], [0.0], [1.5, 1.25], [[0.0], [0.25]])
    state.write(folder / "a.json")
    return [(folder / "a.json").read_bytes()]


def _read_search(path: Path) -> None:
    from qs3.tuning.state import read_state

    read_state(path, "s")


def _judgements(folder: Path) -> list[bytes]:
    share = {"mean": 0.5, "sem": None, "low": 0.25, "high": None}
    figures = {
        "tier": "all", "n": 2, "blocks": 1, "accuracy": share, "balanced": share, "majority": 0.5,
        "counts": {"a": 1, "b": 1}, "recall": {"a": 0.5, "b": 1}, "predicted": {"a": 1.5, "b": 1},
    }  # fmt: skip
    family = {"runs": ["result.pt"], "figures": [figures, {**figures, "tier": "clean"}]}
    found = {"data": "a.npz", "sha256": "0" * 64, "part": "judge", "families": [family]}
    return [json.dumps(found).encode()]


def _read_judgement(path: Path) -> None:
    from qs3.inference.judgement import read_judgement
    from qs3.inference.model_card import card

    judgement = read_judgement(path, Path("result.pt"))
    assert len(judgement.sentence) < 1000
    assert judgement.sentence.isprintable()
    card(_result(), None, judgement=judgement)


def _answers(folder: Path) -> list[bytes]:
    from qs3.report.judge.answers import Answers, Asked, keep_answers, kept_name
    from tests.report.made_runs import write_run

    asked = Asked(sha256="0" * 64, part="judge", inliers_only=True, floor=-1.5)
    said = Answers(
        asked=asked, classes=TWO, points=64, target="kinectsim10", objects=(3, 5), called=(0, 1)
    )
    run = write_run(folder / "logs")
    keep_answers({run / "result.pt": said}, folder / "kept")
    return bytes_of(*(folder / "kept").rglob(kept_name("judge")))


def _read_answers(path: Path) -> None:
    from qs3.report.judge.answers import Asked, read_answers

    read_answers(path, Asked(sha256="0" * 64, part="judge", inliers_only=True, floor=-1.5))


def _calibrations(folder: Path) -> list[bytes]:
    from qs3.evaluation.trust_file import Calibration, write_calibration

    found = Calibration({"shapes": 1.0, "unsure": 0.5}, 50, 8, 0.1, 0.2, 0.25)
    write_calibration(folder / "weights.json", found)
    return bytes_of(folder / "weights.json")


def _read_calibration(path: Path) -> None:
    from qs3.evaluation.trust import expected
    from qs3.evaluation.trust_file import SHIFTS, read_calibration

    weights = read_calibration(path).weights
    assert 0 <= expected(0.5, dict.fromkeys(SHIFTS, 1.0), weights) <= 0.5


def _tables(folder: Path) -> list[bytes]:
    table = "title: mine\nmetrics: [accuracy]\ncolumns: [a]\nrows:\n- name: b\n  a:\n    paper: 1\n"
    several = table.replace("[a]", "{a: {run: seed=1, seeds: 2}, c: null, d: seed=2}")
    knot = "&a {title: x, metrics: [accuracy], columns: [*a], rows: []}"
    return [text.encode() for text in (table, several, knot)]


def _read_table(path: Path) -> None:
    from qs3.report.tables.table import build_table

    build_table(str(path), path.parent)


def _journals(folder: Path) -> list[bytes]:
    job = {"job": 0, "folder": "a", "overrides": ["seed=0"], "error": ""}
    return ["\n".join(json.dumps({**job, "job": i}) for i in range(2)).encode()]


def _read_journal(path: Path) -> None:
    from qs3.sweeps.summary import SummaryOfSeeds, differences, failures, last_words

    summary = SummaryOfSeeds.__new__(SummaryOfSeeds)
    summary.journal = path
    jobs = last_words(summary._read())
    failures(jobs)
    differences(jobs)


def _caches(folder: Path) -> list[bytes]:
    from qs3.datamodules.fps_cache import keep_array

    keep_array(folder / "a.npy", np.arange(8, dtype=np.uint16).reshape(2, 4), "made")
    return bytes_of(folder / "a.npy")


def _read_cache(path: Path) -> None:
    from qs3.datamodules.fps_cache import read_array

    read_array(path, (2, 4), "made")


READERS: tuple[Reader, ...] = (
    Reader("run", _runs, _read_run, "a.zip", ZIP,
           ("runs/metrics.py", "runs/predictions.py", "runs/pseudo_labels.py", "runs/folder.py",
            "report/runs/data.py", "engine/loggers.py", "inference/export.py")),
    Reader("checkpoint", _checkpoints, _read_checkpoint, "a.ckpt", ZIP, ("runs/checkpoints.py",)),
    Reader("result .pt", _results, _read_result, "result.pt", ZIP, ("inference/model_file.py",)),
    Reader("model folder", _models, _read_model, "a.zip", MODEL_FOLDER,
           ("inference/model_folder.py", "inference/tensor_file.py")),
    Reader("judgement .json", _judgements, _read_judgement, "a.json", None,
           ("inference/judgement.py", "utils/json_file.py")),
    Reader("kept answers .json", _answers, _read_answers, "judged-judge.json", None,
           ("report/judge/answers.py", "utils/json_file.py")),
    Reader("search .json", _searches, _read_search, "a.json", None, ("tuning/state.py",)),
    Reader("calibration .json", _calibrations, _read_calibration, "a.json", None,
           ("evaluation/trust_file.py",)),
    Reader("table .yaml", _tables, _read_table, "a.yaml", None, ("report/tables/table.py",)),
    Reader("journal of a sweep", _journals, _read_journal, "a.txt", None, ("sweeps/summary.py",)),
    Reader("cache of samples", _caches, _read_cache, "a.npy", None, ("datamodules/fps_cache.py",)),
)  # fmt: skip
