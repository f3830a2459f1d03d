"""One file over real sockets: whole, broken off, exchanged, refused."""

import base64
import hashlib
import itertools
import json
import multiprocessing
import os
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from qs3.data.download import transfer
from qs3.data.download.answers import Answer
from qs3.data.download.transfer import Patience, Wanted, fetch
from qs3.errors import ConfigError, DataError, Qs3Error
from tests.data.download.server import File

DATA = np.random.default_rng(0).bytes(3_000_000)
OTHER = np.random.default_rng(1).bytes(3_000_000)
FAST = Patience(tries=4, wait_s=0.01, longest_wait_s=0.05, timeout_s=5.0)


def wanted(site, folder, **more):
    return Wanted(f"{site.address}/a.zip", folder / "a.zip", **more)


def names(folder):
    return sorted(path.name for path in folder.iterdir() if not path.name.endswith(".lock"))


def test_whole(site, tmp_path):
    site.files["/a.zip"] = File(DATA)
    told = []
    receipt = fetch(wanted(site, tmp_path), FAST, lambda done, total: told.append((done, total)))
    assert (tmp_path / "a.zip").read_bytes() == DATA
    assert receipt.size == len(DATA)
    assert receipt.sha256 == hashlib.sha256(DATA).hexdigest()
    assert json.loads((tmp_path / "a.zip.json").read_text())["etag"] == '"one"'
    assert names(tmp_path) == ["a.zip", "a.zip.json"]
    assert told[0] == (0, len(DATA))
    assert told[-1] == (len(DATA), len(DATA))
    assert all(a[0] <= b[0] for a, b in itertools.pairwise(told))


def test_a_second_run_asks_nothing_and_checks_the_bytes(site, tmp_path):
    site.files["/a.zip"] = File(DATA)
    first = fetch(wanted(site, tmp_path), FAST)
    assert fetch(wanted(site, tmp_path), FAST) == first
    assert len(site.requests) == 1
    damaged = bytearray(DATA)
    damaged[1_000_000] ^= 1
    (tmp_path / "a.zip").write_bytes(damaged)
    with pytest.raises(DataError, match=r"a\.zip has the SHA-256 .* delete it and a\.zip\.json"):
        fetch(wanted(site, tmp_path), FAST)
    (tmp_path / "a.zip").write_bytes(DATA[:-1])
    with pytest.raises(DataError, match="has 2999999 bytes, expected 3000000"):
        fetch(wanted(site, tmp_path), FAST)


@pytest.mark.parametrize("reset", [False, True])
def test_drops_are_resumed_where_they_broke_off(site, tmp_path, reset):
    site.files["/a.zip"] = File(DATA, drops=[1_000_000, 700_000], reset=reset)
    fetch(wanted(site, tmp_path), FAST)
    assert (tmp_path / "a.zip").read_bytes() == DATA
    if not reset:  # a reset may swallow bytes that were on their way
        assert site.ranges("/a.zip") == [None, "bytes=1000000-", "bytes=1700000-"]
        assert site.requests[1][1]["If-Range"] == '"one"'


def test_chunked_answers_that_break_off_are_noticed(site, tmp_path):
    site.files["/a.zip"] = File(DATA, chunked=True, drops=[1_000_000])
    fetch(wanted(site, tmp_path), FAST)
    assert (tmp_path / "a.zip").read_bytes() == DATA


@pytest.mark.slow
@settings(
    deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    drops=st.lists(st.integers(0, 60_000), max_size=6),
    ranges=st.booleans(),
    etag=st.sampled_from(['"one"', 'W/"one"', None]),
    chunked=st.booleans(),
)
def test_any_series_of_drops_gives_the_file(site, tmp_path, drops, ranges, etag, chunked):
    shutil.rmtree(tmp_path)
    content = DATA[:100_000]
    site.files["/a.zip"] = File(content, etag, ranges, drops=list(drops), chunked=chunked)
    fetch(wanted(site, tmp_path), Patience(tries=9, wait_s=0, longest_wait_s=0, timeout_s=5))
    assert (tmp_path / "a.zip").read_bytes() == content


def test_a_server_that_ignores_ranges_starts_over(site, tmp_path, caplog):
    site.files["/a.zip"] = File(DATA, ranges=False, drops=[1_000_000])
    fetch(wanted(site, tmp_path), FAST)
    assert (tmp_path / "a.zip").read_bytes() == DATA
    assert "starting over" in caplog.text


def test_a_server_that_begins_elsewhere_is_noticed(site, tmp_path, caplog):
    site.files["/a.zip"] = File(DATA, drops=[1_000_000], shift=-1000)
    fetch(wanted(site, tmp_path), FAST)
    assert (tmp_path / "a.zip").read_bytes() == DATA
    assert "began at byte 999000 instead of 1000000" in caplog.text


def exchange(file):
    file.content, file.etag = OTHER, '"two"'


@pytest.mark.parametrize("ignores_if_range", [False, True])
@pytest.mark.parametrize("etag", ['"one"', 'W/"one"'])
def test_a_file_exchanged_between_two_tries_is_never_mixed(site, tmp_path, ignores_if_range, etag):
    site.files["/a.zip"] = File(
        DATA, etag, drops=[1_000_000], change=exchange, ignores_if_range=ignores_if_range
    )
    receipt = fetch(wanted(site, tmp_path), FAST)
    assert (tmp_path / "a.zip").read_bytes() == OTHER
    assert receipt.etag == '"two"'


def test_without_etag_another_size_is_noticed(site, tmp_path):
    def shorten(file):
        file.content = OTHER[:2_000_000]

    site.files["/a.zip"] = File(DATA, None, drops=[1_000_000], change=shorten)
    fetch(wanted(site, tmp_path), FAST)
    assert (tmp_path / "a.zip").read_bytes() == OTHER[:2_000_000]


def test_an_interrupted_process_continues(site, tmp_path):
    site.files["/a.zip"] = File(DATA, drops=[1_500_000], stall_s=0)
    site.files["/a.zip"].change = lambda file: setattr(file, "stall_s", 30.0)
    code = (
        "import sys; from pathlib import Path\n"
        "from qs3.data.download.transfer import *\n"
        f"fetch(Wanted({site.address + '/a.zip'!r}, Path({str(tmp_path / 'a.zip')!r})),"
        " Patience(wait_s=0.01))"
    )
    process = subprocess.Popen([sys.executable, "-c", code], env={**os.environ, "no_proxy": "*"})
    while len(site.requests) < 2:
        time.sleep(0.02)
    process.kill()
    process.wait()
    assert names(tmp_path) == ["a.zip.part", "a.zip.part.json"]
    fetch(wanted(site, tmp_path), FAST)
    assert (tmp_path / "a.zip").read_bytes() == DATA
    assert site.ranges("/a.zip")[-1] == "bytes=1500000-"


def test_a_part_that_was_whole_is_not_fetched_again(site, tmp_path):
    site.files["/a.zip"] = File(DATA)
    fetch(wanted(site, tmp_path), FAST)
    (tmp_path / "a.zip").rename(tmp_path / "a.zip.part")
    (tmp_path / "a.zip.json").unlink()
    fetch(wanted(site, tmp_path), FAST)  # no note of it: it is of no use
    assert site.ranges("/a.zip") == [None, None]
    (tmp_path / "a.zip").rename(tmp_path / "a.zip.part")
    state = {"url": f"{site.address}/a.zip", "size": len(DATA), "validator": '"one"'}
    (tmp_path / "a.zip.part.json").write_text(json.dumps(state))
    fetch(wanted(site, tmp_path), FAST)
    assert len(site.requests) == 2
    (tmp_path / "a.zip").rename(tmp_path / "a.zip.part")
    (tmp_path / "a.zip.part.json").write_text(json.dumps({**state, "size": None}))
    fetch(wanted(site, tmp_path), FAST)  # answered by 416: there is nothing more
    assert site.ranges("/a.zip")[-1] == f"bytes={len(DATA)}-"
    assert (tmp_path / "a.zip").read_bytes() == DATA


def test_a_part_of_another_address_is_not_continued(site, tmp_path):
    site.files["/a.zip"] = File(DATA)
    (tmp_path / "a.zip.part").write_bytes(OTHER[:1_000_000])
    (tmp_path / "a.zip.part.json").write_text('{"url": "http://elsewhere/a.zip"}')
    fetch(wanted(site, tmp_path), FAST)
    assert (tmp_path / "a.zip").read_bytes() == DATA


def test_a_part_that_is_too_long_starts_over(site, tmp_path):
    site.files["/a.zip"] = File(DATA)
    (tmp_path / "a.zip.part").write_bytes(DATA + b"more")
    (tmp_path / "a.zip.part.json").write_text(json.dumps({"url": f"{site.address}/a.zip"}))
    fetch(wanted(site, tmp_path), FAST)
    assert (tmp_path / "a.zip").read_bytes() == DATA


def test_giving_up_keeps_what_came(site, tmp_path):
    site.files["/a.zip"] = File(DATA, drops=[1_000_000, 0, 0, 0, 0])
    with pytest.raises(Qs3Error, match=r"4 times in a row\. What came is kept \(1000000 bytes\)"):
        fetch(wanted(site, tmp_path), FAST)
    assert (tmp_path / "a.zip.part").read_bytes() == DATA[:1_000_000]
    fetch(wanted(site, tmp_path), FAST)
    assert (tmp_path / "a.zip").read_bytes() == DATA


def test_progress_resets_the_count_of_failures(site, tmp_path):
    site.files["/a.zip"] = File(DATA, drops=[100_000] * 12)
    fetch(wanted(site, tmp_path), FAST)  # gives up after four in a row only
    assert (tmp_path / "a.zip").read_bytes() == DATA


@pytest.mark.parametrize("status", [429, 500, 502, 503, 504])
def test_busy_servers_are_asked_again(site, tmp_path, status):
    site.files["/a.zip"] = File(DATA, statuses=[status] * 3, headers={"Retry-After": "0"})
    fetch(wanted(site, tmp_path), FAST)
    assert len(site.requests) == 4


@pytest.mark.parametrize(
    ("status", "message"),
    [
        (401, "login"),
        (403, "refuses"),
        (404, "moved or withdrawn"),
        (410, "withdrawn"),
        (418, "Teapot"),
    ],
)
def test_refusals_are_told_at_once(site, tmp_path, status, message):
    site.files["/a.zip"] = File(DATA, statuses=[status] * 9)
    with pytest.raises(DataError, match=rf"/a\.zip: the server answered {status}: .*{message}"):
        fetch(wanted(site, tmp_path), FAST)
    assert len(site.requests) == 1
    assert names(tmp_path) == []


def test_a_web_page_is_no_file(site, tmp_path):
    site.files["/a.zip"] = File(b"<html>please log in</html>", kind="text/html; charset=utf-8")
    with pytest.raises(DataError, match="a web page instead of the file"):
        fetch(wanted(site, tmp_path), FAST)
    assert names(tmp_path) == []


def test_wrong_size_is_told_before_it_is_fetched(site, tmp_path):
    site.files["/a.zip"] = File(DATA)
    with pytest.raises(DataError, match="has 3000000 bytes, expected 2999999"):
        fetch(wanted(site, tmp_path, size=len(DATA) - 1), FAST)
    assert names(tmp_path) == []
    site.files["/a.zip"].chunked = True  # says no size
    with pytest.raises(DataError, match="what came has 3000000 bytes, expected 2999999; it was"):
        fetch(wanted(site, tmp_path, size=len(DATA) - 1), FAST)
    assert names(tmp_path) == []


def test_wrong_hashes(site, tmp_path):
    site.files["/a.zip"] = File(DATA)
    with pytest.raises(DataError, match=r"what came has the SHA-256 .* expected 00"):
        fetch(wanted(site, tmp_path, sha256="00" * 32), FAST)
    assert names(tmp_path) == []
    md5 = base64.b64encode(hashlib.md5(OTHER).digest()).decode()
    site.files["/a.zip"].headers = {"X-Goog-Hash": f"crc32c=AAAAAA==,md5={md5}"}
    with pytest.raises(DataError, match="another MD5 than its server states"):
        fetch(wanted(site, tmp_path), FAST)
    md5 = base64.b64encode(hashlib.md5(DATA).digest()).decode()
    site.files["/a.zip"].headers = {"X-Goog-Hash": f"crc32c=AAAAAA==,md5={md5}"}
    site.files["/a.zip"].drops = [1000]
    sha256 = hashlib.sha256(DATA).hexdigest().upper()
    fetch(wanted(site, tmp_path, size=len(DATA), sha256=sha256), FAST)


def test_an_encoded_answer_is_refused(site, tmp_path):
    site.files["/a.zip"] = File(DATA, headers={"Content-Encoding": "gzip"})
    with pytest.raises(DataError, match="as 'gzip' although it was asked not to"):
        fetch(wanted(site, tmp_path), FAST)


def test_a_server_that_stalls(site, tmp_path):
    site.files["/a.zip"] = File(DATA, stall_s=1.0)
    fetch(wanted(site, tmp_path), Patience(tries=2, wait_s=0.01, timeout_s=0.3))
    assert (tmp_path / "a.zip").read_bytes() == DATA
    assert len(site.requests) == 2


def test_nobody_listens(tmp_path, monkeypatch):
    monkeypatch.setenv("no_proxy", "*")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{taken.getsockname()[1]}/a.zip"
        with pytest.raises(Qs3Error, match=r"ConnectionRefusedError.*, 4 times in a row"):
            fetch(Wanted(url, tmp_path / "a.zip"), FAST)


def test_redirects(site, tmp_path):
    site.files["/b.zip"] = File(DATA, drops=[1_000_000])
    site.files["/a.zip"] = File(b"", redirect="/b.zip")
    fetch(wanted(site, tmp_path), FAST)
    assert (tmp_path / "a.zip").read_bytes() == DATA
    assert site.ranges("/b.zip") == [None, "bytes=1000000-"]
    site.files["/a.zip"].redirect = "file:///etc/passwd"
    with pytest.raises(DataError, match=r"'file:///etc/passwd' is not allowed"):
        fetch(wanted(site, tmp_path / "other"), FAST)


@pytest.mark.parametrize("url", ["file:///etc/passwd", "ftp://a/b", "a.zip", "http:///a", ""])
def test_odd_addresses(tmp_path, url):
    with pytest.raises(ConfigError, match="no address that begins with http"):
        fetch(Wanted(url, tmp_path / "a"), FAST)


def test_a_disk_without_room(site, tmp_path):
    site.files["/a.zip"] = File(b"short", headers={})
    free = shutil.disk_usage(tmp_path).free
    answer = Answer(200, 0, free, None, None, "", False, {})
    running = transfer._Transfer(wanted(site, tmp_path), FAST, lambda done, total: None)
    with pytest.raises(Qs3Error, match=r"GB free, the download needs .* into="):
        running.check_space(answer, 0)
    running.check_space(answer, free - 1000)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_disk_that_fills_up(site, tmp_path):
    site.files["/a.zip"] = File(DATA)
    (tmp_path / "a.zip.part").symlink_to("/dev/full")
    (tmp_path / "a.zip.part.json").write_text(json.dumps({"url": f"{site.address}/a.zip"}))
    with pytest.raises(Qs3Error, match=r"the disk is full\. What came is kept"):
        fetch(wanted(site, tmp_path), FAST)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_no_permission(site, tmp_path):
    site.files["/a.zip"] = File(DATA)
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(Qs3Error, match="cannot write in"):
            fetch(wanted(site, tmp_path), FAST)
    finally:
        tmp_path.chmod(0o700)


def _fetch(url, path):
    os.environ["no_proxy"] = "*"
    return fetch(Wanted(url, path), FAST).sha256


def test_two_processes_fetch_once(site, tmp_path):
    site.files["/a.zip"] = File(DATA, stall_s=0.5)
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        hashes = pool.starmap(_fetch, [(f"{site.address}/a.zip", tmp_path / "a.zip")] * 2)
    assert set(hashes) == {hashlib.sha256(DATA).hexdigest()}
    assert len(site.requests) == 1


def test_patience():
    patience = Patience(wait_s=1, longest_wait_s=20)
    assert [patience.wait(n, None) for n in (1, 2, 3, 9, 999)] == [1, 2, 4, 20, 20]
    assert patience.wait(1, 7.0) == 7
    assert patience.wait(1, 9999.0) == 20
    with pytest.raises(ConfigError, match="tries must be >= 1"):
        Patience(tries=0)
