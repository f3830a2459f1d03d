"""Runs as a frame: mean and SEM, what must not be averaged, and the file in which they are kept."""

from dataclasses import replace

import pytest

from qs3.errors import DataError, MissingDataError
from qs3.report.results import Runs, load_runs, read_kept, summarise
from qs3.runs.metrics import DataHashes, DataMadeOf, Evaluated
from tests.report.made_runs import CATALOGUE, scores, write_run


def runs(log_dir, take="final"):
    """The runs of the one config in a folder."""
    (found,) = (lines for key, lines in load_runs(log_dir).items() if key[2] == take)
    return Runs(found)


def test_groups_by_hash_not_by_seed(tmp_path):
    for seed in (2, 0, 1):
        write_run(tmp_path, seed=seed, accuracy=0.5 + seed / 100)
    write_run(tmp_path, hash="ffff0000", accuracy=0.9)
    found = load_runs(tmp_path)
    assert {key[1] for key in found} == {"0123abcd", "ffff0000"}
    mine = Runs(found["exp", "0123abcd", "final"])
    assert mine.seeds == [0, 1, 2]
    assert mine.stat("accuracy").percent() == "51.0 ± 0.6"
    assert mine.problems == []


def test_tiers_are_averaged_where_every_seed_has_them(tmp_path):
    for seed, tiers in enumerate(
        ({"clean": scores(0.5)}, {"clean": scores(0.7), "hard": scores(0.2)})
    ):
        known = Evaluated(split="test", labels=True, norms="trained", tiers=tiers)
        write_run(tmp_path, seed=seed, evaluation=known)
    assert runs(tmp_path).stat("accuracy_clean").mean == pytest.approx(0.6)
    assert runs(tmp_path).stat("balanced_accuracy_clean").mean == pytest.approx(0.5)
    assert runs(tmp_path).stat("accuracy_hard") is None  # of one seed alone
    assert runs(tmp_path, "warmup").stat("accuracy_clean") is None
    write_run(tmp_path, seed=2)
    assert runs(tmp_path).stat("accuracy_clean") is None
    assert runs(tmp_path).stat("accuracy").n == 3


def test_unfinished_and_damaged_seeds_are_shown(tmp_path):
    write_run(tmp_path, seed=0)
    begun = tmp_path / "exp" / "seed1-0123abcd"
    begun.mkdir()
    (begun / "started.json").write_text("{}")
    (write_run(tmp_path, seed=2) / "metrics.json").write_text('{"seed": 2, "sta')
    found = runs(tmp_path)
    assert found.seeds == [0]
    assert found.stat("accuracy").n == 1
    text = "\n".join(found.problems)
    assert f"seed 1: unfinished ({begun})" in text
    alone = Runs(found.lines[found.lines.seed == 1].dropna(axis=1))  # none is finished
    assert alone.problems == [f"seed 1: unfinished ({begun})"]
    assert "metrics.json cannot be read" in text


@pytest.mark.parametrize(
    "changes",
    [
        {"data": DataHashes(source="c" * 64, target="b" * 64)},
        {"data": DataHashes(source="a" * 64, target="c" * 64)},
        {"versions": {"qs3": "0.1.0", "weights": "teacher " + "c" * 64}},
    ],
)
def test_runs_that_saw_other_data_are_not_averaged(tmp_path, changes):
    for seed in (0, 1):
        write_run(tmp_path, seed=seed)
    assert not runs(tmp_path).apart
    write_run(tmp_path, seed=2, **changes)
    assert runs(tmp_path).stat("accuracy") is None
    (said,) = runs(tmp_path).problems
    assert "seeds 2: cccccccccccc" in said
    assert "not averaged" in summarise(sorted((tmp_path / "exp").iterdir()))


def test_a_seed_that_occurs_twice_is_not_averaged(tmp_path):
    write_run(tmp_path, seed=0)
    again = write_run(tmp_path / "again", seed=0)
    assert runs(tmp_path).stat("accuracy") is None
    assert str(again) in runs(tmp_path).problems[0]


@pytest.mark.parametrize("role", ["source", "target"])
def test_one_recipe_on_two_machines_is_averaged(tmp_path, role):
    """Bytes of renderings differ by processor; recipes do not."""

    def run(folder, seed, sha, recipe):
        made = {"source": CATALOGUE, "target": CATALOGUE, role: replace(CATALOGUE, recipe=recipe)}
        data = {"source": "a" * 64, "target": "b" * 64, role: sha * 64}
        write_run(folder, seed=seed, data=DataHashes(**data), made_of=DataMadeOf(**made))
        return runs(folder)

    run(tmp_path / "a", 0, "c", "1" * 12)
    found = run(tmp_path / "a", 1, "d", "1" * 12)
    assert found.stat("accuracy").n == 2
    assert found.problems == []
    assert run(tmp_path / "a", 2, "e", "2" * 12).stat("accuracy") is None  # by other code
    run(tmp_path / "b", 0, "c", "")
    assert run(tmp_path / "b", 1, "d", "").stat("accuracy") is None  # it is not known
    run(tmp_path / "c", 0, "c", "1" * 12)
    assert run(tmp_path / "c", 1, "c", "2" * 12).problems == []  # the same bytes


def test_a_diverged_seed_is_averaged_and_shown(tmp_path):
    for seed, infomax in ((0, 0.4), (1, None)):
        write_run(tmp_path, seed=seed, infomax=infomax)
    assert runs(tmp_path).stat("accuracy").n == 2
    assert "seeds 1: the net has diverged" in runs(tmp_path).problems[0]


def test_summary_of_a_multirun(tmp_path):
    folders = [write_run(tmp_path, seed=s, accuracy=0.62 + 0.02 * s) for s in range(3)]
    folders += [write_run(tmp_path, hash="ff00", accuracy=None, method="source_only")]
    folders += [tmp_path / "exp" / "seed1-ff00"]
    lines = summarise(folders, {folders[0]: "theta=0.5"}).splitlines()
    for part in ("theta=0.5", "(simulated target)", "pcm", "qbst", "64.0 ± 1.2", "54.0 ± 1.2"):
        assert part in lines[3]
    assert lines[3].endswith("  45.0")  # a property of the data: no SEM
    assert lines[5] == "exp ff00: no target labels, so no accuracy"
    assert lines[6] == f"exp ff00, seed 1: unfinished ({tmp_path / 'exp' / 'seed1-ff00'})"


def test_a_kept_file_that_cannot_be_read(tmp_path):
    with pytest.raises(MissingDataError, match=r"none\.csv\.gz"):
        read_kept(tmp_path / "none.csv.gz")
    for content in (b"", b"a,b\n1,2\n", b"\x1f\x8b no gzip"):
        (tmp_path / "x.csv.gz").write_bytes(content)
        with pytest.raises(DataError, match=r"x\.csv\.gz"):
            read_kept(tmp_path / "x.csv.gz")
