"""Answers that were kept: the same verdict without weights, and nothing else is taken for them."""

import dataclasses
import json
import shutil

import pytest

from qs3.__main__ import QS3
from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.report.judge.answers import Answers, Asked, find_runs, keep_answers
from qs3.report.judge.judging import judge
from tests.fixtures.frame_files import write_archive
from tests.report.judge.test_judge import add_net
from tests.report.made_runs import write_run

ASKED = Asked(sha256="0" * 64, part="judge", inliers_only=True, floor=None)
SAID = Answers(
    asked=ASKED, classes=("chair",), points=8, target="kinectsim10", objects=(0,), called=(0,)
)


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    path = tmp_path_factory.mktemp("answers") / "held_back.npz"
    write_archive(path, {"train": 1, "test": 3}, points=150)
    return path


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    root = tmp_path_factory.mktemp("logs")
    for seed in (0, 1):
        add_net(write_run(root, seed=seed), seed)
    add_net(write_run(root, experiment="other", hash="ffff0000"), 5)
    return root


@pytest.fixture
def kept(archive, logs, tmp_path):
    judge([str(logs)], archive, keep=tmp_path / "kept")
    return tmp_path / "kept"


def comparable(verdict):
    """All of it but where the runs lie."""
    families = tuple(dataclasses.replace(one, runs=()) for one in verdict.families)
    return dataclasses.replace(verdict, families=families)


def test_the_same_verdict_without_weights(archive, logs, kept):
    names = [str(path.relative_to(kept)) for path in sorted(kept.rglob("*.json"))]
    assert names[:2] == ["exp/seed0-0123abcd/judged-judge.json", "exp/seed0-0123abcd/metrics.json"]
    assert len(names) == 6
    asked_now = comparable(judge([str(logs)], archive))
    assert comparable(judge([str(kept)], archive)) == asked_now
    mixed = judge([str(kept / "exp"), str(logs / "other")], archive)
    assert comparable(mixed) == asked_now
    few = judge([str(kept)], archive, classes=["chair", "sofa"])
    assert comparable(few) == comparable(judge([str(logs)], archive, classes=["chair", "sofa"]))


def test_a_net_is_asked_where_both_are_there(archive, logs, tmp_path):
    both = tmp_path / "both"
    shutil.copytree(logs, both)
    judge([str(both)], archive, keep=both)  # into the runs themselves: nothing is written there
    assert not list(both.rglob("judged-*"))
    judge([str(logs)], archive, keep=tmp_path / "kept")
    shutil.copytree(tmp_path / "kept", both, dirs_exist_ok=True)
    assert {file.name for file in find_runs([str(both)], "judge")} == {"result.pt"}


def test_a_command_keeps_and_takes_up(archive, logs, tmp_path, capsys):
    words = ["report", "judge", f"data={archive}", "part=adapt"]
    assert QS3([*words, f"runs={logs}/exp", f"keep={tmp_path}/kept"]) == 0
    before = capsys.readouterr().out
    assert QS3([*words, f"runs={tmp_path}/kept"]) == 0
    assert capsys.readouterr().out == before.replace(f"kept in {tmp_path}/kept\n", "")
    with pytest.raises(MissingDataError, match=r"no result\.pt.*judged-adapt\.json answers"):
        QS3(["report", "judge", f"data={archive}", f"runs={tmp_path}/kept/exp/seed0-0123abcd"])


def test_answers_with_a_prior_are_others_and_kept_apart(archive, logs, tmp_path, capsys):
    words = ["report", "judge", f"data={archive}", f"runs={logs}/exp"]
    verdicts = {}
    for prior in ("", "chair:1000000", "chair:0"):
        more = {"prior": prior, "prior_power": 1} if prior else {}
        kept = tmp_path / f"kept{len(verdicts)}"  # of each prior its own: one folder keeps one
        told = judge([str(logs / "exp")], archive, keep=kept, **more)
        verdicts[prior] = told.families[-1].figures[0].predicted
        assert len(told.families) == 1 + bool(prior)
        assert told.families[0].figures[0].predicted == verdicts[""]
    assert verdicts["chair:1000000"]["chair"] == pytest.approx(sum(verdicts[""].values()))
    assert verdicts["chair:0"]["chair"] == 0
    names = {file.name for file in kept.rglob("judged-*")}
    assert names == {"judged-judge.json", "judged-judge-prior.json"}
    again = judge([str(kept)], archive, prior="chair:0", prior_power=1)
    assert again.families[1].name == again.families[0].name + ", prior=chair:0"
    assert again.families[1].figures[0].predicted == verdicts["chair:0"]
    assert again.differences == told.differences  # the same seeds, object by object
    with pytest.raises(ConfigError, match="prior_power= is for prior="):
        judge([str(logs / "exp")], archive, prior_power=1)
    with pytest.raises(ConfigError, match=r"prior=chair:0, now sofa:2"):
        judge([str(kept)], archive, prior="sofa:2", prior_power=1)
    assert QS3([*words, "prior=rooms"]) == 0
    assert "beside each run with prior=rooms, power 0.5" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"inliers_only": False}, "inliers_only=True, now False"),
        ({"floor": -1.0}, "floor=None, now -1.0"),
    ],
)
def test_other_questions(archive, kept, change, said):
    with pytest.raises(ConfigError, match=rf"judged-judge\.json has answers .* {said}"):
        judge([str(kept)], archive, **change)


def test_another_archive_and_part(archive, kept, tmp_path):
    write_archive(tmp_path / "other.npz", {"train": 1, "test": 4}, points=150)
    with pytest.raises(ConfigError, match=r"sha256=\w+, now \w+"):
        judge([str(kept)], tmp_path / "other.npz")
    file = kept / "other" / "seed0-ffff0000" / "judged-judge.json"
    with pytest.raises(ConfigError, match="part=judge, now adapt"):
        judge([str(file)], archive, part="adapt")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"inliers_only": False}, "inliers_only=True, now False"),
        ({"floor": -1.0}, "floor=None, now -1.0"),
        ({"data": "other.npz"}, r"sha256=\w+, now \w+"),
        ({"prior": "sofa:2", "prior_power": 1}, "prior=chair:2, now sofa:2"),
    ],
)
def test_kept_answers_are_not_lost_to_others(archive, logs, kept, tmp_path, change, said):
    """Nothing is written, not even what is new; the same question is answered anew."""
    judge([str(logs)], archive, keep=kept, prior="chair:2", prior_power=1)
    if "data" in change:
        change = {"data": tmp_path / change["data"]}
        write_archive(change["data"], {"train": 1, "test": 4}, points=150)
    before = {path: path.read_bytes() for path in kept.rglob("*.json")}
    with pytest.raises(ConfigError, match=rf"{said}; they would be lost: .* keep=FOLDER"):
        judge([str(logs)], **{"data": archive, "keep": kept, **change})
    assert {path: path.read_bytes() for path in kept.rglob("*.json")} == before
    judge([str(logs)], archive, keep=kept)
    assert {path: path.read_bytes() for path in kept.rglob("*.json")} == before
    asked = dataclasses.replace(ASKED, sha256="1" * 64)
    with pytest.raises(ConfigError, match="they would be lost"):
        keep_answers({next(logs.rglob("result.pt")): dataclasses.replace(SAID, asked=asked)}, kept)


def test_a_damaged_file_in_the_place_is_named(archive, logs, kept):
    (file,) = (kept / "other").rglob("judged-judge.json")
    file.write_text("{}")
    with pytest.raises(DataError, match=r"judged-judge\.json is damaged.*; delete it, or give"):
        judge([str(logs)], archive, keep=kept)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"called": [0]}, "one length"),
        ({"called": [99] * 30}, "positions in classes"),
        ({"objects": [3] * 30}, "should ascend"),
        ({"classes": []}, "classes"),
        ({"extra": 1}, "extra"),
        ({"points": -1}, "points"),
        ({"objects": list(range(1000, 1030))}, "no answer to object"),
    ],
)
def test_damaged(archive, kept, change, said):
    (file,) = (kept / "other").rglob("judged-judge.json")
    values = json.loads(file.read_text())
    assert len(values["objects"]) == 30
    file.write_text(json.dumps({**values, **change}))
    with pytest.raises(DataError, match=rf"judged-judge\.json.*{said}"):
        judge([str(file)], archive)


def test_a_run_that_nothing_describes(archive, tmp_path):
    add_net(tmp_path, 3)
    with pytest.raises(ConfigError, match=r"needs the metrics\.json of a run"):
        judge([str(tmp_path)], archive, keep=tmp_path / "kept")
    assert not (tmp_path / "kept").exists()
