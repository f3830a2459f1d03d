"""Which steps from line to line a call takes in the code that reads files."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import CodeType, FrameType
from typing import Any

# Of the libraries what parses in Python; of C nothing is seen but the errors that it raises.
WATCHED = (
    *("/qs3/", "/trimesh/exchange/", "/trimesh/util.py", "/collada/"),
    *("/numpy/lib/format.py", "/zipfile.py", "/tarfile.py", "/pickle.py", "/scipy/io/matlab/"),
)


class Coverage:
    """Collects steps from one watched line to the next as numbers, in `seen`.

    Args:
        watched: parts of paths of the files whose lines count.
    """

    def __init__(self, watched: tuple[str, ...] = WATCHED) -> None:
        self._watched, self.seen = watched, set[int]()
        self._bases: dict[CodeType, int] = {}  # 0: of a file that is not watched
        self._last = 0

    @contextmanager
    def tracing(self) -> Iterator[None]:
        """Within the block, in this thread."""
        self._last = 0
        before = sys.gettrace()
        sys.settrace(self._call)
        try:
            yield
        finally:
            sys.settrace(before)

    def _call(self, frame: FrameType, event: str, value: Any) -> Callable | None:
        code = frame.f_code
        base = self._bases.get(code)
        if base is None:
            name = code.co_filename
            watched = any(part in name for part in self._watched)
            base = self._bases[code] = (len(self._bases) + 1) << 20 if watched else 0
        return self._line if base else None

    def _line(self, frame: FrameType, event: str, value: Any) -> Callable:
        if event == "line":
            here = self._bases[frame.f_code] + frame.f_lineno
            self.seen.add(hash((self._last, here)))
            self._last = here
        return self._line
