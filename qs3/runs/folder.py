"""A run's folder: its name, and whether it is begun or finished. Imports nothing heavy.

A run is named by its experiment, its seed and a hash of its config, so the same command always
finds its own folder: it continues an unfinished run, and skips a finished one. `metrics.json` is
written last, and atomically: it is the mark of a finished run.

    <paths.log_dir>/<experiment_name>/seed<seed>-<hash>/
        .hydra/config.yaml   the composed config
        started.json         the hashes of the datasets and the config, the versions
        last.ckpt            everything needed to continue
        warmup_selected.pt   weights of the teacher of round 0;  warmup_last.pt, student.pt likewise
        result.pt            what is reported, the warm-up's net or the student's, with all that
                             using it takes (`qs3.load`, qs3/inference/model_file.py)
        predictions.csv      their predictions for the target's test clouds
        round_03/pseudo_labels.csv
        history.csv          one row an epoch
        metrics.json         the result
        pictures/            of the above, drawn last; see `qs3.report.run_page`
"""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from qs3.errors import ConfigError, DataError
from qs3.runs.metrics import METRICS
from qs3.utils.files import reading, write_json

STARTED = "started.json"
_ANEW = "choose another experiment_name, or start again with force=true"

_KEPT_WHEN_CLEARED = (".hydra", ".lock")


def read_started(folder: str | Path) -> dict[str, Any] | None:
    """What `write_started` saved; None if the run never got that far."""
    path = Path(folder) / STARTED
    if not path.exists():
        return None
    with reading(path):
        return dict(json.loads(path.read_bytes()))


def write_started(folder: str | Path, started: Mapping[str, Any]) -> None:
    """Note what a run was started with, so that it is never continued with something else."""
    write_json(Path(folder) / STARTED, started)


def check_data(folder: Path, domain: str, expected: str, found: str) -> None:
    """Raise DataError rather than continue, or reuse, a run whose data have changed since."""
    if found != expected:
        raise DataError(
            f"{folder} was begun with another version of {domain} ({expected[:12] or 'without it'},"
            f" now {found[:12] or 'without it'}); bring the old data back, {_ANEW}"
        )


def check_config(folder: Path, expected: str | None, found: str) -> None:
    """Raise ConfigError rather than continue, or reuse, the run of another config."""
    if found != expected:
        raise ConfigError(f"{folder} has other settings, see its .hydra/config.yaml; {_ANEW}")


def clear(folder: str | Path) -> None:
    """Delete what an earlier run left, except what Hydra has just written there."""
    folder = Path(folder)
    # First the mark, so that a kill in the middle cannot leave a finished run without its files.
    (folder / METRICS).unlink(missing_ok=True)
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        if path.name in _KEPT_WHEN_CLEARED or path.suffix == ".log":
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()
