"""A real HTTP server on this machine, with the faults that real ones have."""

import contextlib
import re
import threading
import time
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclass
class File:
    """One file of the server and how it is served.

    Attributes:
        content: what it holds.
        etag: sent and compared with If-Range; None sends none.
        ranges: whether a Range is honoured.
        ignores_if_range: gives the rest even of another file.
        drops: after how many bytes of the body the first, second, ... answer breaks off.
        statuses: of the first answers, before the file is given.
        headers: sent with every answer.
        kind: of the content.
        chunked: send no length.
        stall_s: waits so long before the body of each answer.
        change: called after an answer has broken off.
        shift: begin so many bytes after the one that was asked for.
        redirect: answer with this address instead.
    """

    content: bytes
    etag: str | None = '"one"'
    ranges: bool = True
    ignores_if_range: bool = False
    drops: list = field(default_factory=list)
    statuses: list = field(default_factory=list)
    headers: dict = field(default_factory=dict)
    kind: str = "application/octet-stream"
    chunked: bool = False
    stall_s: float = 0.0
    change: object = None
    shift: int = 0
    redirect: str | None = None


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *args):
        pass

    def do_GET(self):
        site = self.server.site
        site.requests.append((self.path, dict(self.headers)))
        file = site.files.get(self.path)
        if file is None:
            self.short(404, {}, b"<html><body>Not found</body></html>")
        elif file.statuses:
            self.short(file.statuses.pop(0), file.headers)
        elif file.redirect:
            self.short(302, {"Location": file.redirect})
        else:
            self.give(file)

    def short(self, status, headers, body=b""):
        self.send_response(status)
        for key, value in {"Content-Type": "text/html", **headers}.items():
            self.send_header(key, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def give(self, file):
        total = len(file.content)
        start, status = 0, 200
        asked = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
        same = file.ignores_if_range or self.headers.get("If-Range") in (None, file.etag)
        if asked and file.ranges and same:
            start, status = int(asked[1]) + file.shift, 206
        if start >= total > 0:
            self.short(416, {"Content-Range": f"bytes */{total}"})
            return
        body = file.content[start:]
        self.send_response(status)
        self.send_header("Content-Type", file.kind)
        if file.chunked:
            self.send_header("Transfer-Encoding", "chunked")
        else:
            self.send_header("Content-Length", str(len(body)))
        if status == 206:
            self.send_header("Content-Range", f"bytes {start}-{total - 1}/{total}")
        if file.etag:
            self.send_header("ETag", file.etag)
        for key, value in file.headers.items():
            self.send_header(key, value)
        self.end_headers()
        time.sleep(file.stall_s)
        with contextlib.suppress(OSError):
            drop = file.drops.pop(0) if file.drops else None
            self.send_body(body[:drop], file.chunked, whole=drop is None)
            if drop is not None:
                self.wfile.flush()
                self.close_connection = True
                if file.change:
                    file.change(file)

    def send_body(self, body, chunked, whole):
        if not chunked:
            self.wfile.write(body)
            return
        for at in range(0, len(body), 1000):
            piece = body[at : at + 1000]
            self.wfile.write(b"%x\r\n%b\r\n" % (len(piece), piece))
        if whole:
            self.wfile.write(b"0\r\n\r\n")


class Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request, client_address):
        """Clients that hang up are part of the tests; nothing is printed about them."""


class Site:
    """The running server: `files` by path, `requests` as they came."""

    def __init__(self):
        self.files, self.requests = {}, []
        self.server = Server(("127.0.0.1", 0), Handler)
        self.server.site = self
        self.address = f"http://127.0.0.1:{self.server.server_address[1]}"
        self.thread = threading.Thread(target=self.server.serve_forever, args=(0.02,))
        self.thread.start()

    def ranges(self, path):
        """The Range header of each request for a path."""
        return [headers.get("Range") for asked, headers in self.requests if asked == path]

    def close(self):
        self.server.shutdown()
        self.thread.join()
        self.server.server_close()
