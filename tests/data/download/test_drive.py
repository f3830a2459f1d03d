"""Google Drive's pages, told apart on a server of our own."""

import pytest

from qs3.data.download import drive
from qs3.data.download.transfer import Patience, Wanted, fetch
from qs3.errors import DataError
from tests.data.download.server import File

FAST = Patience(tries=2, wait_s=0.01, timeout_s=5.0)
HTML = "text/html; charset=utf-8"
WARNING = """<!DOCTYPE html><html><head><title>Google Drive - Virus scan warning</title></head>
<body><p class="uc-warning-caption">Google Drive can't scan this file for viruses.</p>
<form id="download-form" action="{action}" method="get">
<input type="submit" id="uc-download-link" value="Download anyway"/>
<input type="hidden" name="id" value="abc-1_2"><input type="hidden" name="export" value="download">
<input type="hidden" name="confirm" value="t"><input type="hidden" name="uuid" value="12 34">
</form></body></html>"""


def fetch_drive(site, folder):
    url = drive.address("abc-1_2", site.address)
    return fetch(Wanted(url, folder / "a", page=drive.page_of("abc-1_2")), FAST)


def test_the_address_confirms_at_once(site, tmp_path):
    assert drive.address("abc-1_2") == (
        "https://drive.usercontent.google.com/download?id=abc-1_2&export=download&confirm=t"
    )
    site.files["/download?id=abc-1_2&export=download&confirm=t"] = File(b"the file")
    fetch_drive(site, tmp_path)
    assert (tmp_path / "a").read_bytes() == b"the file"


def test_the_form_is_filled_in_and_the_rest_resumed(site, tmp_path):
    first = "/download?id=abc-1_2&export=download&confirm=t"
    second = "/download?id=abc-1_2&export=download&confirm=t&uuid=12+34"
    page = WARNING.format(action="/download").encode()
    site.files[first] = File(page, kind=HTML, etag=None, ranges=False)
    site.files[second] = File(b"x" * 5000 + b"y", drops=[3000])
    receipt = fetch_drive(site, tmp_path)
    assert (tmp_path / "a").read_bytes() == b"x" * 5000 + b"y"
    assert site.ranges(second) == [None, "bytes=3000-"]
    assert receipt.url.endswith(first)


def test_a_form_that_leads_elsewhere_is_not_followed(site, tmp_path):
    page = WARNING.format(action="https://evil.example/download").encode()
    site.files["/download?id=abc-1_2&export=download&confirm=t"] = File(page, kind=HTML)
    with pytest.raises(DataError, match=r"abc-1_2: .Google Drive - Virus scan"):
        fetch_drive(site, tmp_path)
    assert len(site.requests) == 1


def test_a_page_that_leads_to_itself(site, tmp_path):
    page = WARNING.format(action="/download").encode()
    for more in ("", "&uuid=12+34"):
        site.files[f"/download?id=abc-1_2&export=download&confirm=t{more}"] = File(page, kind=HTML)
    with pytest.raises(DataError, match="a web page instead of the file"):
        fetch_drive(site, tmp_path)
    assert len(site.requests) == 3


@pytest.mark.parametrize(
    ("title", "status", "message"),
    [
        ("Google Drive - Quota exceeded", 200, "daily quota of downloads is used up"),
        ("Too many users have viewed or downloaded this file", 403, "daily quota"),
        ("Sign in - Google Accounts", 200, "given to those who are signed in only"),
        ("You need access", 403, "shares it with some people only"),
        ("Error 404 (Not Found)!!1", 404, "its owner moved or deleted it"),
        ("Something new", 200, "'Something new' it says"),
    ],
)
def test_pages_without_a_file(site, tmp_path, title, status, message):
    page = f"<html><head><title>{title}</title></head><body></body></html>".encode()
    path = "/download?id=abc-1_2&export=download&confirm=t"
    site.files[path] = File(page, kind=HTML, status=status)
    with pytest.raises(DataError, match=rf"instead of the file abc-1_2: .*{message}") as caught:
        fetch_drive(site, tmp_path)
    assert "https://drive.google.com/file/d/abc-1_2/view" in str(caught.value)
    assert "archive=PATH" in str(caught.value)
    assert len(site.requests) == 1
