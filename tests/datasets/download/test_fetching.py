"""One file over real sockets: whole, broken off, exchanged, refused."""

import hashlib
import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
import requests

from qs3.datasets.download.fetching import DownloadError, Resuming, fetch
from qs3.errors import Qs3Error
from tests.datasets.download.server import File

DATA = np.random.default_rng(0).bytes(3_000_000)
OTHER = np.random.default_rng(1).bytes(3_000_000)


LOST = 1 << 16  # bytes at most, when a connection breaks off


def sha(data):
    return hashlib.sha256(data).hexdigest()


def get(site, folder, **more):
    return fetch(f"{site.address}/a.zip", folder / "a.zip", **more).read_bytes()


def names(folder):
    return sorted(path.name for path in folder.iterdir() if not path.name.endswith(".lock"))


def test_whole_and_a_second_run_asks_nothing(site, tmp_path):
    site.files["/a.zip"] = File(DATA)
    for _ in range(2):
        assert get(site, tmp_path, sha256=sha(DATA).upper(), size=len(DATA)) == DATA
    assert names(tmp_path) == ["a.zip"]
    assert len(site.requests) == 1
    assert site.requests[0][1]["Accept-Encoding"] == "identity"


def test_what_is_there_is_compared_with_what_is_known(site, tmp_path):
    site.files["/a.zip"] = File(DATA)
    (tmp_path / "a.zip").write_bytes(OTHER)
    assert get(site, tmp_path) == OTHER  # nothing is known of it
    assert site.requests == []
    assert get(site, tmp_path, sha256=sha(DATA)) == DATA
    with pytest.raises(DownloadError, match=r"a\.zip has 3000000 bytes, expected 5; delete it"):
        get(site, tmp_path, size=5)


def test_drops_are_resumed_where_they_broke_off(site, tmp_path):
    site.files["/a.zip"] = File(DATA, drops=[1_000_000, 700_000])
    assert get(site, tmp_path) == DATA
    first, *later = site.ranges("/a.zip")
    assert first is None
    second, third = (int(asked.removeprefix("bytes=")[:-1]) for asked in later)
    assert 1_000_000 - LOST <= second <= 1_000_000
    assert second + 700_000 - LOST <= third <= second + 700_000
    assert site.requests[1][1]["If-Range"] == '"one"'


def starts_anew(file):
    file.ranges = False


def another(file):
    file.content, file.etag = OTHER, '"two"'


def shorter(file):
    file.content = OTHER[:2_000_000]


def elsewhere(file):
    file.shift = -1000


@pytest.mark.parametrize("etag", ['"one"', 'W/"one"', None])
@pytest.mark.parametrize(
    ("served", "change"),
    [
        ({}, None),
        ({"chunked": True}, None),
        ({}, starts_anew),
        ({}, another),
        ({"ignores_if_range": True}, another),
        ({}, shorter),
        ({"headers": {"Last-Modified": "Wed, 21 Oct 2015 07:28:00 GMT"}}, shorter),
        ({}, elsewhere),
    ],
)
def test_whatever_happens_between_two_tries_nothing_is_mixed(site, tmp_path, etag, served, change):
    file = File(DATA, etag, drops=[1_000_000], change=change, **served)
    site.files["/a.zip"] = file
    assert get(site, tmp_path) == file.content
    assert names(tmp_path) == ["a.zip"]
    assert len(site.requests) <= 4


def test_a_killed_process_continues(site, tmp_path):
    stall = lambda file: setattr(file, "stall_s", 30.0)  # noqa: E731
    site.files["/a.zip"] = File(DATA, drops=[1_500_000], change=stall)
    code = (
        "from pathlib import Path; from qs3.datasets.download.fetching import *\n"
        f"fetch({site.address + '/a.zip'!r}, Path({str(tmp_path / 'a.zip')!r}))"
    )
    process = subprocess.Popen([sys.executable, "-c", code], env={**os.environ, "no_proxy": "*"})
    while len(site.requests) < 2:
        time.sleep(0.02)
    process.kill()
    process.wait()
    left = (tmp_path / "a.zip.part").read_bytes()
    assert len(left) >= 1_500_000 - LOST
    site.files["/a.zip"].stall_s = 0.0
    assert get(site, tmp_path) == DATA
    assert site.ranges("/a.zip")[-1] == f"bytes={len(left)}-"


def test_parts_that_an_earlier_process_left(site, tmp_path):
    site.files["/a.zip"] = File(DATA)
    part, note = tmp_path / "a.zip.part", tmp_path / "a.zip.part.json"
    says = {"url": f"{site.address}/a.zip", "size": len(DATA), "etag": '"one"', "modified": None}
    for content, known, asked in (
        (DATA, says, f"bytes={len(DATA)}-"),  # whole: answered by 416
        (DATA[:9], says, "bytes=9-"),
        (OTHER[:9], None, None),  # nothing is known of it
        (OTHER[:9], {**says, "url": "http://elsewhere/a.zip"}, None),
        (OTHER[:9], [], None),
        (OTHER[:9], {**says, "etag": '"two"'}, "bytes=9-"),  # of an older version
        (DATA + b"more", says, f"bytes={len(DATA) + 4}-"),  # cannot be its beginning
    ):
        part.write_bytes(content)
        note.write_text(json.dumps(known))
        site.requests.clear()
        assert get(site, tmp_path) == DATA
        assert site.ranges("/a.zip")[0] == asked
        (tmp_path / "a.zip").unlink()
    assert names(tmp_path) == []


def test_giving_up_keeps_what_came(site, tmp_path):
    site.files["/a.zip"] = File(DATA, drops=[1_000_000, 0, 0, 0, 0])
    with pytest.raises(DownloadError, match=r"4 times in a row\. Run the same command again: what"):
        get(site, tmp_path)
    left = (tmp_path / "a.zip.part").read_bytes()
    assert len(left) >= 1_000_000 - LOST
    assert DATA.startswith(left)


def test_busy_servers_are_asked_again(site, tmp_path):
    site.files["/a.zip"] = File(DATA, statuses=[503, 429, 500])
    assert get(site, tmp_path) == DATA
    site.files["/a.zip"] = File(DATA, statuses=[503] * 4)
    with pytest.raises(DownloadError, match=r"the server answered 503, 4 times in a row"):
        get(site, tmp_path / "other")


@pytest.mark.parametrize(
    ("file", "known", "message"),
    [
        (None, {}, r"answered 404 Not Found\. Run .* open http.* in a browser .* archive=PATH"),
        (File(DATA, statuses=[403]), {}, "answered 403"),
        (File(b"<html>", kind="text/html; charset=utf-8"), {}, "a web page instead of the file"),
        (File(DATA, headers={"Content-Encoding": "gzip"}), {}, "packs the file although"),
        (File(DATA), {"size": 9}, "the server's file has 3000000 bytes, expected 9"),
        (File(DATA, redirect="file:///etc/passwd"), {}, "No connection adapters"),
    ],
)
def test_answers_that_another_try_will_not_change(site, tmp_path, file, known, message):
    if file:
        site.files["/a.zip"] = file
    with pytest.raises(DownloadError, match=message):
        get(site, tmp_path, **known)
    assert len(site.requests) == 1
    assert names(tmp_path) == []


def test_another_hash_or_size_than_it_must_have_leaves_no_file(site, tmp_path):
    site.files["/a.zip"] = File(DATA, chunked=True)  # says no size
    with pytest.raises(DownloadError, match=r"hash of downloaded file.*expected 000"):
        get(site, tmp_path, sha256="00" * 32)
    assert names(tmp_path) == []
    site.files["/b.zip"] = site.files["/a.zip"]
    with pytest.raises(DownloadError, match="has 3000000 bytes, expected 7; deleted"):
        fetch(f"{site.address}/b.zip", tmp_path / "b.zip", size=7)
    assert names(tmp_path) == []


def test_a_server_that_stalls_and_one_that_is_not_there(site, tmp_path, monkeypatch):
    monkeypatch.setattr(Resuming, "timeout_s", 0.2)
    site.files["/a.zip"] = File(DATA, stall_s=1.0)
    with pytest.raises(DownloadError, match=r"timed out.*4 times in a row"):
        get(site, tmp_path)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{taken.getsockname()[1]}/a.zip"
        with pytest.raises(DownloadError, match=r"refused.*4 times in a row"):
            fetch(url, tmp_path / "a.zip")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_disk_that_fills_up(site, tmp_path):
    site.files["/a.zip"] = File(DATA)
    (tmp_path / "a.zip.part").symlink_to("/dev/full")
    with pytest.raises(Qs3Error, match=r"No space left .*what came is kept"):
        get(site, tmp_path)


WARNING = (  # in one line, as Google has it
    "<!DOCTYPE html><html><head><title>Google Drive - Virus scan warning</title></head><body>"
    '<form id="download-form" action="https://drive.usercontent.google.com/download" method="get">'
    '<input type="hidden" name="id" value="abc"><input type="hidden" name="confirm" value="t">'
    "</form></body></html>"
)


@pytest.fixture
def drive(site, monkeypatch):
    """Google's addresses lead to the local server; everything else is gdown's own way."""
    send = requests.adapters.HTTPAdapter.send

    def redirected(adapter, request, **more):
        if urlsplit(request.url).hostname.endswith(".google.com"):
            request.url = site.address + request.path_url
        return send(adapter, request, **more)

    monkeypatch.setattr(requests.adapters.HTTPAdapter, "send", redirected)
    monkeypatch.setattr("random.uniform", lambda low, high: 0.0)  # gdown waits at random
    page = "https://drive.google.com/file/d/abc/view"
    return lambda path: fetch(page, path, drive="abc").read_bytes()


def test_drive_asks_for_a_confirmation_and_breaks_off(site, drive, tmp_path):
    named = {"Content-Disposition": 'attachment; filename="x.zip"'}
    site.files["/uc?id=abc"] = File(WARNING.encode(), kind="text/html; charset=utf-8")
    second = "/download?id=abc&confirm=t"
    site.files[second] = File(DATA, headers=named, drops=[1_000_000])
    assert drive(tmp_path / "a.zip") == DATA
    assert names(tmp_path) == ["a.zip"]
    first, resumed = site.ranges(second)
    assert first is None
    assert int(resumed[6:-1]) > 0
    site.files[second].drops = [2_000_000, 0, 0, 0, 0, 0, 0]
    with pytest.raises(DownloadError, match=r"Download is incomplete.*archive=PATH"):
        drive(tmp_path / "b.zip")
    site.files[second].drops = []
    site.requests.clear()
    assert drive(tmp_path / "b.zip") == DATA
    assert int(site.ranges(second)[-1][6:-1]) > 1_000_000


def test_drive_gives_a_page_instead_of_the_file(site, drive, tmp_path):
    page = '<p class="uc-error-subcaption">Too many users have viewed this file</p>'
    site.files["/uc?id=abc"] = File(page.encode(), kind="text/html")
    with pytest.raises(
        DownloadError, match=r"Too many users have.*open https://drive\.google\.com/f"
    ):
        drive(tmp_path / "a.zip")
    assert names(tmp_path) == []
