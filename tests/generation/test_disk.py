"""A disk that is full, a folder that cannot be used: a clear message, and nothing is lost."""

import contextlib
import os
import resource
import subprocess

import pytest

from qs3.errors import ConfigError
from qs3.generation.command import generate
from tests.generation.generating import ROOT, command, config, fingerprint


def run(arguments, largest_file=None):
    def limit():
        if largest_file:
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))

    return subprocess.run(
        arguments, cwd=ROOT, capture_output=True, text=True, timeout=300, preexec_fn=limit,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("limit", "done", "more"),
    [
        pytest.param(20_000, "0 of 9", [], id="parts"),
        pytest.param(420_000, "18 of 18", ["scans=2"], id="dataset"),
    ],
)
def test_files_that_cannot_grow_stop_the_run_and_a_resume_completes_it(
    meshes, tmp_path, limit, done, more
):
    """With a limit on the size of files, a write fails as it does on a full disk."""
    arguments = command(tmp_path, meshes, "workers=1", *more)
    stopped = run(arguments, limit)
    assert stopped.returncode != 0
    assert "the disk is full" in stopped.stderr
    assert str(tmp_path / "specklenet10") in stopped.stderr
    assert f"{done} objects are done and kept" in stopped.stderr
    assert "run the same command again" in stopped.stderr
    assert "Traceback" not in stopped.stderr
    assert not (tmp_path / "specklenet10" / "meta.yaml").exists()
    again = run(arguments)
    assert again.returncode == 0, again.stderr
    generate(config(tmp_path / "whole", meshes, "workers=0", *more))
    whole = fingerprint(tmp_path / "whole" / "specklenet10")
    assert fingerprint(tmp_path / "specklenet10") == whole


@contextlib.contextmanager
def small_disk(path, size):
    path.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(path)], capture_output=True
    )
    if mounted.returncode:
        pytest.skip("a small disk cannot be mounted here")
    try:
        yield path
    finally:
        subprocess.run(["umount", str(path)], check=True)


@pytest.mark.slow
@pytest.mark.parametrize("keep", [[], ["keep_views=true"]], ids=["parts", "views"])
def test_a_real_full_disk(finished, meshes, tmp_path, keep):
    with small_disk(tmp_path / "disk", "400k") as disk:
        arguments = command(disk, meshes, "workers=2", *keep)
        stopped = run(arguments)
        assert stopped.returncode != 0
        assert "the disk is full" in stopped.stderr
        assert "No space left" in stopped.stderr
        assert "failed:" not in stopped.stdout  # no object is blamed for it
        assert not (disk / "specklenet10" / "meta.yaml").exists()
        # Room is made, and the same command continues.
        subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)
        again = run(arguments)
        assert again.returncode == 0, again.stderr
        if not keep:
            assert "continuing: " in again.stdout
            assert fingerprint(disk / "specklenet10") == fingerprint(finished[0])
        else:
            assert len(list((disk / "specklenet10").rglob("view_*.npz"))) == 18
            assert not list((disk / "specklenet10").rglob(".*tmp*"))
            made = fingerprint(disk / "specklenet10")
            assert made["points.npy"] == fingerprint(finished[0])["points.npy"]


@pytest.mark.parametrize(
    ("where", "words"),
    [
        ("{}/a_file", "cannot make the folder"),
        ("{}/a_file/below", "cannot make the folder"),
        ("/proc/nowhere", "cannot make the folder"),
        ("{}/x\0y", "null byte"),
        ("{}/" + "n" * 300, "cannot make the folder"),
    ],
)
def test_a_data_folder_that_cannot_be_used_is_named(meshes, tmp_path, where, words):
    (tmp_path / "a_file").write_text("in the way")
    cfg = config("x", meshes, "workers=0")
    cfg.paths.data_dir = where.format(tmp_path)
    with pytest.raises(ConfigError, match=words) as error:
        generate(cfg)
    assert "paths.data_dir=" in str(error.value)


def test_no_data_folder_at_all(meshes):
    cfg = config("x", meshes, "workers=0")
    for nothing in (None, "", " "):
        cfg.paths.data_dir = nothing
        with pytest.raises(ConfigError, match=r"paths\.data_dir must name a folder"):
            generate(cfg)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission(meshes, tmp_path):
    (tmp_path / "mine").mkdir(mode=0o500)
    with pytest.raises(ConfigError, match=r"paths\.data_dir=.*permission"):
        generate(config(tmp_path / "mine", meshes, "workers=0"))


def test_failures_are_listed_and_strict_exits_with_an_error(meshes, tmp_path):
    broken = tmp_path / "meshes"
    for path in meshes.rglob("*.ply"):
        copy = broken / path.relative_to(meshes)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(path.read_bytes() if "lamp" in path.name else b"")
    done = run(command(tmp_path, broken, "workers=1"))
    assert done.returncode == 0
    assert done.stdout.count("failed: ") == 5
    assert f"failed: chair/train/chair_0: {broken}/chair/train/chair_0.ply: is empty" in done.stdout
    assert f"and 1 more: {tmp_path}/specklenet10/manifest.csv says why" in done.stdout
    assert [line.split()[1:] for line in done.stdout.splitlines() if " chair  " in line] == [
        ["chair", "0", "0", "3"]
    ]
    strict = run(command(tmp_path, broken, "workers=1", "strict=true"))  # the dataset is there
    assert strict.returncode != 0
    assert "6 of 9 objects failed" in strict.stderr
    for path in broken.rglob("*.ply"):
        path.write_bytes(b"")
    none = run(command(tmp_path, broken, "workers=1", "force=true"))
    assert none.returncode != 0
    assert "all 9 objects failed" in none.stderr
