"""Atomic writes: old or new, never half; also under kill -9 and on a full disk."""

import errno
import os
import signal
import stat
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest

from qs3.errors import Qs3Error
from qs3.utils import files


def test_text_and_json(tmp_path):
    files.write_text(tmp_path / "a" / "b.txt", "grüße\n")
    assert (tmp_path / "a" / "b.txt").read_bytes() == "grüße\n".encode()
    files.write_json(tmp_path / "m.json", 1)
    with pytest.raises(ValueError, match="not JSON compliant"):
        files.write_json(tmp_path / "m.json", float("nan"))
    assert (tmp_path / "m.json").read_text() == "1\n"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "m.json"]


def test_failure_in_the_block_keeps_the_old_file_and_no_leftover(tmp_path):
    path = tmp_path / "x.txt"
    files.write_text(path, "old")

    def fail():
        with files.atomic_path(path) as temporary:
            assert temporary.parent == tmp_path
            assert temporary.suffix == ".txt"
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_written_is_an_error_and_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "x.txt"
    files.write_text(path, "old")

    def full(*args, **more):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(Qs3Error, match=r"cannot write .*x\.txt: .*No space left"):
        files.write_text(path, "new")
    monkeypatch.undo()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(Qs3Error):
        files.write_text(path / "y.txt", "")  # a file in the way of a folder
    monkeypatch.setattr(tempfile, "TemporaryFile", full)  # as /sys does, whatever permissions say
    with pytest.raises(Qs3Error):
        files.make_folder(tmp_path)


def test_permissions_follow_the_umask(tmp_path):
    old = os.umask(0o027)
    try:
        files.write_text(tmp_path / "x", "")
    finally:
        os.umask(old)
    assert stat.S_IMODE((tmp_path / "x").stat().st_mode) == 0o640


def test_leftovers_are_found_by_name_and_nothing_else_is_touched(tmp_path):
    for name in (".a.npy.x1.tmp.npy", ".b.csv.x2.tmp.csv", "a.npy", ".hidden", ".x.lock"):
        (tmp_path / name).write_text("")
    files.remove_leftovers(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [".hidden", ".x.lock", "a.npy"]
    files.remove_leftovers(tmp_path / "absent")


def test_kill_9_leaves_old_or_new(tmp_path):
    """A writer alternating between two contents is killed at many instants."""
    code = """
import sys
from qs3.utils.files import locked, owned, write_bytes
n = 0
while True:
    n += 1
    write_bytes(sys.argv[1], bytes([n % 2]) * 300_000)
    if n == 1:
        print("go", flush=True)
"""
    path = tmp_path / "x.bin"
    for attempt in range(8):
        process = subprocess.Popen(
            [sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, cwd=Path.cwd()
        )
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(0.003 * attempt + 0.001)
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
        data = path.read_bytes()
        assert data in (bytes(300_000), b"\1" * 300_000)
    files.remove_leftovers(tmp_path)
    assert list(tmp_path.iterdir()) == [path]


def test_lock_excludes_and_is_released(tmp_path):
    order = []

    def second():
        with files.locked(tmp_path / "l"):
            order.append("second")

    with files.locked(tmp_path / "l"):
        thread = threading.Thread(target=second)
        thread.start()
        time.sleep(0.05)
        order.append("first")
    thread.join(5)
    assert order == ["first", "second"]


def test_a_lock_that_is_held_is_refused_where_it_is_not_waited_for(tmp_path):
    path = tmp_path / "folder" / ".lock"
    with files.locked(path):
        with pytest.raises(Qs3Error, match=r"^busy$"), files.locked(path, "busy"):
            pass
        with (
            pytest.raises(Qs3Error, match="another process is training in"),
            files.owned(path.parent),
        ):
            pass
    with files.locked(path, "busy"):
        assert path.is_file()
