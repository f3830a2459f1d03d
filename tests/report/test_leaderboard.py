"""The leaderboard's rules hold for its rows, and a user's own method is one of them."""

import shlex
from collections.abc import Mapping
from typing import Any

import pytest
import yaml
from omegaconf import OmegaConf

from qs3.config.compose import choices
from qs3.config.hydra import build
from qs3.config.location import CONF
from qs3.report.formats import grid
from qs3.report.running import ALONE, WITH_ROUNDS, first_row, missing, own_row
from qs3.report.table import build_table
from qs3.training.command import train
from tests.composing import compose
from tests.methods.test_own import METHOD, example
from tests.report.filled import run_cell
from tests.running import main
from tests.training.toy import write_toy


def _flat(node: Any, prefix: str = "") -> dict[str, Any]:
    """Dotted keys and their values; what every experiment may call itself is left out."""
    if isinstance(node, Mapping) and node:
        found: dict[str, Any] = {}
        for key, value in node.items():
            found |= _flat(value, f"{prefix}.{key}" if prefix else str(key))
        found.pop("experiment_name", None)
        return found
    return {prefix: node}


def differing(one: Mapping[str, Any], other: Mapping[str, Any]) -> set[str]:
    """Keys that only one config has, or that have different values."""
    both = one.keys() & other.keys()
    return (one.keys() ^ other.keys()) | {key for key in both if one[key] != other[key]}


def _place(override: str) -> str:
    """What an override may change: "method=pcm" the group, "model.norm=x" that key alone."""
    return override.split("=")[0].rpartition("@")[2]


def _within(key: str, places: set[str]) -> bool:
    return any(key == place or key.startswith(f"{place}.") for place in places)


SPEC = yaml.safe_load((CONF / "table" / "leaderboard.yaml").read_text("utf-8"))
LINES = {row["name"]: row["run"].split() for row in SPEC["rows"] if "run" in row}
TASKS = {
    name: task["run"] if isinstance(task, dict) else task
    for name, task in SPEC["columns"].items()
    if task
}
STEPS = 540
# Whatever net a row has, it is the toy's here.
TOY = shlex.join(
    [
        *("num_classes=3", "model._target_=tests.training.nets.tiny", "data.points=32"),
        *("protocol.epochs=1", "protocol.steps=null", "protocol.optimizer.lr=0.02"),
        "report.pictures=false",
    ]
)
SMALL = """
title: Small
metrics: [accuracy]
columns:
  R → N: domain@data.source=rooms10 domain@data.target=nyuv2 data.scale=metres
  S → K: domain@data.source=specklenet10 domain@data.target=kinectsim10
  PointDA-10: null
rows:
  - {name: source only, run: experiment=leaderboard, seeds: 5}
  - {name: PCFEA, PointDA-10: {paper: 76.5, selected: target test accuracy}}
"""


def test_every_method_is_there():
    there = {word for words in LINES.values() for word in words if word.startswith("method=")}
    files = {f"method={name}" for name in choices("method")}
    assert there == files - {"method=source_only", "method=own"}


def test_columns_for_development_see_no_object_of_the_judge():
    """The fold is of the archive's part for training, kept apart from what is judged."""
    judged, fold = (compose("train", TASKS[c].split()).data.target for c in ("R → A", "R → A0"))
    assert (judged.published.fold, fold.published.fold) == (None, 0)
    assert judged.path != fold.path


@pytest.mark.slow
@pytest.mark.parametrize("column", TASKS)
def test_rows_differ_in_nothing_but_what_they_name(column):
    """And in how the same number of steps is shared out between warm-up and rounds."""
    plain = _flat(OmegaConf.to_container(compose("train", [ALONE, *TASKS[column].split()])))
    for row, words in LINES.items():
        assert words[0] == ALONE
        cfg = compose("train", [*words, *TASKS[column].split()])
        flat = _flat(OmegaConf.to_container(cfg))
        places = {_place(word) or word.partition("=")[0] for word in words[1:]}
        assert not {key for key in differing(plain, flat) if not _within(key, places)}, row
        scheme = build(cfg.selftraining)
        assert cfg.protocol.steps + scheme.rounds * (scheme.steps or 0) == STEPS, row
        assert (scheme.rounds > 0) == ({*WITH_ROUNDS.split()} <= {*words}), row
        clouds = 32 if "32" in row else 16
        assert (cfg.data.points, cfg.protocol.batch_size) == (512, clouds), row
        assert cfg.selection.teacher == "last"


@pytest.mark.parametrize("scheme", ["sd", "cbst", "qbst"])
def test_rounds_of_a_row_of_ones_own_are_those_of_the_tables_rows(tmp_path, scheme):
    """Schemes with thresholds of their own have no other, and no row but SD's a setting more."""
    (tmp_path / "mine.py").write_text(METHOD.format(name="Mine"))
    own = compose("train", shlex.split(own_row(tmp_path / "mine.py", None, scheme)["run"]))
    alike = next(words for words in LINES.values() if f"selftraining={scheme}" in words)
    assert own.selftraining == compose("train", alike).selftraining


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
    return build_table(str(toy / "small.yaml"), toy / "logs", extra, rows=rows, columns=["S -> K"])


def words(toy, *more):
    given = {
        "method": toy / "turned.py", "table": toy / "small.yaml", "log_dir": toy / "logs",
        "data_dir": toy / "data", "overrides": TOY, "columns": "S -> K",
    }  # fmt: skip
    given |= dict(word.split("=", 1) for word in more)
    return ["leaderboard", *(f"{key}={value}" for key, value in given.items())]


def test_one_s_own_method_beside_the_others(toy, capsys):
    """The page's example is trained as the command would, and shown."""
    row = own_row(toy / "turned.py", None, "none", ["method.weight=0.5"])
    plain = next(c for c in board(toy).rows["source only"] if c.overrides)
    run_cell(toy / "logs", plain, (0, 1))
    for job in missing(board(toy, row), (0, 1), ["turned"]):
        train(compose("train", list(job.overrides)))
    assert main(words(toy, "seeds=0,1", "method.weight=0.5")) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("turned: 0 runs to do\n## Small: turned\n")
    assert "turned minus" in shown
    pages = (toy / "logs" / "tables").glob("small-S-K-turned*")
    assert {p.suffix for p in pages} == {".md", ".csv"}

    def runs(text, settings=("method.weight=0.5",)):
        (toy / "elsewhere.py").write_text(text)
        mine = own_row(toy / "elsewhere.py", None, "none", settings)
        return len(missing(board(toy, mine), (0, 1), ["elsewhere"]))

    assert runs(example()) == 0  # another place, the same content
    assert runs(example() + "# edited\n") == 2
    assert runs(example(), settings=()) == 2


def test_what_is_refused_before_any_run(toy, tmp_path, capsys):
    two, quick = tmp_path / "two.py", tmp_path / "quick.yaml"
    two.write_text(METHOD.format(name="A") + METHOD.format(name="B"))
    quick.write_text(SMALL.replace("experiment=leaderboard", "experiment=quickstart"))
    for more in (
        f"method={two}", "method=no.py", f"table={quick}", "name=PCFEA",
        "method.wieght=1", "kept=nowhere", "selftraining=x",
    ):  # fmt: skip
        assert main(words(toy, more)) == 1, more
        printed = capsys.readouterr()
        assert "Error: " in printed.err
        assert "to do" not in printed.out


def test_rows_with_runs_are_shown(tmp_path):
    (tmp_path / "small.yaml").write_text(SMALL)

    def built():
        return build_table(str(tmp_path / "small.yaml"), tmp_path)

    run_cell(tmp_path, built().rows["source only"][1])
    shown = first_row(built(), "PCFEA")
    assert grid(shown)[1:] == [
        ["PCFEA, published (epoch by target test accuracy)", "", "", "76.5"],
        ["source only", "not run", "51.0 ± 0.6", ""],
    ]  # fmt: skip
