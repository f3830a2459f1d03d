"""Google Drive: the address of a public file, and what its web pages mean.

A file that is too large for Google's virus scan is given only to those who confirm a page. The
address below confirms at once; where a page comes all the same, its form is filled in.
"""

from __future__ import annotations

import functools
import html.parser
import re
import urllib.parse
from collections.abc import Callable

from qs3.errors import DataError

SERVER = "https://drive.usercontent.google.com"

_MEANINGS = (  # part of a page's text, in lower case: why there is no file
    ("quota exceeded", "its daily quota of downloads is used up; try again in a day"),
    ("too many users have viewed", "its daily quota of downloads is used up; try again in a day"),
    ("you need access", "its owner shares it with some people only"),
    ("request access", "its owner shares it with some people only"),
    ("sign in", "it is given to those who are signed in only"),
    ("file not found", "there is no such file; its owner moved or deleted it"),
    ("does not exist", "there is no such file; its owner moved or deleted it"),
    ("error 404", "there is no such file; its owner moved or deleted it"),
)


def address(file_id: str, server: str = SERVER) -> str:
    """Where the file with this id is given without a question, even a large one."""
    query = urllib.parse.urlencode({"id": file_id, "export": "download", "confirm": "t"})
    return f"{server.rstrip('/')}/download?{query}"


def page_of(file_id: str) -> Callable[[str, str], str]:
    """What to do with a web page that comes instead of the file; see `transfer.Wanted.page`."""
    return functools.partial(_follow, file_id)


def browser_address(file_id: str) -> str:
    """The file's page for people."""
    return f"https://drive.google.com/file/d/{file_id}/view"


def _follow(file_id: str, text: str, url: str) -> str:
    """The address that the form of Drive's warning leads to.

    Raises:
        DataError: the page is another one; says what it means.
    """
    form = _Form()
    form.feed(text)
    if form.action is not None and "confirm" in form.fields and "id" in form.fields:
        target = urllib.parse.urljoin(url, form.action)
        if urllib.parse.urlsplit(target).hostname == urllib.parse.urlsplit(url).hostname:
            return f"{target.partition('?')[0]}?{urllib.parse.urlencode(form.fields)}"
    plain = " ".join(re.sub(r"<[^>]*>", " ", text).split())
    lower = plain.casefold()
    why = next((meaning for words, meaning in _MEANINGS if words in lower), None)
    raise DataError(
        f"Google Drive gives a web page instead of the file {file_id}: "
        f"{why or repr(plain[:100]) + ' it says'}. Open {browser_address(file_id)} in a browser; "
        "a file downloaded there is taken with archive=PATH"
    )


class _Form(html.parser.HTMLParser):
    """The hidden fields of the page's form `download-form`."""

    def __init__(self) -> None:
        super().__init__()
        self.action: str | None = None
        self.fields: dict[str, str] = {}
        self._inside = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {key: value or "" for key, value in attrs}
        if tag == "form" and values.get("id") == "download-form":
            self.action, self._inside = values.get("action", ""), True
        elif tag == "input" and self._inside and values.get("type") == "hidden":
            self.fields[values.get("name", "")] = values.get("value", "")

    def handle_endtag(self, tag: str) -> None:
        if tag == "form":
            self._inside = False
