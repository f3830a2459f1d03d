"""What a server's answer says of the file that it carries: pure reading of headers."""

from __future__ import annotations

import base64
import binascii
import re
import socket
import urllib.error
from collections.abc import Mapping
from typing import Any, NamedTuple

from qs3.errors import DataError

_CONTENT_RANGE = re.compile(r"bytes\s+(?:(\d+)-(\d+)|\*)/(\d+|\*)\s*", re.IGNORECASE)
_AGAIN = (408, 425, 429, 500, 502, 503, 504)

_REFUSED = {
    401: "it asks for a login",
    403: "it refuses to give the file; perhaps it asks for a login, or has been asked too often",
    404: "there is no such file; it was moved or withdrawn",
    410: "the file was withdrawn",
    451: "the file may not be given for legal reasons",
}


class Answer(NamedTuple):
    """The headers of an answer, as far as they matter.

    Attributes:
        status: e.g. 200 or 206.
        start: first byte that is sent; 0 unless the answer says otherwise.
        total: bytes of the whole file; None if the answer does not say.
        etag: as sent, or None.
        validator: what to send as If-Range to get the rest of the same file only: a strong ETag
            or the date of the last change (RFC 9110, 13.1.5).
        encoding: of the content, lower case; "" for none.
        is_page: the body is a web page.
        headers: all of them, names in lower case.
    """

    status: int
    start: int
    total: int | None
    etag: str | None
    validator: str | None
    encoding: str
    is_page: bool
    headers: Mapping[str, str]

    def not_a_continuation(self, done: int, state: Mapping[str, Any]) -> str:
        """Why the body is not the rest of the part of `done` bytes; "" if it is."""
        if self.status != 206:
            return "the file changed, or the server cannot begin in the middle"
        if self.start != done:
            return f"the server began at byte {self.start} instead of {done}"
        for what, now, before in (
            ("size", self.total, state.get("size")),
            ("ETag", self.etag, state.get("etag")),
        ):
            if now is not None and before is not None and now != before:
                return f"the server's file changed (its {what} was {before} and is {now})"
        return ""


def read_answer(response: Any) -> Answer:
    """Read the headers of an `http.client.HTTPResponse` or of an HTTPError."""
    headers = {key.lower(): value.strip() for key, value in response.headers.items()}
    status = int(response.status)
    length = headers.get("content-length", "")
    start, total = 0, int(length) if length.isdigit() else None
    if status in (206, 416):
        total = None
        if found := _CONTENT_RANGE.fullmatch(headers.get("content-range", "")):
            start = int(found[1] or 0)
            total = None if found[3] == "*" else int(found[3])
        elif status == 206:
            start = -1  # says not where it begins: fits nowhere
    if headers.get("content-encoding", "identity") != "identity":
        total = None  # the length is that of the encoded file
    etag = headers.get("etag")
    strong = etag if etag and not etag.startswith("W/") else None
    kind = headers.get("content-type", "").partition(";")[0].strip().lower()
    return Answer(
        status=status,
        start=start,
        total=total,
        etag=etag,
        validator=strong or headers.get("last-modified"),
        encoding=headers.get("content-encoding", "").lower(),
        is_page=kind in ("text/html", "application/xhtml+xml"),
        headers=headers,
    )


def stated_md5(answer: Answer) -> str | None:
    """The MD5 that the server states for the whole file (Google's and the older headers)."""
    hashes = answer.headers.get("x-goog-hash", "")
    found = re.search(r"(?:^|[,\s])md5=([A-Za-z0-9+/]{22}==)", hashes)
    text = found[1] if found else answer.headers.get("content-md5", "")
    if answer.status == 206 and not found:
        return None  # Content-MD5 is that of the part that is sent
    try:
        digest = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        return None
    return digest.hex() if len(digest) == 16 else None


def may_pass(status: int) -> bool:
    """Whether the same question may get another answer later."""
    return status in _AGAIN


def refuse_status(error: urllib.error.HTTPError, url: str) -> float | None:
    """Seconds that the server asks to wait, if another try may help (None: it does not say).

    Raises:
        DataError: another try would get the same answer.
    """
    if not may_pass(error.code):
        why = _REFUSED.get(error.code, str(error.reason))
        raise DataError(
            f"{url}: the server answered {error.code}: {why}. Open the address in a browser; a "
            "file downloaded there is taken with archive=PATH"
        ) from error
    text = error.headers.get("Retry-After", "")
    return float(text) if text.isdigit() else None


def describe(error: BaseException) -> str:
    """A network error in a few words."""
    reason = error.reason if isinstance(error, urllib.error.URLError) else error
    if isinstance(reason, TimeoutError):
        return "nothing came for too long"
    if isinstance(reason, socket.gaierror):
        return f"the server's name cannot be resolved ({reason.strerror})"
    return f"the connection failed ({type(reason).__name__}: {reason})"
