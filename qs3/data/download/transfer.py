"""One file over HTTP, resumed after interruptions, checked before it gets its name.

Beside the wanted file `name` lie, while it comes, `name.part` and `name.part.json` (what the server
said of the file, to find out whether it is still the same one), and afterwards `name.json`: the
receipt, with size and SHA-256. Where nobody published a hash, the receipt of the first download is
what a second run compares with; it cannot tell whether the first one was right.
"""

from __future__ import annotations

import contextlib
import errno
import http.client
import logging
import os
import re
import shutil
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from qs3.data.download.answers import (
    Answer,
    describe,
    may_pass,
    read_answer,
    refuse_status,
    stated_md5,
)
from qs3.data.download.receipts import Receipt, beside, md5_file, read_json, read_receipt
from qs3.errors import ConfigError, DataError, Qs3Error
from qs3.utils.files import make_folder, sha256_file, write_json
from qs3.utils.locks import locked

log = logging.getLogger(__name__)

_CHUNK = 1 << 18
_SPARE = 64 << 20  # bytes of the disk that are left free
_PAGE = 1 << 20  # of a web page that came instead of the file, at most so much is read

Report = Callable[[int, int | None], None]
"""Told again and again how many bytes are there, and of how many (None if not known)."""


class Dropped(Exception):
    """The connection failed in a way that is worth another try."""

    def __init__(self, reason: str, wait_s: float | None = None) -> None:
        super().__init__(reason)
        self.wait_s = wait_s


@dataclass(frozen=True)
class Patience:
    """How often and how long to try.

    Attributes:
        tries: attempts in a row that bring no byte, before giving up.
        wait_s: before the second attempt; doubled each time.
        longest_wait_s: however often it was doubled, and whatever the server asks for.
        timeout_s: without a byte, after which a connection counts as dropped.
    """

    tries: int = 8
    wait_s: float = 1.0
    longest_wait_s: float = 120.0
    timeout_s: float = 60.0

    def __post_init__(self) -> None:
        if self.tries < 1 or self.timeout_s <= 0 or self.wait_s < 0 or self.longest_wait_s < 0:
            raise ConfigError(
                f"{self}: tries must be >= 1, timeout_s > 0 and the waiting times >= 0"
            )

    def wait(self, failures: int, asked_s: float | None) -> float:
        """Seconds before the next attempt, after `failures` of them in a row."""
        own = self.wait_s * 2 ** min(failures - 1, 20)
        return min(max(own, asked_s or 0.0), self.longest_wait_s)


class Wanted(NamedTuple):
    """A file to fetch.

    Attributes:
        url: of the file, http or https.
        path: where it shall lie.
        size: in bytes, if it is known beforehand.
        sha256: if it is known beforehand.
        page: what to do with a web page that comes instead of the file: gives the address to
            ask instead, or raises DataError with the reason. None: any page is an error.
    """

    url: str
    path: Path
    size: int | None = None
    sha256: str | None = None
    page: Callable[[str, str], str] | None = None


def fetch(
    wanted: Wanted, patience: Patience | None = None, report: Report = lambda done, total: None
) -> Receipt:
    """Bring a file here, or find it here and check it.

    Bytes that are there already are not asked for again, unless the server's file has changed or
    the server cannot begin in the middle. Two processes that fetch one file take turns.

    Raises:
        DataError: the server's answer is an error or a web page, or the file has another size or
            hash than it must have.
        Qs3Error: the network stayed away, or the disk is full or not writable.
        ConfigError: an address that is not http or https.
    """
    _check_url(wanted.url)
    make_folder(wanted.path.parent)
    with locked(wanted.path.with_name(f".{wanted.path.name}.lock")):
        if wanted.path.exists():
            return verify(wanted)
        return _Transfer(wanted, patience or Patience(), report).run()


def verify(wanted: Wanted) -> Receipt:
    """Compare a file that is there with its receipt, and with what is known beforehand.

    Without a receipt (a file that someone put there) one is written.

    Raises:
        DataError: it differs; names the file and says to delete it.
    """
    path, receipt = wanted.path, read_receipt(wanted.path)
    size = path.stat().st_size
    expected = wanted.size if receipt is None else receipt.size
    if expected is not None and size != expected:
        raise DataError(f"{path} has {size} bytes, expected {expected}: {_again(path)}")
    sha256 = sha256_file(path)
    for known in (wanted.sha256, receipt and receipt.sha256):
        if known and sha256 != known.lower():
            raise DataError(f"{path} has the SHA-256 {sha256}, expected {known}: {_again(path)}")
    if receipt is None:
        receipt = Receipt(wanted.url, size, sha256)
        write_json(beside(path, ".json"), receipt._asdict())
    return receipt


@dataclass
class _Transfer:
    wanted: Wanted
    patience: Patience
    report: Report

    def __post_init__(self) -> None:
        self.part = beside(self.wanted.path, ".part")
        self.state_file = beside(self.wanted.path, ".part.json")

    def run(self) -> Receipt:
        failures = 0
        while True:
            before = self.done()
            self.url, self.pages = self.wanted.url, 0  # a web page may lead to another address
            try:
                self.attempt()
                break
            except Dropped as drop:
                failures = 1 if self.done() > before else failures + 1
                if failures >= self.patience.tries:
                    raise Qs3Error(
                        f"{self.wanted.url}: {drop}, {failures} times in a row. What came is kept "
                        f"({self.done()} bytes); run the same command again and it continues"
                    ) from drop
                wait_s = self.patience.wait(failures, drop.wait_s)
                log.warning("%s: %s; next try in %.0f s", self.wanted.url, drop, wait_s)
                time.sleep(wait_s)
        return self.finish()

    def done(self) -> int:
        with contextlib.suppress(OSError):
            return self.part.stat().st_size
        return 0

    def attempt(self) -> None:
        """Ask once, and write what comes to the part; returns when the part is whole."""
        state = read_json(self.state_file)
        if state.get("url") != self.wanted.url:
            self.start_over("")
            state = {}
        done = self.done()
        if done and done == state.get("size"):
            return  # whole, but the command ended before it was checked
        with self.open(done, state.get("validator")) as response:
            answer = read_answer(response)
            if answer.status == 416:  # nothing behind the end of the part: is that the end?
                if done and answer.total == done:
                    return
                self.start_over("the part is not the beginning of the server's file")
                raise Dropped("the server has nothing more than what is here")
            if answer.is_page:
                self.url = self.turn_page(response)
                return self.attempt()
            if done and (why := answer.not_a_continuation(done, state)):
                self.start_over(why)
                if answer.status == 206:  # the middle of another file: ask from its beginning
                    raise Dropped(why)
                done = 0
            if done == 0 and answer.status == 206 and answer.start != 0:
                raise DataError(f"{self.wanted.url}: the server sent the middle of the file")
            self.check_announced(answer)
            if done == 0:
                note = {"size": answer.total, "etag": answer.etag, "md5": stated_md5(answer)}
                note |= {"url": self.wanted.url, "validator": answer.validator}
                write_json(self.state_file, note)
            self.check_space(answer, done)
            self.copy(response, done, answer.total)

    def open(self, done: int, validator: str | None) -> http.client.HTTPResponse:
        headers = {"User-Agent": "qs3", "Accept-Encoding": "identity", "Accept": "*/*"}
        if done:
            headers["Range"] = f"bytes={done}-"
            if validator:
                headers["If-Range"] = validator
        request = urllib.request.Request(self.url, headers=headers)
        try:
            return _OPENER.open(request, timeout=self.patience.timeout_s)
        except urllib.error.HTTPError as error:
            page = self.wanted.page is not None and read_answer(error).is_page
            if error.code == 416 or (page and not may_pass(error.code)):
                return error  # type: ignore[return-value]  # read like any other answer
            with error:
                wait_s = refuse_status(error, self.wanted.url)
            raise Dropped(f"the server answered {error.code} {error.reason}", wait_s) from error
        except (OSError, http.client.HTTPException) as error:  # URLError, timeouts, resets
            raise Dropped(describe(error)) from error

    def turn_page(self, response: http.client.HTTPResponse) -> str:
        """The address to which a web page leads that came instead of the file."""
        try:
            text = response.read(_PAGE).decode("utf-8", "replace")
        except (OSError, http.client.HTTPException) as error:
            raise Dropped(describe(error)) from error
        self.pages += 1
        if self.wanted.page is None or self.pages > 2:
            raise DataError(
                f"{self.wanted.url}: the server answered with a web page instead of the file. "
                "Open the address in a browser to see what it wants; a file downloaded there is "
                "taken with archive=PATH"
            )
        url = self.wanted.page(text, self.url)
        _check_url(url)
        return url

    def check_announced(self, answer: Answer) -> None:
        if answer.encoding not in ("", "identity"):
            raise DataError(
                f"{self.wanted.url}: the server sends the file as {answer.encoding!r} although it "
                "was asked not to; download it in a browser and give archive=PATH"
            )
        expected = self.wanted.size
        if expected is not None and answer.total is not None and answer.total != expected:
            raise DataError(
                f"{self.wanted.url}: the server's file has {answer.total} bytes, expected "
                f"{expected}: it is not the published one, or not whole"
            )

    def check_space(self, answer: Answer, done: int) -> None:
        free = shutil.disk_usage(self.part.parent).free
        if answer.total is not None and answer.total - done + _SPARE > free:
            raise Qs3Error(
                f"{self.part.parent} has {free / 1e9:.1f} GB free, the download needs "
                f"{(answer.total - done) / 1e9:.1f} GB more: free some space or choose another "
                "folder with into="
            )

    def copy(self, response: http.client.HTTPResponse, done: int, total: int | None) -> None:
        """Append the answer's body to the part."""
        self.report(done, total)
        try:
            file = open(self.part, "r+b" if done else "wb")  # noqa: SIM115 (closed below)
        except OSError as error:
            raise Qs3Error(f"cannot write {self.part}: {error.strerror}") from error
        with file:
            file.seek(done)
            while True:
                try:
                    chunk = response.read1(_CHUNK)
                except (OSError, http.client.HTTPException) as error:
                    raise Dropped(describe(error)) from error
                if not chunk:
                    break
                _write(file, chunk, self.part)
                done += len(chunk)
                if total is not None and done > total:
                    break
                self.report(done, total)
        if total is not None and done < total:
            raise Dropped(f"the connection ended after {done} of {total} bytes")
        if total is not None and done > total:
            self.start_over("")
            raise DataError(f"{self.wanted.url}: the server sent more than its {total} bytes")

    def finish(self) -> Receipt:
        """Check the part and give it its name."""
        wanted, state = self.wanted, read_json(self.state_file)
        size, sha256 = self.done(), sha256_file(self.part)
        problem = None
        if wanted.size is not None and size != wanted.size:
            problem = f"has {size} bytes, expected {wanted.size}"
        elif wanted.sha256 and sha256 != wanted.sha256.lower():
            problem = f"has the SHA-256 {sha256}, expected {wanted.sha256}"
        elif state.get("md5") and md5_file(self.part) != state["md5"]:
            problem = "has another MD5 than its server states"
        if problem:
            self.start_over("")
            raise DataError(
                f"{wanted.url}: what came {problem}; it was deleted. Try again; if it stays so, "
                "the file was exchanged or something on the way changes it"
            )
        receipt = Receipt(wanted.url, size, sha256, state.get("etag"))
        write_json(beside(wanted.path, ".json"), receipt._asdict())
        os.replace(self.part, wanted.path)
        self.state_file.unlink(missing_ok=True)
        return receipt

    def start_over(self, why: str) -> None:
        if why:
            log.warning("%s: %s; starting over", self.wanted.url, why)
        self.part.unlink(missing_ok=True)
        self.state_file.unlink(missing_ok=True)


class _SafeRedirect(urllib.request.HTTPRedirectHandler):
    """Follows a redirect to http(s) only, and never from https back to http."""

    def redirect_request(
        self, req: Any, fp: Any, code: int, msg: str, headers: Any, url: str
    ) -> Any:
        new = urllib.parse.urlsplit(url)
        if new.scheme != "https" and (new.scheme != "http" or req.type == "https"):
            raise DataError(f"{req.full_url}: the server leads to {url}, which is not followed")
        return super().redirect_request(req, fp, code, msg, headers, url)


_OPENER = urllib.request.build_opener(_SafeRedirect)


def _check_url(url: str) -> None:
    parts = urllib.parse.urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise ConfigError(f"{url!r} is no address that begins with http:// or https://")
    if re.search(r"[\s\x00-\x1f\x7f]", url):
        raise ConfigError(f"{url!r} holds blanks or control characters")


def _write(file: Any, chunk: bytes, path: Path) -> None:
    try:
        file.write(chunk)
        file.flush()
    except OSError as error:
        what = "the disk is full" if error.errno in (errno.ENOSPC, errno.EDQUOT) else error.strerror
        raise Qs3Error(
            f"cannot write {path}: {what}. What came is kept; free some space and run the same "
            "command again"
        ) from error


def _again(path: Path) -> str:
    receipt = beside(path, ".json").name
    return f"it is damaged or was exchanged; delete it and {receipt} to fetch it again"
