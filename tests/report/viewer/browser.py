"""Pages opened in Chromium without a screen, by its DevTools protocol over a pair of pipes."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
import select
import shlex
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")

_FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run")
_PATIENCE_S = 60


class Browser:
    """One page.

    Attributes:
        said: what went to the console, and exceptions.
        loaded: what the page asked for.
    """

    def __init__(self, to: int, of: int) -> None:
        self._to, self._of, self._rest = to, of, b""
        self._count, self._session = 0, ""
        self.said: list[str] = []
        self.loaded: list[str] = []
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        found = self.send("Target.attachToTarget", targetId=target, flatten=True)
        self._session = found["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")

    def send(self, method: str, **params: Any) -> dict[str, Any]:
        """Ask and wait for the answer."""
        self._count += 1
        message: dict[str, Any] = {"id": self._count, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while (got := self._read()).get("id") != self._count:
            self._heard(got)
        assert "error" not in got, got["error"]
        return got["result"]

    def open(self, page: Path, width: int = 1000, height: int = 900) -> None:
        """A file, until it has drawn what is seen of it."""
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=False,
        )  # fmt: skip
        self.said, self.loaded = [], []
        self.send("Page.navigate", url=page.as_uri())
        self.run("await new Promise((go) => document.readyState === 'complete' ? go() : "
                 "addEventListener('load', go))")  # fmt: skip
        self.settle()

    def run(self, script: str) -> Any:
        """What the body of an async function returns on the page."""
        found = self.send(
            "Runtime.evaluate",
            expression=f"(async () => {{ {script} }})()", awaitPromise=True, returnByValue=True,
        )  # fmt: skip
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def settle(self) -> None:
        """Wait for four pictures of the browser: what there is to draw is drawn."""
        self.run("for (let i = 0; i < 4; i++) await new Promise(requestAnimationFrame)")

    def drag(
        self, start: tuple[float, float], end: tuple[float, float], modifiers: int = 0
    ) -> None:
        """Press at one place, go to the other, let go; 8 is shift."""
        for kind, (x, y) in (("Pressed", start), ("Moved", end), ("Released", end)):
            self.send(
                "Input.dispatchMouseEvent",
                type=f"mouse{kind}", x=x, y=y, button="left", buttons=1, clickCount=1,
                modifiers=modifiers,
            )  # fmt: skip
        self.settle()

    def touch(self, kind: str, *fingers: tuple[float, float]) -> None:
        """touchStart, touchMove or touchEnd with fingers at these places."""
        points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(fingers)]
        self.send("Input.dispatchTouchEvent", type=kind, touchPoints=points)

    def seen(self) -> np.ndarray:
        """[h, w, 3] what a user sees, 0 to 255."""
        data = self.send("Page.captureScreenshot", format="png")["data"]
        picture = matplotlib.image.imread(io.BytesIO(base64.b64decode(data)))
        return np.rint(255 * picture[..., :3]).astype(int)

    def _read(self) -> dict[str, Any]:
        end = time.monotonic() + _PATIENCE_S
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._of], [], [], max(end - time.monotonic(), 0))
            assert ready, "Chromium does not answer"
            more = os.read(self._of, 1 << 20)
            assert more, "Chromium ended"
            self._rest += more
        message, _, self._rest = self._rest.partition(b"\0")
        return json.loads(message)

    def _heard(self, event: dict[str, Any]) -> None:
        kind, what = event.get("method", ""), event.get("params", {})
        if kind in ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded"):
            self.said.append(json.dumps(what)[:500])
        if kind == "Network.requestWillBeSent":
            self.loaded.append(what["request"]["url"])


@contextlib.contextmanager
def chromium(profile: Path) -> Iterator[Browser]:
    """A browser whose files lie in `profile`; it is gone at the end with all its processes."""
    his_in, to = os.pipe()
    of, his_out = os.pipe()
    words = [CHROMIUM, *_FLAGS, f"--user-data-dir={profile}", "--remote-debugging-pipe"]
    line = f"exec {shlex.join(map(str, words))} 3<&{his_in} 4>&{his_out} 2>/dev/null"
    process = subprocess.Popen(
        ["bash", "-c", line], pass_fds=(his_in, his_out), start_new_session=True
    )
    try:
        os.close(his_in)
        os.close(his_out)
        yield Browser(to, of)
    finally:
        os.close(to)
        os.close(of)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
