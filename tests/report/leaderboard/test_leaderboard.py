"""The leaderboard's rules hold for its rows, and a user's own method is one of them."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys

import pytest
import yaml
from omegaconf import OmegaConf

from qs3.config.compose import choices
from qs3.config.hashing import config_hash
from qs3.config.hydra import build
from qs3.config.location import CONF
from qs3.errors import ConfigError
from qs3.report.leaderboard.cli import (
    ALONE,
    WITH_ROUNDS,
    _file_name,
    _intervals,
    beside,
    own_row,
)
from qs3.report.tables.formats import grid, markdown, to_run
from qs3.report.tables.running import missing
from qs3.report.tables.table import build_table
from qs3.runs.metrics import Times
from qs3.training.command import train
from tests.composing import compose
from tests.engine.test_rows import _flat, _place, _within, differing
from tests.methods.test_own import METHOD, example
from tests.report.tables.test_tables import run_cell
from tests.running import ROOT, main
from tests.training.toy import write_toy

SPEC = yaml.safe_load((CONF / "table" / "leaderboard.yaml").read_text("utf-8"))
LINES = {row["name"]: row["run"].split() for row in SPEC["rows"] if "run" in row}
TASKS = {
    name: task["run"] if isinstance(task, dict) else task
    for name, task in SPEC["columns"].items()
    if task
}
STEPS = 540
PUBLISHED = ("PointDA-10", "GraspNetPC-10")
# Whatever net a row has, it is the toy's here.
TOY = shlex.join(
    [
        *("num_classes=3", "model._target_=tests.training.nets.tiny", "data.points=32"),
        *("protocol.epochs=1", "protocol.steps=null", "protocol.optimizer.lr=0.02"),
        *("callbacks=none", "report.pictures=false"),
    ]
)
SMALL = """
title: Small
metrics: [accuracy]
costs: true
columns:
  R → N: domain@data.source=roomscan10 domain@data.target=nyuv2 data.scale=metres
  S → K: domain@data.source=specklenet10 domain@data.target=kinectsim10
  PointDA-10: null
rows:
  - {name: source only, run: experiment=leaderboard, seeds: 5}
  - {name: PCFEA, PointDA-10: {paper: 76.5, selected: target test accuracy}}
"""


def test_every_method_is_there():
    """Of PCFEA's pools by a selector of `selftraining` one stands for both."""
    there = {word for words in LINES.values() for word in words if word.startswith("method=")}
    files = {f"method={path.stem}" for path in (CONF / "method").glob("*.yaml")}
    assert there == files - {"method=source_only", "method=own", "method=pcfea_spst"}


HALF = {"evaluation.norms=alpha_bn"}
SHARES = {"evaluation.prior=estimated", "evaluation.prior_power=0.2"}
AT_32 = {"protocol.batch_size=32"}  # as many labelled clouds a step as Twins
ADDED = {  # when R -> A had been looked at: a control, and a rule fixed without it
    "source only, batches of 32": AT_32,
    "alpha-BN, batches of 32": AT_32 | HALF,
    "alpha-BN and estimated shares, batches of 32 (ours)": AT_32 | HALF | SHARES,
    "alpha-BN": HALF,
    "alpha-BN and estimated shares (ours)": HALF | SHARES,
}


def test_rows_say_nothing_beyond_the_rules():
    """What a row may name, and that each one with rounds has as many steps as the others."""
    rounds = set(WITH_ROUNDS.split())
    for row, words in LINES.items():
        assert words[0] == ALONE
        if row in ADDED:
            assert set(words[1:]) == ADDED[row]
            continue
        named = {word.partition("=")[0] for word in words[1:]}
        assert named <= {
            *("method", "selftraining", "selftraining.share", "evaluation.norms", "model"),
            *("selftraining.selector.graph", "selftraining.selector.growth"),
            *("protocol.epochs", "protocol.steps", "evaluation.prior"),
        }, row
        assert ("selftraining" in named) == (rounds <= set(words)), row
        assert {"protocol.epochs", "protocol.steps"} & named == (
            {"protocol.epochs", "protocol.steps"} if rounds <= set(words) else set()
        )
    for row in SPEC["rows"]:  # where it is not the target's own, by the counts of another dataset
        if row["name"] in ADDED:
            assert row["columns"] == ["R → N", "R → A"]
            continue
        prior = [word for word in row.get("run", "").split() if "evaluation.prior" in word]
        assert prior in ([], ["evaluation.prior=rooms"])
        assert row.get("columns") == (["R → N", "R → A", "R → A0"] if prior else None)
    five = {row["name"] for row in SPEC["rows"] if row.get("seeds") == 5}
    assert five - set(ADDED) == {
        "source only",
        "QS3 (PCM+QBST)",
        "Twins (ours)",
        "MLSP",
        "DefRec+PCM",
    }
    assert {row.get("seeds", 3) for row in SPEC["rows"]} == {3, 5}


def test_published_figures_are_those_of_the_benchmarks():
    """Averages over all directions, as in the tables that have each direction."""
    other = {"PCFEA, its authors' logs": "PCFEA, last epoch", "SD": "Self-Distillation"}
    seen = 0
    for column, name in zip(PUBLISHED, ("pointda10", "graspnetpc10"), strict=True):
        spec = yaml.safe_load((CONF / "table" / f"{name}.yaml").read_text("utf-8"))
        there = {row["name"]: row for row in spec["rows"]}
        for row in SPEC["rows"]:
            if column not in row:
                continue
            found = there.get(other.get(row["name"], row["name"]))
            if found is None:
                assert row["name"] == "MLSP"  # its first step alone: that table has both
                continue
            numbers = found["paper"]
            average = found.get("average", sum(numbers) / len(numbers))
            assert row[column]["paper"] == pytest.approx(average, abs=0.0501), (row, column)
            said = found["selected"].replace(" (released ", "; ").removesuffix(")")
            assert row[column]["selected"] == said
            seen += 1
    assert seen == 19


def test_columns_for_development_see_no_object_of_the_judge():
    """The fold is of the archive's part for training, kept apart from what is judged."""
    judged, fold = (compose("train", TASKS[c].split()).data.target for c in ("R → A", "R → A0"))
    assert (judged.published.fold, fold.published.fold) == (None, 0)
    assert judged.path != fold.path
    assert fold.published.train_parts == ["adapt"]
    hashes = {
        name: config_hash(compose("train", [*ALONE.split(), *task.split()]))
        for name, task in TASKS.items()
    }
    assert len(set(hashes.values())) == len(TASKS)  # no column takes another's runs


@pytest.mark.parametrize(
    "column",
    [pytest.param(name, marks=pytest.mark.slow if i else ()) for i, name in enumerate(TASKS)],
)
def test_rows_differ_in_nothing_but_what_they_name(column):
    """And in how the same number of steps is shared out between warm-up and rounds."""
    plain = None
    for row, words in LINES.items():
        cfg = compose("train", [*words, *TASKS[column].split()])
        flat = _flat(OmegaConf.to_container(cfg))
        plain = flat if row == "source only" else plain
        if plain is None:
            continue  # of the upper bound, which comes first
        places = {_place(word) or word.partition("=")[0] for word in words[1:]}
        outside = {key for key in differing(plain, flat) if not _within(key, places)}
        assert outside == set(), row
        scheme = build(cfg.selftraining)
        assert cfg.protocol.steps + scheme.rounds * (scheme.steps or 0) == STEPS, row
        clouds = 32 if "32" in row else 16
        assert (cfg.data.points, cfg.protocol.batch_size) == (512, clouds), row
        assert scheme.rounds == 0 or scheme.batch_size == 16
        assert (cfg.selection.teacher, cfg.selection.student) == ("last", "last")


@pytest.mark.parametrize("scheme", sorted({*choices("selftraining")} - {"none"}))
def test_rounds_of_a_row_of_ones_own_are_those_of_the_tables_rows(tmp_path, scheme):
    """Schemes with thresholds of their own have no other, and no row but SD's a setting more."""
    (tmp_path / "mine.py").write_text(METHOD.format(name="Mine"))
    row = own_row(tmp_path / "mine.py", None, scheme)
    own = compose("train", shlex.split(row["run"])).selftraining
    assert build(own).rounds == 2
    graph = "selftraining.selector.graph=false"  # another row, a control
    alike = [w for w in LINES.values() if f"selftraining={scheme}" in w and graph not in w]
    assert alike or scheme in ("confident", "random")
    for words in alike[:1]:
        assert own == compose("train", words).selftraining


@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    """A folder with the toy's data, a small board, and the page's example."""
    folder = tmp_path_factory.mktemp("board")
    write_toy(folder / "data")
    (folder / "small.yaml").write_text(SMALL)
    (folder / "turned.py").write_text(example())
    return folder


def board(toy, *rows):
    extra = [*shlex.split(TOY), f"paths.data_dir={toy / 'data'}"]
    return build_table(str(toy / "small.yaml"), toy / "logs", extra, rows=rows, columns=["K"])


def words(toy, *more):
    return [
        *("leaderboard", f"method={toy / 'turned.py'}", f"table={toy / 'small.yaml'}"),
        *(f"log_dir={toy / 'logs'}", f"data_dir={toy / 'data'}", f"overrides={TOY}"),
        *("columns=S -> K", *more),
    ]


def test_one_s_own_method_beside_the_others(toy, capsys):
    """The page's example is trained as the command would, and shown."""
    row = own_row(toy / "turned.py", None, "none", ["method.weight=0.5"])
    jobs = missing(board(toy, row), (0, 1), ["turned"])
    assert len(jobs) == 2
    for job in jobs:
        metrics = train(compose("train", list(job.overrides)))
        assert metrics.times.memory_gb > 0.05
        assert metrics.times.core_seconds > 0
    assert main(words(toy, "seeds=0,1", "method.weight=0.5")) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("turned: 0 runs to do\n## Small: turned\n")
    rows = [[c.strip() for c in line.split("|")[1:-1]] for line in shown.splitlines()]
    head, _, ours = (line for line in rows[1:6] if line)
    assert head == [
        "method", "S → K (simulated), accuracy %", "PointDA-10, published accuracy %",
        "core time a run", "memory",
    ]  # fmt: skip
    assert ours[0] == "turned"
    assert re.fullmatch(r"\d+\.\d ± \d+\.\d \(n=2\)", ours[1])
    assert re.fullmatch(r"\d+\.\d( to \d+\.\d)? GB", ours[-1])
    saved = toy / "logs" / "tables"
    (page,) = saved.glob("small-turned-*.md")  # behind the dash: which overrides
    assert page.read_text() in shown
    assert {p.suffix for p in saved.glob(f"{page.stem}.*")} == {".md", ".csv", ".tex"}
    assert f"- beside the rules all runs of this page have: {TOY}\n" in shown

    def runs(text, settings=("method.weight=0.5",)):
        (toy / "elsewhere.py").write_text(text)
        mine = own_row(toy / "elsewhere.py", None, "none", settings)
        return len(missing(board(toy, mine), (0, 1), ["elsewhere"]))

    assert runs(example()) == 0  # another place, the same content
    assert runs(example() + "# edited\n") == 2
    assert runs(example(), settings=()) == 2


def test_rows_of_one_file_have_pages_of_their_own():
    assert _file_name("my_method") == "my_method"
    assert _file_name("Turned, w = 0.3") == "Turned-w-0.3"
    assert _file_name("Mine (λ/2)") == "Mine-λ-2"
    assert _file_name("../../x") == "x"
    assert _file_name("?") == "row"


def test_a_loss_that_fails_is_refused_before_any_run(toy, tmp_path, capsys):
    file = tmp_path / "wrong.py"
    text = example().replace('source["y_source"]', 'batch["target"]["y_target"]')
    file.write_text(text)
    (line,) = (i for i, one in enumerate(text.splitlines(), 1) if "y_target" in one)
    given = [word for word in words(toy) if not word.startswith("method=")]
    assert main([*given, f"method={file}"]) == 1
    said = capsys.readouterr()
    assert f"wrong.py, line {line}: KeyError: 'y_target'; a batch has " in said.err
    assert "to do" not in said.out


def test_what_is_refused(toy, tmp_path, capsys):
    def said(*more):
        assert main(words(toy, *more)) == 1
        return capsys.readouterr().err

    assert "two rows are called 'PCFEA'; give one another name" in said("name=PCFEA")
    given = [word for word in words(toy) if not word.startswith("columns=")]
    assert main([*given, "columns=PointDA"]) == 1
    assert "'PointDA-10' of table small are published figures alone" in capsys.readouterr().err
    assert "kept=nowhere is not there" in said("kept=nowhere")
    assert "selftraining=x is not there; there are cbst, " in said("selftraining=x")
    assert "Turned: " in said("method.wieght=1")
    other = [word for word in words(toy) if not word.startswith("table=")]
    quick = toy / "quick.yaml"
    quick.write_text(SMALL.replace("experiment=leaderboard", "experiment=quickstart"))
    assert main([*other, f"table={quick}"]) == 1
    assert "its row 'source only' is not of experiment=leaderboard" in capsys.readouterr().err
    (tmp_path / "two.py").write_text(METHOD.format(name="A") + METHOD.format(name="B"))
    for file, message in (("no.py", "no.py cannot be read"), ("two.py", "expected one class")):
        given = [word for word in words(toy) if not word.startswith("method=")]
        assert main([*given, f"method={tmp_path / file}"]) == 1
        assert message in capsys.readouterr().err
    with pytest.raises(ConfigError, match="columns of table leaderboard have several targets"):
        build_table("leaderboard", tmp_path, target="kinectsim10")
    with pytest.raises(ConfigError, match="no column of table small has 'mars' in its name"):
        missing(board(toy), columns=["mars"])


def test_what_is_shown(tmp_path):
    (tmp_path / "small.yaml").write_text(SMALL)

    def built():
        return build_table(str(tmp_path / "small.yaml"), tmp_path)

    real, simulated, _ = built().rows["source only"]
    times = Times(seconds=700.0, core_seconds=480.0, memory_gb=1.1, gpu_memory_gb=2.25)
    run_cell(tmp_path, real, (0, 1, 2), times=times, target="nyuv2", simulated=False, accuracy=0.4)
    run_cell(
        tmp_path,
        simulated,
        range(5),
        times=Times(seconds=900.0, core_seconds=600.0, memory_gb=0.82),
    )
    table = built()
    assert grid(table)[1:] == [
        [
            *("source only", "40.0 ± 0.0", "52.0 ± 0.7", ""),
            *("8.0 to 10.0 min", "0.8 to 1.1 GB, GPU 2.2 GB"),
        ],
        ["PCFEA", "", "", "76.5 (target test accuracy)", "", ""],
    ]  # fmt: skip
    assert "‡" not in markdown(table)  # published figures are of other columns
    (line,) = to_run(table)  # three of five seeds
    assert "data.target=nyuv2" in line
    assert line.endswith("seed=0,1,2,3,4 -m")
    assert [job.name[-6:] for job in missing(table)] == ["seed 3", "seed 4"]
    assert [job.name for job in missing(table, [7], columns=["K"])] == [
        "source only, S → K, seed 7"
    ]


AVERAGED = """
title: Averaged
layout: benchmark
metrics: [accuracy]
columns:
  A: domain@data.source=roomscan10 domain@data.target=nyuv2
  B: domain@data.source=specklenet10 domain@data.target=kinectsim10
rows:
  - {name: GAST, run: experiment=leaderboard method=gast, paper: [50.0, 60.0], average: 54.9}
"""


@pytest.mark.parametrize(("columns", "average"), [("A", "50.0"), ("AB", "54.9")])
def test_a_published_average_stands_beside_all_of_its_columns(tmp_path, columns, average):
    """Beside a part of them it would be of others: there it is their own mean."""
    file = tmp_path / "averaged.yaml"
    file.write_text(AVERAGED)
    for cell in build_table(str(file), tmp_path).cells:
        if cell.column in columns:
            run_cell(tmp_path, cell)
    head, published, _ = grid(beside(build_table(str(file), tmp_path), "GAST"))
    shown = dict(zip(head, published, strict=True))
    assert len(head) == 4 + len(columns)
    assert shown["average accuracy %"] == average


def test_without_two_seeds_in_common_there_is_a_reason_and_no_empty_table(tmp_path):
    (tmp_path / "small.yaml").write_text(
        SMALL + '  - {name: PCM, run: "experiment=leaderboard method=pcm"}\n'
    )

    def shown(*seeds):
        for name in ("source only", "PCM"):
            cell = build_table(str(tmp_path / "small.yaml"), tmp_path).rows[name][1]
            run_cell(tmp_path, cell, seeds)
        return _intervals(build_table(str(tmp_path / "small.yaml"), tmp_path), "PCM")

    said = "PCM minus source only, S → K"
    assert shown() == ""
    assert shown(0) == f"\n{said}: fewer than two seeds in common ([0])\n"


@pytest.mark.slow
def test_the_commands_train_and_print(toy):
    """In processes of their own, as a user would; a second call trains nothing."""

    def qs3(*more):
        done = subprocess.run(
            [sys.executable, "-m", "qs3", *more],
            cwd=ROOT, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    options = words(toy, "seeds=0,1", "selftraining=qbst", "name=with rounds")
    options = [word.replace("protocol.epochs=1", "selftraining.steps=null") for word in options]
    assert "with rounds: 2 runs to do" in qs3(*options)
    again = qs3(*options)
    assert "with rounds: 0 runs to do" in again
    assert re.search(r"\| with rounds +\| \d", again)
    small = [
        word for word in options if word.startswith(("table=", "log", "data", "over", "seeds"))
    ]
    assert "2 runs to do" in qs3("report", "train", *small, "rows=source only", "columns=K")
    beside = qs3(*options)
    assert re.search(r"with rounds minus\n\n.*\n.*\n\| source only, S → K +\| [+-]", beside)
    report = [f"log_dir={toy / 'logs'}", f"data_dir={toy / 'data'}", f"overrides={TOY}"]
    first = qs3(
        "report", "train", "table=leaderboard", "rows=cpcm", "columns=S -> K", "seeds=0", *report
    )
    assert "table leaderboard: 1 run to do" in first
    table = qs3("report", "table=leaderboard", *report)
    assert re.search(r"\| CPCM +\| not run .*\| \d+\.\d \(n=1\) ", table)
