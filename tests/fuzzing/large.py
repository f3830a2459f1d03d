"""A whole file with 4 GB of nothing behind it, for every reader: told, or read, in little memory.

python -m tests.fuzzing.large            the readers that took more, or said something foreign
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path

from qs3.errors import Qs3Error
from tests.fuzzing.engine import Reader
from tests.fuzzing.inputs import laid_out
from tests.fuzzing.mutate import TAR_GZ
from tests.fuzzing.readers import READERS
from tests.limits import memory_of_at_most, time_of_at_most

SIZE = 4 << 30
MOST_MEMORY, MOST_S = 1 << 30, 60.0


def complaints(reader: Reader, root: Path) -> Iterator[str]:
    """What a reader does wrong with each of its files when it is large."""
    (root / "seeds").mkdir()
    for number, data in enumerate(reader.seeds(root / "seeds")):
        place = root / f"{number}"
        place.mkdir()
        path = place / reader.file
        path.write_bytes(data)
        with contextlib.suppress(Qs3Error):  # what is imported now takes its memory before
            reader.read(path)
        shutil.rmtree(place)
        place.mkdir()
        path.write_bytes(data)
        folder = laid_out(path) if data[:2] == b"PK" and reader.file == "a.zip" else None
        files = [path] if folder is None else [one for one in folder.rglob("*") if one.is_file()]
        for file in sorted(files):
            content = file.read_bytes()
            os.truncate(file, SIZE)
            try:
                with memory_of_at_most(MOST_MEMORY), time_of_at_most(MOST_S):
                    reader.read(folder or path)
            except Qs3Error:
                pass
            except Exception as error:
                last = traceback.extract_tb(error.__traceback__)[-1]
                words = (
                    f"{type(error).__name__}: {str(error)[:100]} at {last.filename}:{last.lineno}"
                )
                yield f"{reader.name}, seed {number}, {file.name}: {words}"
            for made in place.rglob("*"):  # by readers that move their input
                if made.is_file() and made.stat().st_size == SIZE:
                    made.unlink()
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)


def main() -> int:
    """The number of complaints, each printed."""
    warnings.simplefilter("ignore")
    count = 0
    for reader in READERS:
        if reader.shape is TAR_GZ:  # which are read to their end in pieces, a minute's work
            continue
        began = time.monotonic()
        with tempfile.TemporaryDirectory() as name:
            for words in complaints(reader, Path(name)):
                sys.stdout.write(f"{words}\n")
                count += 1
        if time.monotonic() - began > 15:
            sys.stderr.write(f"{reader.name}: {time.monotonic() - began:.0f} s\n")
    return count


if __name__ == "__main__":
    sys.exit(min(main(), 1))
