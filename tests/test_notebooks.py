"""The notebooks: clean in git, and they run from the top to the end and show what they say."""

from __future__ import annotations

import base64
import os
import re
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

import nbformat
import pytest

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "notebooks"
NAMES = sorted(path.stem for path in FOLDER.glob("*.ipynb"))


def read(name):
    return nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)


def run(name, folder):
    """The notebook with its outputs; an error in a cell is an error here."""
    # Not pytest's folder: the path of a socket must be short.
    with tempfile.TemporaryDirectory(prefix="qs3-") as scratch:
        out = Path(scratch, "out.ipynb")
        words = [ROOT / "tests" / "run_notebook.py", FOLDER / f"{name}.ipynb", out, folder, scratch]
        env = {**os.environ, "TMPDIR": scratch}
        done = subprocess.run(
            [sys.executable, *map(str, words)], env=env, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        left = {path.name for path in Path(scratch).iterdir()} - {"out.ipynb"}
        assert not [path for path in left if path.startswith("qs3-notebook")]  # cleaned up
        return nbformat.read(out, as_version=4)


def outputs(notebook, kind):
    return [out for cell in notebook.cells for out in cell.get("outputs", []) if kind(out)]


def printed(notebook, stream="stdout"):
    return "\n".join(
        out.text
        for out in outputs(notebook, lambda o: o.output_type == "stream" and o.name == stream)
    )


def images(notebook):
    shown = outputs(notebook, lambda o: "image/png" in o.get("data", {}))
    return [base64.b64decode(out.data["image/png"]) for out in shown]


@pytest.mark.parametrize("name", NAMES)
def test_clean_in_git(name):
    notebook = read(name)
    nbformat.validate(notebook)
    assert notebook.metadata.language_info == {"name": "python"}  # no version of one's own Python
    for cell in (cell for cell in notebook.cells if cell.cell_type == "code"):
        assert (cell.outputs, cell.execution_count, cell.metadata) == ([], None, {})


@pytest.mark.slow
def test_01_sensor():
    done = run("01_sensor", FOLDER)
    assert len(images(done)) == 9
    assert all(len(image) > 5_000 for image in images(done))
    text = printed(done)
    assert "5 views" in text
    z = float(re.search(r"px = (\d\.\d+) m", text)[1])
    assert 2.0 < z < 6.0
    within = [float(x) for x in re.findall(r"half of the points within (\d+\.\d+) mm", text)]
    assert within[0] > 1.0  # speckle
    assert within[1] < 3.0  # surface samples, by samples of the surface
    assert printed(done, "stderr") == ""


@pytest.mark.slow
def test_02_qbst():
    done = run("02_qbst", ROOT)  # from the root as well as from notebooks/
    assert len(images(done)) == 2
    text = printed(done)
    found = re.findall(r"teacher (\d+\.\d)%, student from scratch (\d+\.\d)%", text)
    (teacher, qbst), (_, every) = [[float(x) for x in pair] for pair in found]
    assert qbst > teacher + 5  # what the notebook says of the turned target
    assert qbst > every + 5
    balanced = [float(x) for x in re.findall(r"in the last round, student (\d+\.\d)%", text)]
    assert balanced[0] < balanced[1]  # and of the imbalanced one
    assert "same selection: True" in text
    mu = [float(x) for x in re.search(r"mu_k  +(.*)", text.split("QBST    ")[1])[1].split()]
    counts = [int(x) for x in re.search(r"L_k  +(.*)", text.split("QBST    ")[1])[1].split()]
    assert mu == pytest.approx([1 - n / sum(counts) for n in counts], abs=1e-3)


@pytest.mark.slow
def test_03_results():
    done = run("03_results", FOLDER)
    assert images(done)  # the curves
    text = printed(done)
    assert "4 runs, 0 still missing" in text
    assert "minus mu = 1" in text
    assert "more meshes" in text or "seeds" in text
    (table,) = [
        out.data["text/markdown"]
        for out in outputs(done, lambda o: "text/markdown" in o.get("data", {}))
    ]
    for row in ("source only", "QBST", "mu = 1"):
        assert re.search(rf"\| {row} +\| [\d.]+ ± [\d.]+ \(n=2\)", table)
    assert "160 test clouds" in text


@pytest.mark.slow
def test_04_pyg():
    done = run("04_pyg", FOLDER)
    text = printed(done)
    assert "18 clouds of 512 points" in text
    assert "pos=[2304, 3]" in text  # nine clouds of 256 points
    assert float(re.search(r"training (\d+\.\d)%", text)[1]) > 80
    assert "the same bytes: True" in text
    assert "the same labels: True" in text
    assert printed(done, "stderr") == ""


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mujoco") is None, reason="mujoco is an extra")
def test_05_sense():
    done = run("05_sense", FOLDER)
    assert len(images(done)) == 2
    text = printed(done)
    found = re.findall(r"(\w+) +measures +(\d+)%, half of it within (\d+\.\d) mm", text)
    room, gripper = ({name: (int(share), float(mm)) for name, share, mm in part}
                     for part in (found[:4], found[4:]))  # fmt: skip
    assert len(room) == len(gripper) == 4
    assert all(share > 60 and mm < 10 for share, mm in room.values())
    assert gripper["kinect_v1"][0] < 40 < 80 < gripper["realsense_d435"][0]
    assert "the same bytes: True" in text
    noise = [float(mm) for mm in re.findall(r"noise (\d+\.\d) mm", text)]
    assert 2.5 < noise[1] / noise[0] < 6  # as the square of the distance
    assert all(float(r) > 0.8 for r in re.findall(r"correlate by (\d\.\d+)", text))
