"""Damaged files for every reader, and a table of what came of it.

python -m tests.fuzzing.run                          every reader, 15 s each
python -m tests.fuzzing.run seconds=120 seed=3
python -m tests.fuzzing.run readers="cloud .npz,run" json=true

The status is 1 if anything escaped a reader.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import time

sys.path.insert(0, os.getcwd())

from qs3.utils.text_table import aligned
from tests.fuzzing.engine import Outcome, fuzz
from tests.fuzzing.readers import READERS

HEADER = ("reader", "executions", "whole", "steps", "crashes", "hangs", "foreign", "memory", "peak")


def row(name: str, outcome: Outcome) -> list[str]:
    """Of the table; the peak in MB."""
    kinds = ("crash", "hang", "foreign", "memory")
    return [
        name,
        str(outcome.executions),
        str(outcome.accepted),
        str(outcome.steps),
        *(str(outcome.count(kind)) for kind in kinds),
        f"{outcome.peak / 1e6:.0f} MB",
    ]


def main(*words: str) -> int:
    """Print the table, or JSON with what was found; the exit status."""
    given = dict(word.partition("=")[::2] for word in words)
    unknown = set(given) - {"seconds", "seed", "readers", "json"}
    wanted = [name.strip() for name in given.get("readers", "").split(",") if name.strip()]
    names = [reader.name for reader in READERS]
    if unknown or (odd := [name for name in wanted if name not in names]):
        sys.stderr.write(f"unknown: {', '.join(unknown or odd)}; readers are {', '.join(names)}\n")
        return 2
    found, began = {}, time.monotonic()
    for reader in READERS:
        if not wanted or reader.name in wanted:
            seconds, seed = float(given.get("seconds", 15)), int(given.get("seed", 0))
            found[reader.name] = outcome = fuzz(reader, seconds, seed)
            sys.stderr.write(f"{' '.join(row(reader.name, outcome))}\n")
            for one in outcome.found:
                sys.stderr.write(f"  {one}\n")
    if given.get("json"):
        said = {name: dataclasses.asdict(outcome) for name, outcome in found.items()}
        sys.stdout.write(json.dumps(said) + "\n")
    else:
        rows = [list(HEADER), *(row(name, outcome) for name, outcome in found.items())]
        sys.stdout.write("\n".join(aligned(rows, numbers=True)) + "\n")
        sys.stdout.write(f"{time.monotonic() - began:.0f} s\n")
    return int(any(outcome.found for outcome in found.values()))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
