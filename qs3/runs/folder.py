"""A run's folder: its name, its lock, and whether it is finished. Imports nothing heavy.

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
        student_selected.pt  of another epoch than the last, if selection.student asks for one
        round_03/pseudo_labels.csv
        history.csv          one row an epoch
        metrics.json         the result
        pictures/            of the above, drawn last; see `qs3.report.run_page`
"""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from qs3.errors import ConfigError, DataError
from qs3.runs.metrics import METRICS
from qs3.utils.files import write_json
from qs3.utils.memory import JSON_PEAK, read_whole

STARTED = "started.json"

_KEPT_WHEN_CLEARED = (".hydra", ".lock")


def read_started(folder: str | Path) -> dict[str, Any] | None:
    """What `write_started` saved; None if the run never got that far."""
    path = Path(folder) / STARTED
    try:
        started = json.loads(read_whole(path, JSON_PEAK))
        if not isinstance(started, dict):
            raise ValueError("no JSON object")
        return started
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path} cannot be read ({error}); delete it or run with force=true") from (
            error
        )


def read_begun(folder: str | Path) -> dict[str, Any] | None:
    """As `read_started`, of a run, which has to say what it was trained on.

    Raises:
        DataError: it does not.
    """
    started = read_started(folder)
    if started is not None:
        data, versions = started.get("data"), started.get("versions")
        said = isinstance(data, dict) and {*data} >= {"source", "target"}
        if not said or not isinstance(versions, dict):
            raise DataError(
                f"{Path(folder) / STARTED} cannot be read (nothing of data and versions); delete "
                "it or run with force=true"
            )
    return started


def read_code(folder: str | Path) -> dict[str, str]:
    """Hashes of the code that a run was begun with, by name; {} where nobody knows."""
    with contextlib.suppress(DataError):
        found = (read_started(folder) or {}).get("files")
        if isinstance(found, dict):
            return {str(name): str(sha256) for name, sha256 in found.items()}
    return {}


def write_started(folder: str | Path, started: Mapping[str, Any]) -> None:
    """Note what a run was started with, so that it is never continued with something else."""
    write_json(Path(folder) / STARTED, started)


ANEW = "choose another experiment_name, or start again with force=true"
"""What to do about a run that cannot be gone on with."""


def check_data(folder: Path, domain: str, expected: str, found: str, instead: str = ANEW) -> None:
    """Refuse to continue, or to reuse, a run whose data have changed since.

    Raises:
        DataError: the hashes differ. `instead`: of bringing the old data back.
    """
    if found != expected:
        raise DataError(
            f"{folder} was begun with another version of {domain} ({expected[:12] or 'without it'},"
            f" now {found[:12] or 'without it'}); bring the old data back, {instead}"
        )


def check_config(folder: Path, expected: str | None, found: str, instead: str = ANEW) -> None:
    """Refuse to continue, or to reuse, the run of another config (of the same 8 digits).

    Raises:
        ConfigError: the hashes differ. `instead`: of it.
    """
    if found != expected:
        raise ConfigError(
            f"{folder} holds a run with other settings (config hash {expected}, now {found}; they "
            f"are in .hydra/config.yaml); {instead}"
        )


def beside(name: str) -> str:
    """What twins and views are called in messages."""
    return f"what lies beside {name}"


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
