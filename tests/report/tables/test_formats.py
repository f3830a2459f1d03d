"""What every format of a table must say: what is simulated, what failed, how it was selected."""

import csv
import io
import re
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.config.hashing import config_hash
from qs3.errors import ConfigError
from qs3.report.tables import table as tables
from qs3.report.tables.cells import Cell, Published, Table
from qs3.report.tables.formats import csv_text, details, grid, latex, markdown, to_run
from qs3.report.tables.running import missing
from qs3.report.tables.table import build_table
from qs3.runs.metrics import Times
from qs3.utils.text_table import latex_text
from tests.composing import compose
from tests.report.made_runs import write_run
from tests.report.tables.test_tables import run_cell

FORMATS = {"md": markdown, "tex": latex, "csv": csv_text}


def parse_latex(text):
    """Cells of the tabular's rows, as many as its columns; refuses what will not compile."""
    code = [line for line in text.splitlines() if not line.startswith("%")]
    opened = []
    for line in code:
        for kind, name in re.findall(r"\\(begin|end)\{(\w+)\}", line):
            if kind == "begin":
                opened.append(name)
            else:
                assert opened.pop() == name
        bare = re.sub(r"\\[&%$#_{}\\]", "", line)
        assert bare.count("{") == bare.count("}")
        assert bare.count("$") % 2 == 0
        assert not set(bare) & set("%#~^")
        bare.replace("$\\pm$", "").encode("ascii")
    assert opened == []
    (columns,) = re.findall(r"\\begin\{tabular\}\{@\{\}(\w+)@\{\}\}", text)
    rows = []
    for line in code:
        if line.endswith(r" \\"):
            cells = re.split(r"(?<!\\)&", line.removesuffix(r" \\"))
            spans = [int(n) for cell in cells for n in re.findall(r"\\multicolumn\{(\d+)\}", cell)]
            assert len(cells) + sum(spans) - len(spans) == len(columns)
            rows.append([cell.strip() for cell in cells])
        else:
            assert re.fullmatch(r"\\(toprule|midrule|bottomrule|(begin|end)\{tabular\}.*)", line)
    return rows


@pytest.fixture(scope="module")
def pointda(empty, tmp_path_factory):
    """PointDA-10 with three seeds of PCM in every direction, one of them on five columns only."""
    log_dir = tmp_path_factory.mktemp("logs")
    for row, columns, seeds in (("PCM", 6, (0, 1, 2)), ("DefRec+PCM", 5, (0,))):
        for cell in empty["pointda10"].rows[row][:columns]:
            cfg = compose("train", list(cell.overrides))
            known = {"experiment": cfg.experiment_name, "hash": config_hash(cfg)}
            for seed in seeds:
                known |= {"target": cell.target, "simulated": False}
                write_run(log_dir, **known, seed=seed, accuracy=0.5 + seed / 100)
    return build_table("pointda10", log_dir)


@pytest.mark.parametrize("name", tables.table_names())
def test_every_table_in_every_format(name, empty):
    table = empty[name]
    lines = grid(table)
    assert {len(line) for line in lines} == {len(lines[0])}
    rows = parse_latex(latex(table))
    assert len(rows) >= len(lines)
    assert len(list(csv.DictReader(io.StringIO(csv_text(table))))) == (
        len(table.cells) * len(table.metrics)
    )


def test_how_published_numbers_were_selected(pointda):
    line = next(line for line in grid(pointda) if line[:2] == ["PCFEA", "published"])
    assert line[2:] == [
        "86.6", "58.5", "87.9", "59.7", "85.1", "80.9", "76.5", "target test accuracy"
    ]  # fmt: skip
    assert r"target test accuracy \\" in latex(pointda)
    assert re.search(r"\| PCFEA +\| published \|.*\| target test accuracy +\|", markdown(pointda))
    rows = [r for r in csv.DictReader(io.StringIO(csv_text(pointda))) if r["row"] == "PCFEA"]
    assert [r["paper_mean"] for r in rows] == ["86.6", "58.5", "87.9", "59.7", "85.1", "80.9"]
    assert {r["paper_selected"] for r in rows} == {"target test accuracy"}
    assert {r["paper_source"].split(",")[0] for r in rows} == {"second hand"}
    alone = [r for r in csv.DictReader(io.StringIO(csv_text(pointda))) if r["row"] == "RefRec"]
    assert {r["command"] for r in alone} == {""}  # no run of ours stands beside it


def test_averages(pointda):
    lines = {tuple(line[:2]): line for line in grid(pointda)}
    assert lines["PCM", "ours"][2:] == ["51.0 ± 0.6"] * 7 + ["last epoch"]
    assert lines["DefRec+PCM", "ours"][-2] == ""  # a direction is missing
    assert lines["DefRec+PCM", "published"][-2] == "69.6"
    cells = pointda.rows["PCM"]
    (_, *others) = cells[0].group.finished
    fewer = replace(cells[0], group=replace(cells[0].group, finished=tuple(others)))
    assert replace(pointda, rows={"PCM": (fewer, *cells[1:])}).average("PCM", "accuracy") is None


def test_an_average_of_few_or_failed_seeds_says_so(pointda):
    def of(runs, problems):
        return tuple(
            replace(cell, group=replace(cell.group, finished=cell.group.finished[:runs],
                                        problems=problems))
            for cell in pointda.rows["PCM"]
        )  # fmt: skip

    def shown(cells):
        lines = grid(replace(pointda, rows={"PCM": cells}))
        return next(line for line in lines if line[1] == "ours")[-2]

    assert shown(of(1, ())) == "50.0 (n=1)"
    assert shown(of(2, ("seed 2: unfinished",))) == "50.5 ± 0.5 (n=2) †"
    assert shown((*of(3, ())[:5], *of(3, ("seed 9: unfinished",))[5:])) == "51.0 ± 0.6 †"


@pytest.mark.parametrize("name", ["uda", "pointda10"])
def test_a_published_accuracy_stands_in_no_other_column(empty, name):
    """Papers give accuracy, not balanced accuracy; each column has a name of its own."""
    only = replace(empty[name], metrics=("balanced_accuracy",))
    cells = [cell.paper.text() for cell in only.cells if cell.paper]
    for column in zip(*grid(only), strict=True):
        if set(column[1:]) & set(cells):
            assert column[0] == "paper, accuracy %"
    both = replace(empty[name], metrics=("balanced_accuracy", "accuracy"))
    lines = grid(both)
    for column in zip(*lines, strict=True):
        if "balanced" in column[0]:
            assert not set(column[1:]) & set(cells), column[0]
    names = [head for head in lines[0] if head != "paper"]
    assert len(set(names)) == len(names)
    assert len(parse_latex(latex(both))) == len(lines)


def test_published_averages_agree(empty):
    """As the papers state them; a slip in a number would show here."""
    stated = {
        "pointda10": {
            "source only": 62.2, "DANN": 56.8, "PointDAN": 56.3, "DefRec+PCM": 69.6, "RefRec": 70.5,
            "GAST": 69.5, "GAST+SPST": 73.0, "GAI+SPST": 73.2, "MLSP+SPST": 74.0, "GLRV": 72.7,
            "3DeNet": 72.2, "COT+SPST": 74.4, "Self-Distillation": 75.1, "CLIPoint3D-V": 75.7,
            "PCFEA": 76.5, "PCFEA, last epoch": 75.2,
        },
        "graspnetpc10": {
            "source only": 59.4, "DANN": 65.7, "PointDAN": 74.4, "RS": 62.8, "DefRec+PCM": 73.5,
            "GAST": 65.1, "GAI": 75.8, "GAI+SPST": 84.4, "PCFEA": 87.6, "COT+SPST": 90.4,
            "CLIPoint3D-B": 92.2,
        },
    }  # fmt: skip
    for name, averages in stated.items():
        table = empty[name]
        found = {row: table.published_average(row) for row in table.rows}
        for row, average in averages.items():
            numbers = [cell.paper.mean for cell in table.rows[row]]
            assert sum(numbers) / len(numbers) == pytest.approx(average, abs=0.11), (name, row)
            assert found[row].mean == pytest.approx(average, abs=0.0501), (name, row)


def test_what_is_published_alone_is_never_run(pointda, tmp_path):
    jobs = missing(pointda, [0])
    without_any = {
        "source only", "source only, instance norm", "DANN", "PointDAN", "GAST", "GAST+SPST",
        "MLSP+SPST", "Self-Distillation", "PCFEA", "PCM+QBST", "CPCM", "PCM+CBST",
        "PCM+CRST (LRENT)", "PCM+CRST (MRKLD)", "PCM+SPST", "AdaBN", "TENT", "Twins (ours)",
    }  # fmt: skip
    named = {job.name.rsplit(", ", 2)[0] for job in jobs}
    assert named == without_any | {"DefRec+PCM"}
    assert len(jobs) == 6 * len(without_any) + 1  # and the direction that DefRec+PCM lacks
    assert all(command.startswith("python train.py experiment=") for command in to_run(pointda))
    with pytest.raises(ConfigError, match="has 'PCFEA' in its name") as caught:
        missing(replace(pointda, rows={"PCM": pointda.rows["PCM"]}), [0], ["PCFEA"])
    assert "rows to run are 'PCM'" in str(caught.value)


def test_failed_seeds_are_in_every_format(tmp_path):
    cell = build_table("quickstart", tmp_path).cells[0]
    run_cell(tmp_path, cell, seeds=(0, 1))
    cfg = compose("train", [*cell.overrides, "seed=2"])
    known = {"experiment": cfg.experiment_name, "hash": config_hash(cfg)}
    damaged = write_run(tmp_path, **known, seed=2, accuracy=0.9) / "metrics.json"
    damaged.write_text(damaged.read_text()[:-9])
    begun = tmp_path / cfg.experiment_name / f"seed3-{config_hash(cfg)}"
    begun.mkdir()
    (begun / "started.json").write_text("{}")
    other = build_table("quickstart", tmp_path).cells[1]
    cfg = compose("train", [*other.overrides, "seed=0"])
    (tmp_path / cfg.experiment_name / f"seed0-{config_hash(cfg)}").mkdir(parents=True)
    table = build_table("quickstart", tmp_path)
    assert grid(table)[2][1:3] == ["not finished †"] * 2
    assert other.command in to_run(table)
    for name, write in FORMATS.items():
        text = write(table)
        assert re.search(r"seed 2: .*metrics\.json is damaged", text), name
        assert "seed 3: unfinished" in text, name
        assert "50.5" in text, name  # the mean of the two that finished, and of them alone
        if name != "csv":
            assert re.search(r"50\.5 .* 0\.5 \(n=2\) (†|\$\\dagger\$)", text), name
    row = next(csv.DictReader(io.StringIO(csv_text(table))))
    assert (row["row"], row["n"], row["seeds"]) == (cell.row, "2", "0 1")
    assert row["problems"].count("; seed 3: ") == 1
    assert "dagger" in parse_latex(latex(table))[-1][0]  # in the tabular, not only in a comment


def test_simulated_targets_are_marked_in_every_format(empty, tmp_path):
    table = build_table("uda", tmp_path, target="kinectsim10")
    assert grid(table)[0][1:] == [
        "M → kinectsim10 (simulated), accuracy %", "S → kinectsim10 (simulated), accuracy %"
    ]  # fmt: skip
    for name, write in FORMATS.items():
        text = write(table)
        assert not re.search(r"(→|\$\\rightarrow\$) D\b", text), name
        if name != "csv":
            assert "SIMULATED target: kinectsim10" in text, name
    rows = parse_latex(latex(table))
    assert "(simulated)" in rows[0][1]
    assert "SIMULATED target: kinectsim10" in rows[-1][0]
    for row in csv.DictReader(io.StringIO(csv_text(table))):
        assert (row["target"], row["simulated"]) == ("kinectsim10", "true")
    real = empty["uda"]
    assert {r["simulated"] for r in csv.DictReader(io.StringIO(csv_text(real)))} == {"false"}
    with pytest.raises(ConfigError, match="pointda10 have several targets; leave it out"):
        build_table("pointda10", tmp_path, target="kinectsim10")
    assert all("SIMULATED" not in write(real) for write in FORMATS.values())


def test_what_stands_behind_each_number(tmp_path):
    cells = build_table("quickstart", tmp_path).cells
    run_cell(tmp_path, cells[0], seeds=(0,), times=Times(seconds=90.0, core_seconds=80.0))
    run_cell(tmp_path, cells[0], seeds=(1,), times=Times(seconds=120.04))
    run_cell(tmp_path, cells[1], seeds=(5,))
    table = build_table("quickstart", tmp_path)
    header, first, second = details(table)
    known = dict(zip(header, first, strict=True))
    assert known["mean ± SEM %"] == "50.5 ± 0.5"
    assert (known["n"], known["seeds"], known["time a run"]) == ("2", "0, 1", "1.5 to 2.0 min")
    assert known["target"] == "kinectsim10 (simulated)"
    assert (known["teacher selected by"], known["student selected by"]) == ("source_val", "last")
    assert known["core time"] == "1.3 min"  # of the run that knows it
    other = dict(zip(header, second, strict=True))
    assert (other["time a run"], other["core time"]) == ("1.0 min", "1.5 min")
    assert "; ".join(first) in latex(table)
    assert "all of its starts together" in markdown(table)
    row = next(csv.DictReader(io.StringIO(csv_text(table))))
    assert (row["seconds"], row["core_seconds"]) == ("90 120.04", "80 ")


words = st.text(st.characters(exclude_categories=["C", "Z"], max_codepoint=127), max_size=12)


@given(row=words.filter(bool), column=words.filter(bool), selected=words)
def test_any_names_are_escaped(row, column, selected):
    assert latex_text("a_b & 5 % → {x}") == r"a\_b \& 5 \% $\rightarrow$ \{x\}"
    cell = Cell(row, column, (), Published(50.0, None, selected))
    for layout in (False, True):
        rows = {row: (cell,)}
        table = Table("t", row, (), ("accuracy",), (column,), rows, benchmark=layout)
        assert len(parse_latex(latex(table))) == 2
        assert next(csv.DictReader(io.StringIO(csv_text(table))))["row"] == row
        assert (
            len({line.replace(r"\|", "").count("|") for line in markdown(table).splitlines()[2:5]})
            == 1
        )
