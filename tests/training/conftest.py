from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import qs3.config.hydra  # noqa: F401 (registers the resolvers)


def result_of(folder: Path) -> dict[str, Any]:
    """All that must not differ between two runs of the same config."""
    metrics = json.loads((folder / "metrics.json").read_text())
    metrics.pop("times")
    metrics["versions"].pop("commit", None)  # a file may be edited between the two
    files = ["history.csv", *(str(p.relative_to(folder)) for p in folder.glob("round_*/*.csv"))]
    return {"metrics": metrics, **{name: (folder / name).read_text() for name in sorted(files)}}
