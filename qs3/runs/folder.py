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
        predictions.csv      what they say of each of the target's test clouds
        student_selected.pt  of another epoch than the last, if selection.student asks for one;
                             candidates/epoch_095.pt  of each epoch of the last round (oracle)
        round_03/pseudo_labels.csv
        history.csv          one row an epoch
        metrics.json         the result
        pictures/            of the above, drawn last; see `qs3.report.runs.pictures`
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from omegaconf import DictConfig, OmegaConf

from qs3.config.checks import whole
from qs3.data.domain import Domain
from qs3.datamodules.phases import Phases, Scheme
from qs3.errors import ConfigError, DataError, Qs3Error
from qs3.utils.files import make_folder, write_json

METRICS = "metrics.json"
STARTED = "started.json"

# Keys that do not change a result: where things lie, what is shown, how data would be made, and the
# seed, which is in the folder's name. Everything else is hashed, so two different runs never share
# a folder. (Other data, wherever they lie, have another hash, which `started.json` guards.)
_UNHASHED = (
    "seed",
    "paths",
    "logger",
    "hydra",
    "force",
    "callbacks.progress",
    "report",
    "ckpt_path",
    "objective",
    "data.cache_dir",
    "data.make_source",
    *(
        f"data.{domain}.{key}"
        for domain in ("source", "target")
        for key in (
            *("path", "published.folder", "title", "symbol"),
            *("synthesis", "how_to_get", "make", "stand_in"),
        )
    ),
)
_LAST_EPOCH = "last"
_NO_ROUNDS = "qs3.datamodules.phases.no_rounds"
_KEPT_WHEN_CLEARED = (".hydra", ".lock")


@dataclass(frozen=True)
class Run:
    """One run, its settings checked and the light parts of its config built."""

    cfg: DictConfig
    folder: Path
    seed: int
    phases: Phases
    scheme: Scheme
    source: Domain
    target: Domain


def config_sha256(cfg: DictConfig) -> str:
    """64 hex digits over the composed config, without the keys that do not change a result.

    Interpolations are hashed as they are written: what they point to is hashed at its own place,
    or does not matter (`${paths.data_dir}/...`).
    """
    plain: Any = OmegaConf.to_container(cfg, resolve=False)
    for key in _UNHASHED:
        *parents, leaf = key.split(".")
        node = plain
        for parent in parents:
            node = node.get(parent) if isinstance(node, dict) else None
        if isinstance(node, dict):
            node.pop(leaf, None)
    if _without_rounds(plain.get("selftraining")):  # nobody reads its other settings
        plain["selftraining"] = None
    selection = plain.get("selection")
    if isinstance(selection, dict) and selection.get("student") == _LAST_EPOCH:
        selection.pop("student")  # a younger key: runs from before it are still found
    if plain.get("compile") is False:  # likewise
        plain.pop("compile")
    data, trainer = plain.get("data"), plain.get("trainer")
    for key in ("clouds_a_class", "clouds_a_split"):  # likewise
        if isinstance(data, dict) and data.get(key, 0) is None:
            data.pop(key)
    if isinstance(trainer, dict):  # which of several GPUs trains a run does not matter
        trainer.pop("gpus", None)
        if isinstance(trainer.get("devices"), list) and len(trainer["devices"]) == 1:
            trainer["devices"] = 1
    text = json.dumps(plain, sort_keys=True, ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()


def config_hash(cfg: DictConfig) -> str:
    """The first 8 digits of `config_sha256`, for names (`check_config` compares all 64)."""
    return config_sha256(cfg)[:8]


def has_rounds(cfg: DictConfig) -> bool:
    """Whether the config has self-training that does something."""
    return not _without_rounds(OmegaConf.to_container(cfg.selftraining, resolve=False))


def run_name(cfg: DictConfig) -> str:
    """`<experiment_name>/seed<seed>-<hash>`, relative to `paths.log_dir`."""
    return f"{cfg.experiment_name}/seed{cfg.seed}-{config_hash(cfg)}"


def run_folder(cfg: DictConfig) -> Path:
    """The folder of the run that `cfg` describes, whether it exists or not."""
    return Path(cfg.paths.log_dir).resolve() / run_name(cfg)


def check_seed(seed: Any) -> int:
    """The seed, if it is a whole number >= 0 (0 is a seed like any other).

    Raises:
        ConfigError: it is not.
    """
    return whole("seed", seed, 0)


def read_metrics(folder: str | Path) -> dict[str, Any] | None:
    """The result of a finished run; None if the run is not finished."""
    return _read_json(Path(folder) / METRICS)


def write_metrics(folder: str | Path, metrics: Mapping[str, Any]) -> None:
    """Save the result, which also marks the run as finished."""
    write_json(Path(folder) / METRICS, metrics)


def read_started(folder: str | Path) -> dict[str, Any] | None:
    """What `write_started` saved; None if the run never got that far."""
    return _read_json(Path(folder) / STARTED)


def write_started(folder: str | Path, started: Mapping[str, Any]) -> None:
    """Note what a run was started with, so that it is never continued with something else."""
    write_json(Path(folder) / STARTED, started)


def check_data(folder: Path, domain: str, expected: str, found: str) -> None:
    """Refuse to continue, or to reuse, a run whose data have changed since.

    Raises:
        DataError: the hashes differ.
    """
    if found != expected:
        raise DataError(
            f"{folder} was begun with another version of {domain} ({expected[:12]}, now "
            f"{found[:12]}); bring the old data back, choose another experiment_name, or start "
            "again with force=true"
        )


def check_config(folder: Path, expected: str | None, found: str) -> None:
    """Refuse to continue, or to reuse, the run of another config (of the same 8 digits).

    Raises:
        ConfigError: the hashes differ.
    """
    if found != expected:
        raise ConfigError(
            f"{folder} holds a run with other settings (config hash {expected}, now {found}; they "
            "are in .hydra/config.yaml); choose another experiment_name, or start again with "
            "force=true"
        )


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


@contextlib.contextmanager
def locked(
    folder: str | Path,
    doing: str = "training in",
    advice: str = "wait for it, stop it, or choose another seed or experiment_name",
) -> Iterator[None]:
    """Own the folder until the block, or the process, ends (however it ends).

    Args:
        folder: made if it is not there.
        doing: what the other process does to the folder, for the message.
        advice: what to do about it.

    Raises:
        Qs3Error: another process owns it, or it cannot be made or written to.
    """
    folder = make_folder(folder)
    with _open_lock(folder / ".lock") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise Qs3Error(f"another process is {doing} {folder}; {advice}") from error
        yield


def check_idle(folder: Path) -> None:
    """Raise Qs3Error if another process trains in the folder, which need not be writable."""
    path = folder / ".lock"
    if not os.access(path, os.R_OK):
        return  # a copy, which nobody locks
    with open(path, "rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError as error:
            raise Qs3Error(
                f"another process is training in {folder}; wait for it or stop it"
            ) from error


def _open_lock(path: Path) -> BinaryIO:
    try:
        return open(path, "ab")
    except OSError as error:
        raise Qs3Error(
            f"cannot write {path} ({error}); check the permissions or choose another folder"
        ) from error


def _without_rounds(selftraining: Any) -> bool:
    if not isinstance(selftraining, dict):
        return True
    return selftraining.get("_target_") == _NO_ROUNDS or selftraining.get("rounds") == 0


def _read_json(path: Path) -> dict[str, Any] | None:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise DataError(f"{path} cannot be read ({error}); delete it or run with force=true") from (
            error
        )
