"""What a table lacks, and one real training of it."""

import shlex

import pytest

from qs3.errors import ConfigError
from qs3.report.running import missing
from qs3.report.spec import chosen
from qs3.report.table import build_table
from tests.report.filled import run_cell
from tests.running import main
from tests.training.toy import overrides, write_toy


@pytest.mark.slow
def test_only_what_is_missing_is_run(tmp_path):
    table = build_table("cad10", tmp_path)
    cells = {cell.row: cell for cell in table.cells}
    run_cell(tmp_path, cells["DANN"], seeds=(0, 2))
    table = build_table("cad10", tmp_path)
    assert [job.name for job in missing(table, rows=["dann"])] == ["DANN, seed 1"]
    assert [job.name for job in missing(table, [0], ["adabn", "dann"])] == ["AdaBN, seed 0"]
    jobs = missing(table)
    assert len({job.overrides for job in jobs}) == len(jobs)
    with pytest.raises(ConfigError, match="mars"):
        missing(table, rows=["mars"])


def test_long_runs_begin_first(tmp_path):
    table = build_table("quickstart", tmp_path)
    names = [job.name for job in missing(table, [0, 1])]
    assert names[:2] == [
        f"QS3 = PCM + QBST as released, speckle scans, seed {seed}" for seed in (0, 1)
    ]
    assert len(names) == 8  # PCM's row shows a part of QS3's runs


def test_names():
    names = ["PCM", "DefRec+PCM", "DANN", "PCM + QBST", "S → D"]
    assert chosen(names, ["pcm"]) == ["PCM"]  # the row of that name, not all that contain it
    assert chosen(names, ["qbst", "dann"]) == ["DANN", "PCM + QBST"]
    assert chosen(names, ["s->d"]) == ["S → D"]
    assert chosen(names, []) == names


def test_what_is_refused(tmp_path, capsys):
    words = ["report", "train", "table=cad10", f"log_dir={tmp_path}"]
    for more in (["launcher=dask"], ["hydra.partition=gpu"], ["jobs=0"]):
        assert main([*words, *more]) == 1
        assert "ConfigError" in capsys.readouterr().err


def test_a_table_is_trained_kept_and_printed(tmp_path, capfd):
    """Two cells of a table of one's own, by the commands; a failure stops no other one."""
    write_toy(tmp_path / "data")
    toy = [w for w in overrides(tmp_path)[1:] if not w.startswith(("paths.", "selftraining."))]
    run = "run: experiment=quickstart method=source_only selftraining=none"
    own = (
        "title: Own\nmetrics: [accuracy]\ncolumns: [T]\nrows:\n"
        f"  - {{name: plain, {run}}}\n  - {{name: teacher, take: warmup, {run}}}\n"
    )
    bad = f"  - {{name: bad, first: true, {run} protocol.smoothing=1}}\n"
    (tmp_path / "own.yaml").write_text(own + bad)
    words = [f"table={tmp_path / 'own.yaml'}", f"log_dir={tmp_path / 'logs'}"]
    words += [f"data_dir={tmp_path / 'data'}", f"overrides={shlex.join(toy)}"]
    assert main(["report", "train", *words, "seeds=0"]) == 1
    assert "2 runs to do" in (said := capfd.readouterr().out)
    assert "1 of 2 jobs failed" in said
    (tmp_path / "own.yaml").write_text(own)
    kept = tmp_path / "own.csv.gz"
    assert main(["report", "keep", *words, f"into={kept}"]) == 0
    first = kept.read_bytes()
    assert main(["report", "keep", *words, f"into={kept}", f"kept={kept}"]) == 0
    assert kept.read_bytes() == first
    assert main(["report", "train", *words, "seeds=0"]) == 0
    assert "0 runs to do" in capfd.readouterr().out
    pages = []
    for more in (words, [words[0], f"kept={kept}", f"log_dir={tmp_path / 'none'}"]):
        assert main(["report", *more, f"out={tmp_path / 'out'}"]) == 0
        capfd.readouterr()
        pages.append((tmp_path / "out" / "own.md").read_text().partition("Not run")[0])
    assert pages[0] == pages[1]
    assert "| teacher" in pages[0]
