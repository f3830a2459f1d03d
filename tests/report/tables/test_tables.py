"""Tables: every cell composes, finds its runs by their hash, and shows what is missing."""

import csv
import io
import subprocess
import sys
from dataclasses import replace

import pytest
from omegaconf import OmegaConf

from qs3.config.compose import composing
from qs3.config.hashing import config_hash, run_folder
from qs3.config.location import CONF
from qs3.errors import ConfigError
from qs3.report.tables.cells import Published
from qs3.report.tables.formats import TO_RUN, csv_text, latex, markdown
from qs3.report.tables.table import build_table
from qs3.runs.metrics import DataHashes, EpochScores, Evaluated, Warmup
from tests.composing import compose
from tests.report.made_runs import scores, write_run
from tests.running import main

EXPECTED = ("ablation", "noise", "quickstart", "self_training", "uda")


def run_cell(log_dir, cell, seeds=(0, 1, 2), **changes):
    """Leave results for a cell, as if its command had been run."""
    for seed in seeds:
        cfg = compose("train", [*cell.overrides, f"seed={seed}"])
        folder = write_run(
            log_dir,
            experiment=cfg.experiment_name,
            hash=config_hash(cfg),
            seed=seed,
            **{"accuracy": 0.5 + seed / 100, **changes},
        )
        assert folder.resolve() == run_folder(cfg)  # so that what we fake is what is looked for


def test_every_cell_composes(empty):
    assert set(EXPECTED) <= set(empty)
    for table in empty.values():
        assert table.cells
        for cell in table.cells:
            assert cell.missing == "" or "Could not find" in cell.missing


def test_the_papers_numbers(empty):
    paper = {(c.row, c.column): c.paper for c in empty["uda"].cells}
    assert paper["PCM + QBST (from S it is QS3)", "S → D"] == Published(72.4, 0.8)
    assert paper["DGCNN (w/o adapt)", "M → D"] == Published(46.7, 1.4)
    best = {(c.row, c.column): c.paper for c in empty["ablation"].cells}
    assert best["SimpleView", "B → D"] == Published(65.1, 0.2)


def test_cells_differ(empty):
    for name in EXPECTED:
        commands = [(c.overrides, c.take) for c in empty[name].cells if c.row != "Supervised"]
        assert len(set(commands)) == len(commands)


def test_quickstart_filled(tmp_path):
    empty = build_table("quickstart", tmp_path)
    # PCM is the warm-up of QS3: one command fills both rows.
    assert markdown(empty).count("python train.py experiment=quickstart") == 3
    assert markdown(empty).count("not run") == 8
    for cell in empty.cells[:2]:
        run_cell(tmp_path, cell)
    selected = EpochScores(epoch=7, scores=scores(0.52))
    warmup = Warmup(selected=selected, last=selected)
    run_cell(tmp_path, empty.cells[3], seeds=(0,), accuracy=0.7, warmup=warmup)
    text = markdown(build_table("quickstart", tmp_path))
    lines = text.splitlines()
    rows = [[word.strip() for word in line.split("|")[1:-1]] for line in lines]
    assert rows[2] == [
        "method", "accuracy % (simulated)", "balanced accuracy % (simulated)", "seeds"
    ]  # fmt: skip
    assert ["source only, speckle scans (S)", "51.0 ± 0.6", "41.0 ± 0.6", "0, 1, 2"] in rows
    assert ["PCM, speckle scans", "52.0 (n=1)", "42.0 (n=1)", "0"] in rows
    assert ["QS3 = PCM + QBST, speckle scans", "70.0 (n=1)", "60.0 (n=1)", "0"] in rows
    assert len({len(line) for line in lines[2:8]}) == 1  # aligned
    assert "simulated target kinectsim10" in text
    assert "not the paper's protocol" in text
    assert "majority rate of the simulated target kinectsim10: 45.0 %" in text
    assert "teacher selected by: source_val\n" in text
    # What has one seed: both rows are filled by the same command.
    shown = [line for line in lines if line.startswith("python train.py")]
    assert shown == [build_table("quickstart", tmp_path).cells[3].command]
    assert f"{TO_RUN}:" in lines
    run_cell(tmp_path, empty.cells[3], seeds=(1, 2), accuracy=0.7, warmup=warmup)
    assert TO_RUN not in markdown(build_table("quickstart", tmp_path))


def test_paper_beside_ours(tmp_path, empty):
    cell = next(c for c in empty["uda"].cells if c.paper == Published(72.4, 0.8))
    cell = replace(cell, overrides=(*cell.overrides, f"paths.log_dir={tmp_path}"))
    run_cell(tmp_path, cell, target="depthscannet10", simulated=False)
    table = build_table("uda", tmp_path)
    text = markdown(table)
    assert "| 51.0 ± 0.6        | 72.4 ± 0.8 |" in text
    assert "majority rate of the target depthscannet10: 45.0 %" in text
    assert r"51.0 $\pm$ 0.6 & 72.4 $\pm$ 0.8 \\" in latex(table)
    rows = list(csv.DictReader(io.StringIO(csv_text(table))))
    (ours,) = [row for row in rows if row["n"] != "0"]
    assert float(ours["mean"]) == pytest.approx(51)
    assert (ours["paper_mean"], ours["paper_sem"], ours["seeds"]) == ("72.4", "0.8", "0 1 2")
    assert ours["command"].startswith("python train.py experiment=qs3_s2d")


def test_majority_rates_of_tiers_stand_below(tmp_path):
    tiers = {"clean": scores(majority_rate=0.25), "hard": scores(majority_rate=0.625)}
    known = Evaluated(split="test", labels=True, rotations=0, norms="trained", tiers=tiers)
    run_cell(tmp_path, build_table("quickstart", tmp_path).cells[0], evaluation=known)
    text = markdown(build_table("quickstart", tmp_path))
    assert (
        "majority rate of the simulated target kinectsim10: 45.0 %, clean 25.0 %, hard 62.5 %\n"
        in text
    )


def test_tiers_that_a_number_lacks(tmp_path):
    """A warm-up has no scores of tiers, a target without tiers never gets any by another run."""
    path = tmp_path / "x.yaml"
    run = "{run: experiment=quickstart"
    path.write_text(
        "title: x\nmetrics: [accuracy_clean, accuracy]\ncolumns: [target test]\nrows:\n"
        f"- {{name: QS3, target test: {run}}}}}\n"
        f"- {{name: PCM, target test: {run}, take: warmup}}}}\n"
    )
    known = Evaluated(
        split="test", labels=True, rotations=0, norms="trained", tiers={"clean": scores(0.7)}
    )
    plain = replace(known, tiers=None)
    for first, last, shown in (
        (known, known, [["70.0 ± 0.0", "51.0 ± 0.6"], ["not of warm-ups", "50.0 ± 0.0"]]),
        (known, plain, [["not of every seed", "51.0 ± 0.6"], ["not of warm-ups", "50.0 ± 0.0"]]),
        (plain, plain, [["no such tier", "51.0 ± 0.6"], ["no such tier", "50.0 ± 0.0"]]),
    ):
        logs = tmp_path / shown[0][0]
        cell = build_table(str(path), logs).cells[0]
        run_cell(logs, cell, (0, 1), evaluation=first)
        run_cell(logs, cell, (2,), evaluation=last)
        table = build_table(str(path), logs)
        assert [[cell.text(metric) for metric in table.metrics] for cell in table.cells] == shown
        assert TO_RUN not in markdown(table)


def test_factors_are_told_apart_by_their_names(empty):
    """`qs3 report judge` calls runs by their experiment's name; the source's path is not hashed."""
    cells = empty["real_factors"].cells
    names = [[word for word in c.overrides if word.startswith("experiment_name=")] for c in cells]
    assert len({*map(tuple, names)}) == len(cells)
    assert [c.row for c, name in zip(cells, names, strict=True) if not name] == ["R"]


def test_problems_reach_the_reader(tmp_path):
    cell = build_table("quickstart", tmp_path).cells[0]
    run_cell(tmp_path, cell, seeds=(0, 1))
    run_cell(tmp_path, cell, seeds=(2,), data=DataHashes(source="x", target="y"))
    text = markdown(build_table("quickstart", tmp_path))
    assert "| not averaged † " in text
    assert "the source dataset differs" in text


def test_another_target(tmp_path):
    table = build_table("uda", tmp_path, target="kinectsim10")
    assert all("domain@data.target=kinectsim10" in c.overrides for c in table.cells)
    assert all(c.paper is None for c in table.cells)
    assert "which is not the paper's" in markdown(table)
    assert "on another target: kinectsim10" in markdown(table)
    upper = [c for c in table.cells if "experiment=supervised_d" in c.overrides]
    assert upper
    for cell in table.cells:  # the upper bound is trained on the other target, too
        assert ("domain@data.source=kinectsim10" in cell.overrides) == (cell in upper)
    with pytest.raises(ConfigError, match=r"not a domain \(did you mean kinectsim10\?\)"):
        build_table("uda", tmp_path, target="kinectsim1")


def test_composing_inside_an_application():
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    with initialize_config_dir(str(CONF), version_base="1.3"):
        outer = GlobalHydra.instance().hydra
        with composing() as compose:
            assert OmegaConf.is_config(compose("train", []))
        assert GlobalHydra.instance().hydra is outer


def test_an_edited_method_has_other_runs(tmp_path):
    """Also in one process, as in a notebook: the file's content is in the hash."""
    file, table = tmp_path / "mine.py", tmp_path / "mine.yaml"
    run = f"experiment=leaderboard method=own method.file={file}"
    table.write_text(
        f"title: t\nmetrics: [accuracy]\ncolumns: [c]\nrows:\n  - {{name: mine, run: {run}}}\n"
    )

    def cell():
        return build_table(str(table), tmp_path / "logs").rows["mine"][0]

    file.write_text("# one\n")
    run_cell(tmp_path / "logs", cell())
    assert cell().group.seeds == [0, 1, 2]
    file.write_text("# two\n")
    assert cell().group is None
    file.unlink()
    assert cell().group is None
    file.write_text("# one\n")
    assert cell().group.seeds == [0, 1, 2]


def test_extra_overrides_are_part_of_the_command(tmp_path):
    table = build_table("quickstart", tmp_path, extra=["data.points=64"])
    assert f"data.points=64 paths.log_dir={tmp_path} seed=0,1,2 -m" in table.cells[0].command
    with pytest.raises(ConfigError, match=r"table cell 'source only, surface.*no_such_key"):
        build_table("quickstart", tmp_path, extra=["no_such_key=1"])
    with pytest.raises(ConfigError, match=r"'data\.point'; did you mean data\.points=\?"):
        build_table("quickstart", tmp_path, extra=["data.point=64"])
    with pytest.raises(ConfigError, match=r"'model/dgcn'; did you mean model=dgcnn\?"):
        build_table("quickstart", tmp_path, extra=["model=dgcn"])


def test_other_settings_do_not_write_over_a_table(tmp_path, capsys):
    words = ["report", "table=quickstart", f"log_dir={tmp_path}"]
    assert main(words) == 0
    plain = (tmp_path / "tables" / "quickstart.csv").read_bytes()
    assert main([*words, "overrides=data.points=64"]) == 0
    assert (tmp_path / "tables" / "quickstart.csv").read_bytes() == plain
    page = (tmp_path / "tables" / "quickstart-data.points=64.md").read_text()
    assert "- overrides of the runs: `data.points=64`\n" in page
    assert "saved" in capsys.readouterr().out


def test_a_row_to_compare_with_is_looked_for_before_any_run(tmp_path, capsys):
    """Each cell takes a while to look up, a table with many minutes."""
    words = ["report", "compare", "table=leaderboard", f"log_dir={tmp_path}"]
    assert main(words) == 1
    assert "against which row? give base=; rows are '" in capsys.readouterr().err
    assert main([*words, "base=mars"]) == 1
    assert "table leaderboard has no row 'mars'; rows are '" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("title: [", "x.yaml is not readable: while parsing"),
        ("title: 2020-99-99", "x.yaml is not readable: month must be"),
        ("[]", "x.yaml: the file: "),
        ("title: x\nrows: []", "x.yaml: metrics: Field required"),
        ("HEAD\ntilte: y\nrows: []", "x.yaml: tilte: Unexpected"),
        ("HEAD\nlayout: wide\nrows: []", "x.yaml: layout: Input should be '' or 'benchmark'"),
        ("HEAD\nnotes: [a: b]\nrows: []", r"x.yaml: notes\.0: .*put quotes around it"),
        ("HEAD\nrows:\n- {name: r, paper: [1]}", "row 'r': paper: has 1 number for 2 columns"),
        ("HEAD\nrows:\n- {name: r, a: {paper: 101}}", "paper: 101.0.*from 0 to 100"),
        ("HEAD\nrows:\n- {name: r, a: {paper: [1, 2, 3]}}", "x.yaml: missing or wrong entry"),
        (f"HEAD\nrows:\n- {{name: r, a: {{paper: 1{'0' * 400}}}}}", "wrong entry int too large"),
        ("HEAD\nrows:\n- {a: {paper: 1}}", "x.yaml: missing or wrong entry 'name'"),
        ("HEAD\nrows: [{name: [a], a: {paper: 1}}]", "x.yaml: missing or wrong entry 'name'"),
        ("HEAD\nrows: [{}]", "x.yaml: missing or wrong entry 'name'"),
        ("title: x\nmetrics: []\ncolumns: []\nrows: []", "x.yaml: metrics: List should have at"),
        ("HEAD\nrows:\n- {name: r, a: {run: x, take: warmpu}}", "take: must be final or warmup"),
        ("HEAD\nrows:\n- {name: r, a: {run: nonsense}}", "table cell 'r', 'a': .*nonsense"),
        ("HEAD\nrows:\n- {name: r, run: x, columns: [a, c]}", "row 'r': columns: 'c' is none of"),
        ("HEAD\nrows:\n- {name: r, run: x, columns: a}", "row 'r': columns: 'a' is none of"),
        ("HEAD\nrows:\n- {name: r, run: x, sed: 5}", "row 'r': sed is not a column or .* seeds"),
        ("HEAD\nrows:\n- {name: r, A: {run: x}}", "row 'r': A is not a column .* there are a, b"),
        ("HEAD\nrows:\n- {name: r, a: {runs: x}}", "row 'r', 'a': runs is not a key .* run?"),
    ],
)
def test_wrong_tables(tmp_path, text, message):
    path = tmp_path / "x.yaml"
    with pytest.raises(ConfigError, match=r"no table .*x\.yaml'; there are ablation, .*NAME\.yaml"):
        build_table(str(path))
    path.write_text(text.replace("HEAD", "title: x\nmetrics: [accuracy]\ncolumns: [a, b]"))
    with pytest.raises(ConfigError, match=message):
        build_table(str(path))


def test_a_row_may_be_for_some_columns_alone(tmp_path):
    path = tmp_path / "x.yaml"
    run = "experiment=source_only_s2d"
    path.write_text(
        "title: x\nmetrics: [accuracy]\n"
        "columns: {a: domain@data.target=kinectsim10, b: domain@data.target=scannet10}\n"
        f"rows:\n- {{name: all, run: {run}}}\n- {{name: one, run: {run} seed=5, columns: [b]}}\n"
    )
    table = build_table(str(path), tmp_path)
    assert [cell.target for cell in table.rows["all"]] == ["kinectsim10", "scannet10"]
    first, second = table.rows["one"]
    assert first is None
    assert second.target == "scannet10"


def test_command_line(tmp_path, capsys):
    assert main(["report", "table=quickstart", f"log_dir={tmp_path}"]) == 0
    printed = capsys.readouterr().out
    saved = (tmp_path / "tables" / "quickstart.md").read_text()
    assert saved in printed
    assert {p.suffix for p in (tmp_path / "tables").iterdir()} == {".md", ".csv", ".tex"}
    argv = [
        "report",
        "table=quickstart",
        f"paths.log_dir={tmp_path}",
        f"paths.data_dir={tmp_path}/data",
    ]
    assert main(argv) == 0
    assert f"paths.data_dir={tmp_path}/data paths.log_dir={tmp_path}" in capsys.readouterr().out
    assert main(["report", "tabel=quickstart"]) == 1
    assert "unknown key 'tabel'; did you mean table=?" in capsys.readouterr().err
    assert main(["report", f"log_dir={tmp_path}"]) == 1
    assert "table=NAME is missing: one of ablation, cad10" in capsys.readouterr().err


def test_the_report_needs_no_torch(tmp_path):
    code = (
        "import sys; from tests.running import main\n"
        "main(['report', 'table=quickstart', *sys.argv[1:]]); sys.exit('torch' in sys.modules)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, f"log_dir={tmp_path}"], capture_output=True
    )
    assert result.returncode == 0, result.stderr
