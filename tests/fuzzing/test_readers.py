"""No reader is left out, and nothing but errors for people leaves one."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.fuzzing.engine import Found
from tests.fuzzing.readers import READERS

ROOT = Path(__file__).parents[2]
SECONDS = 15

OPENS = re.compile(
    r"(?<![\w.])(?<!def )open\(|np\.load\(|torch\.load\(|h5py\.File\(|json\.loads?\(|imread\("
    r"|\.read_text\(|read_whole\(|\.read_bytes\(|imdecode\(|Image\.open\(|yaml\.(safe_)?load\(|ZipFile\("
    r"|csv\.(Dict)?[rR]eader\(|tarfile\.open\(|loadmat\(|np\.frombuffer\(|pickle\.loads?\("
)

OWN = {
    "config/hydra.py": "comments of our own configs",
    "config/preset_base.py": "the defaults of a preset that the user names, which Hydra reads, too",
    "data/download/catalogue.py": "a file of the package",
    "data/inspection/gravity.py": "a file of the package",
    "data/place.py": "the names in a zip; what is damaged is called no archive",
    "data/viewer/page.py": "files of the package",
    "methods/own.py": "Python that the user names, to be run",
    "models/features.py": "a net that the user names, parsed and run by onnxruntime",
    "report/runs/page.py": "pictures that were drawn before, taken over as bytes",
    "report/tables/keeping.py": "bytes that are compared",
    "report/tables/saving.py": "bytes that are compared",
    "sensors/bench/comparison.py": "the bench's own cache",
    "sensors/renderers/blender.py": "what this process has just said",
    "sensors/renderers/exr.py": "what Blender has just written",
    "sensors/renderers/llvm.py": "what a child has just said",
    "sweeps/listed_jobs.py": "what the parent has just written",
    "tools/large_jobs.py": "sizes; costs.csv is read whole by utils/memory.py, and numbers parsed",
    "training/code.py": "Python that trains; its bytes are hashed, and parsed if they can be",
    "utils/files.py": "bytes that are hashed",
    "utils/locks.py": "nothing is read",
    "utils/memory.py": "bytes, for those that read them",
    "utils/pool.py": "what processes of our own send each other",
    "utils/seeding.py": "a hash",
    "utils/threads.py": "/proc/stat, the kernel's",
    "utils/processor_time.py": "/proc, the kernel's",
    "cluster/slurm_arrays.py": "journals of jobs of our own",
    "generation/code_fingerprint.py": "this program's own files",
    "generation/object_parts.py": "a hash, which is compared and not read",
    "generation/travel.py": "bytes of meshes, for the reader of meshes",
}
"""Modules that open what nobody else has made, or what the user wants to be run."""


def test_every_module_that_opens_files_is_tried_or_has_a_reason():
    package = ROOT / "qs3"
    opening = {
        path.relative_to(package).as_posix()
        for path in package.rglob("*.py")
        if OPENS.search(path.read_text())
    }
    covered = {module for reader in READERS for module in reader.covers}
    assert opening - covered == set(OWN)
    assert all((package / module).is_file() for module in covered)
    names = [reader.name for reader in READERS]
    assert len({*names}) == len(names)


@pytest.mark.slow
@pytest.mark.parametrize("name", [reader.name for reader in READERS])
def test_only_errors_for_people_leave_a_reader(name):
    words = [sys.executable, "-m", "tests.fuzzing.run", f"readers={name}", f"seconds={SECONDS}"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    environment.pop("QS3_CHECK_SHAPES", None)
    done = subprocess.run(
        [*words, "json=true"], cwd=ROOT, env=environment, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.stdout, done.stderr[-3000:]
    said = json.loads(done.stdout.splitlines()[-1])[name]
    print({key: value for key, value in said.items() if key != "found"})  # noqa: T201
    assert [str(Found(**one)) for one in said["found"]] == []
    assert said["accepted"] > 0  # the seeds are whole files
    assert said["executions"] > 20


@pytest.mark.slow
def test_files_of_4_gb_are_told_or_read_in_little_memory():
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    words = [sys.executable, "-m", "tests.fuzzing.large"]
    done = subprocess.run(
        words, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert (done.stdout, done.returncode) == ("", 0), done.stderr[-2000:]
