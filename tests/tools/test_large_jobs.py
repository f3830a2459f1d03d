"""`qs3 plan`: what it says of a job whose course is known."""

import csv
import re

import numpy as np
import pytest

from qs3.data.store import ManifestRow, write_pointset
from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.tools.large_jobs import PLAN, measured


def small(folder, seconds, memory_mb=500.0, views=()):
    """A dataset as generate.py leaves it: 1,000 points and their twin, 24 kB an object."""
    rows = [ManifestRow(f"bed/{i}", "bed", "train") for i in range(len(seconds))]
    points = np.zeros((len(rows), 1000, 3), dtype="f4")
    write_pointset(
        folder,
        name="small",
        classes=["bed"],
        arrays={"points": points, "points_clean": points},
        rows=rows,
        meta={},
    )
    lines = [f"bed/{i},{s:g},{memory_mb:g}" for i, s in enumerate(seconds)]
    (folder / "costs.csv").write_text("\n".join(["id,seconds,peak_memory_mb", *lines, ""]))
    for i, size in enumerate(views):
        place = folder / "views" / str(i)
        place.mkdir(parents=True)
        (place / "view_0.npz").write_bytes(bytes(size))
    return folder


def said(capsys, *words):
    assert PLAN([str(word) for word in words]) == 0
    return capsys.readouterr().out


def test_equal_objects_on_sound_nodes_take_what_arithmetic_says(tmp_path, capsys):
    """36 s each, 4,000 of them: 40 core-hours, by 2, 4 and 8 workers; and a start of 36 s."""
    data = small(tmp_path / "d", [36.0] * 40, views=[10_000] * 40)
    out = tmp_path / "plan.csv"
    text = said(
        capsys, f"data={data}", "objects=4000", "nodes=1,2,4", "workers=2", "start_s=36",
        "price=3", "trials=3", f"out={out}",
    )  # fmt: skip
    rows = list(csv.DictReader(out.read_text().splitlines()))
    assert [float(row["hours"]) for row in rows] == pytest.approx([20.01, 10.01, 5.01], rel=2e-3)
    assert [float(row["cost"]) for row in rows] == pytest.approx([60.03] * 3, rel=2e-3)
    assert {(row["hours"] == row["95 %"], row["lost %"], row["failures"]) for row in rows} == {
        (True, "0.0", "0.0")
    }
    assert "4,000 objects: 40 core-hours; 0.096 GB when it is done, 0.204 GB on the way" in text
    assert "0.04 GB of views" in text
    assert "a node with 2 workers: 1 GB of memory" in text
    assert "measured on 40 objects: 36 s in the middle, 36 on average, at most 36; " in text
    assert "at most 500 MB a process" in text


def test_an_array_job_starts_anew_and_a_faster_core_is_faster(tmp_path, capsys):
    data = small(tmp_path / "d", [20.0] * 30)
    common = (f"data={data}", "objects=1800", "nodes=1", "workers=1", "start_s=100", "trials=1")

    def hours(*words):
        return float(re.search(r"^ *1 +([\d.]+)", said(capsys, *common, *words), re.M)[1])

    assert hours("engine=ray") == pytest.approx(10.03, abs=0.1)
    assert hours("engine=slurm", "tasks_per_job=18") == pytest.approx(
        10 + 100 * 100 / 3600, abs=0.1
    )
    assert hours("engine=local", "speed=2") == pytest.approx(5.03, abs=0.05)


def test_failures_and_slow_nodes_cost_time(tmp_path, capsys):
    data = small(tmp_path / "d", np.linspace(30, 90, 60))
    common = (f"data={data}", "objects=3000", "nodes=5", "workers=2", "trials=5")
    out = tmp_path / "plan.csv"
    found = []
    for words in ((), ("life_h=0.5",), ("slow_share=0.5", "slow_times=4")):
        said(capsys, *common, *words, f"out={out}")
        found += csv.DictReader(out.read_text().splitlines())
    sound, failing, slow = found
    assert float(sound["hours"]) < float(failing["hours"])
    assert float(sound["hours"]) < 1.2 * float(slow["hours"])
    assert float(failing["lost %"]) > float(sound["lost %"]) == 0.0
    assert float(failing["failures"]) > 10
    assert float(slow["95 %"]) > float(slow["hours"])


def test_what_does_not_fit_and_what_is_too_little_is_said(tmp_path, capsys):
    data = small(tmp_path / "d", [1.0] * 5, memory_mb=2000)
    text = said(capsys, f"data={data}", "objects=10", "nodes=1", "node_gb=8", "trials=1")
    assert "node_gb=8 is not enough for them: workers=4" in text
    assert "of 5 objects the longest may be missing: measure 30 or more" in text
    text = said(capsys, f"data={data}", "objects=10", "nodes=1", "node_gb=32", "trials=1")
    assert "not enough" not in text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "cannot be read"),
        ("id,seconds\na,1", "cannot be read"),
        ("id,seconds,peak_memory_mb\n", "is not what generate.py writes"),
        ("id,seconds,peak_memory_mb\na,-1,5", "is not what generate.py writes"),
        ("id,seconds,peak_memory_mb\na,nan,5", "is not what generate.py writes"),
        ("id,seconds,peak_memory_mb\na,one,5", "cannot be read"),
        ("name,time,memory\na,1,5", "is not what generate.py writes"),
        ("id,seconds,peak_memory_mb\na,1,5\n\xff".encode("latin1"), "cannot be read"),
    ],
)
def test_a_damaged_file_is_named(tmp_path, text, message):
    data = small(tmp_path / "d", [1.0])
    (data / "costs.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(DataError, match=rf"costs\.csv {message}"):
        measured(data)


def test_what_is_missing_is_said(tmp_path):
    with pytest.raises(MissingDataError, match="no dataset folder"):
        measured(tmp_path / "d")
    data = small(tmp_path / "d", [1.0])
    (data / "costs.csv").unlink()
    with pytest.raises(MissingDataError, match=r"has no costs\.csv"):
        measured(data)
    with pytest.raises(ConfigError, match="speed must be above 0"):
        PLAN([f"data={small(tmp_path / 'e', [1.0])}", "objects=1", "speed=0"])


def test_so_many_objects_that_no_simulation_ends_are_refused(tmp_path, capsys):
    """A hundred million ran for hours without a word, and took 10 GB."""
    data = small(tmp_path / "d", [3600.0] * 30)
    with pytest.raises(ConfigError, match="at most 10,000,000 are simulated"):
        PLAN([f"data={data}", "objects=100000000"])
    text = said(capsys, f"data={data}", "objects=20000", "nodes=2", "workers=1", "trials=1")
    assert "20,000 objects: 20000 core-hours; 0.48 GB" in text
    assert re.search(r"^2 +10000 +10000 +20000 ", text, re.M)  # none of them as 1e+04
