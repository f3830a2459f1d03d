"""One file over HTTP or from Google Drive: pooch checks and places it, what is cut off is resumed.

pooch itself begins an interrupted file from its first byte; the downloader here goes on where it
ended. Files on Google Drive are left to gdown, which knows Drive's pages.
"""

from __future__ import annotations

import json
import logging
import os
import re
import time
from pathlib import Path
from typing import Any, ClassVar

import pooch
import requests

from qs3.errors import DataError, Qs3Error
from qs3.utils.files import write_json
from qs3.utils.locks import locked
from qs3.utils.memory import JSON_PEAK, read_whole
from qs3.utils.plural import counted
from qs3.utils.progress import byte_bar

log = logging.getLogger(__name__)

_CHUNK = 1 << 16  # what is lost at most when a connection breaks off
_BUSY = (408, 425, 429, 500, 502, 503, 504)
_DROPPED = (requests.ConnectionError, requests.Timeout, requests.exceptions.ChunkedEncodingError)


class DownloadError(Qs3Error):
    """A file could not be fetched, or is not the one that was wanted; says what to do."""

    def __init__(self, what: str, page: str) -> None:
        super().__init__(
            f"{what}. Run the same command again: what came is kept, and it continues. If that "
            f"does not help, open {page} in a browser and give the file with archive=PATH"
        )


def fetch(
    url: str, path: Path, *, sha256: str | None = None, size: int | None = None, drive: str = ""
) -> Path:
    """Bring a file to `path`; one that is there already is checked and left alone.

    Two processes that fetch one file take turns. An interrupted one is continued by the next call.

    Args:
        url: of the file (http, https), or of its page for people where `drive` is given.
        path: where it shall lie.
        sha256: hex digits, if known; a file that has others is fetched again.
        size: in bytes, if known.
        drive: its id on Google Drive.

    Raises:
        DownloadError: network, or the server does not give that file.
        Qs3Error: the folder cannot be written.
    """
    pooch.get_logger().setLevel(logging.WARNING)
    downloader = Drive(drive, path) if drive else Resuming(path, size)
    with locked(path.with_name(f".{path.name}.lock")):
        try:
            pooch.retrieve(url, sha256, path.name, path.parent, downloader=downloader)
        except (requests.RequestException, ValueError) as error:  # ValueError: another hash
            raise DownloadError(f"{url}: {error}", url) from error
        except OSError as error:
            raise Qs3Error(
                f"cannot write {path}: {error.strerror or error}. Free some space or choose "
                "another folder with into=, and run the same command again; what came is kept"
            ) from error
        if size is not None and (found := path.stat().st_size) != size:
            raise DownloadError(f"{path} has {found} bytes, expected {size}; delete it", url)
    return path


class Resuming:
    """A downloader for pooch that continues where an earlier attempt or process ended.

    While it comes the file is `name.part`, and `name.part.json` says what the server called it: the
    rest of another version is never put behind the beginning of this one.
    """

    tries: ClassVar[int] = 8  # in a row that bring no byte
    wait_s: ClassVar[float] = 1.0  # before the second one; doubled each time
    timeout_s: ClassVar[float] = 60.0  # without a byte

    def __init__(self, path: Path, size: int | None = None) -> None:
        self.part = path.with_name(f"{path.name}.part")
        self.note = path.with_name(f"{path.name}.part.json")
        self.size = size

    def __call__(self, url: str, output_file: str, pooch: Any) -> None:
        """Fetch `url` to `output_file`."""
        failures = 0
        while True:
            before = self._done()
            try:
                self._attempt(url)
                break
            except _DROPPED as error:
                failures = 1 if self._done() > before else failures + 1
                if failures >= self.tries:
                    what = f"{url}: {error}, {counted(failures, 'time')} in a row"
                    raise DownloadError(what, url) from error
                wait_s = min(self.wait_s * 2 ** (failures - 1), 60.0)
                log.warning("%s: %s; next try in %.0f s", url, error, wait_s)
                time.sleep(wait_s)
        self.note.unlink(missing_ok=True)
        if self.size not in (None, done := self._done()):
            self.part.unlink()
            raise DownloadError(f"{url}: has {done} bytes, expected {self.size}; deleted", url)
        os.replace(self.part, output_file)

    def _attempt(self, url: str) -> None:
        """Ask once, and write what comes to the part; returns when the part is whole."""
        note = self._read_note(url)
        done, headers = self._done() if note else 0, {"Accept-Encoding": "identity"}
        if done:
            headers["Range"] = f"bytes={done}-"
            weak = (note["etag"] or "W/").startswith("W/")  # RFC 9110, 13.1.5
            if validator := note["modified"] if weak else note["etag"]:
                headers["If-Range"] = validator
        with requests.get(url, headers=headers, stream=True, timeout=self.timeout_s) as answer:
            start, total = _extent(answer)
            if done and answer.status_code == 416 and total == done:
                return  # nothing is missing
            etag, modified = map(answer.headers.get, ("ETag", "Last-Modified"))
            says = {"url": url, "size": total, "etag": etag, "modified": modified}
            other = start != done or (done and says != note)
            if other and answer.status_code in (206, 416):
                self.note.unlink(missing_ok=True)
                raise requests.ConnectionError("the server's file is another one, starting over")
            self._check(answer, url, total)
            if start == 0:
                write_json(self.note, says)
            self._write(answer, start, total)

    def _check(self, answer: requests.Response, url: str, total: int | None) -> None:
        """Refuse what is not (the rest of) the file."""
        kind = answer.headers.get("Content-Type", "")
        wrong = ""
        if answer.status_code in _BUSY:
            raise requests.ConnectionError(f"the server answered {answer.status_code}")
        if answer.status_code not in (200, 206):
            wrong = f"the server answered {answer.status_code} {answer.reason}"
        elif kind.startswith(("text/html", "application/xhtml")):
            wrong = "the server gave a web page instead of the file"
        elif answer.headers.get("Content-Encoding", "identity") != "identity":
            wrong = "the server packs the file although it was asked not to"
        elif self.size is not None and total is not None and total != self.size:
            wrong = f"the server's file has {total} bytes, expected {self.size}"
        if wrong:
            raise DownloadError(f"{url}: {wrong}", url)

    def _write(self, answer: requests.Response, start: int, total: int | None) -> None:
        bar = byte_bar(self.part.stem, total, start)
        with bar as advance, open(self.part, "r+b" if start else "wb") as file:
            file.seek(start)
            for chunk in answer.iter_content(_CHUNK):
                file.write(chunk)
                file.flush()
                advance(len(chunk))
            done = file.tell()
        if total is not None and done != total:
            raise requests.ConnectionError(f"the connection ended after {done} of {total} bytes")

    def _done(self) -> int:
        return self.part.stat().st_size if self.part.exists() else 0

    def _read_note(self, url: str) -> dict[str, Any]:
        """What the server said of the part; {} if that is not known."""
        try:
            note = json.loads(read_whole(self.note, JSON_PEAK))
            whole = note.keys() == {"url", "size", "etag", "modified"}
        except (OSError, ValueError, AttributeError, RecursionError, DataError):
            return {}
        return note if whole and note["url"] == url else {}


def _extent(answer: requests.Response) -> tuple[int, int | None]:
    """First byte that is sent (-1: the answer does not say), and bytes of the whole file."""
    if answer.status_code in (206, 416):
        says = answer.headers.get("Content-Range", "")
        found = re.fullmatch(r"bytes (?:(\d+)-\d+|\*)/(\d+|\*)", says)
        if not found:
            return -1, None
        return int(found[1] or 0), None if found[2] == "*" else int(found[2])
    length = answer.headers.get("Content-Length", "")
    return 0, int(length) if length.isdigit() else None


class Drive:
    """A downloader for pooch that leaves a file on Google Drive, and its resuming, to gdown."""

    def __init__(self, file_id: str, path: Path) -> None:
        self.file_id, self.whole = file_id, path.with_name(f"{path.name}.drive")

    def __call__(self, url: str, output_file: str, pooch: Any) -> None:
        """Fetch the file to `output_file`; `url` is its page for people, for messages."""
        import gdown

        try:
            gdown.download(
                id=self.file_id,
                output=str(self.whole),
                quiet=not os.isatty(2),
                use_cookies=False,
                resume=True,
                timeout=Resuming.timeout_s,
                retries=Resuming.tries,
            )
        except gdown.exceptions.DownloadError as error:
            why = " ".join(str(error).split())
            raise DownloadError(f"Google Drive does not give {url}: {why}", url) from error
        os.replace(self.whole, output_file)
