"""A run's folder: its name, its lock, and whether it is finished. Imports nothing heavy.

A run is named by its experiment, its seed and a hash of its config, so the same command always
finds its own folder: it continues an unfinished run, and skips a finished one. `metrics.json` is
written last, and atomically: it is the mark of a finished run.

    <paths.log_dir>/<experiment_name>/seed<seed>-<hash>/
        .hydra/config.yaml   the composed config
        started.json         the hashes of the datasets, the versions, the config hash
        last.ckpt            everything needed to continue
        warmup_selected.pt   weights of the teacher of round 0;  warmup_last.pt, student.pt likewise
        round_03/pseudo_labels.csv
        history.csv          one row an epoch
        metrics.json         the result
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from qs3.data.domain import Domain
from qs3.errors import ConfigError, DataError, Qs3Error
from qs3.files import write_json
from qs3.selftraining.scheme import Phases, Scheme

METRICS = "metrics.json"
STARTED = "started.json"

# Keys that do not change a result: where things lie, what is shown, how data would be made, and the
# seed, which is in the folder's name. Everything else is hashed, so two different runs never share
# a folder. (Data made in another way have another hash, which `started.json` guards.)
_UNHASHED = (
    "seed",
    "paths",
    "logger",
    "hydra",
    "force",
    "callbacks.progress",
    *(
        f"data.{domain}.{key}"
        for domain in ("source", "target")
        for key in ("synthesis", "how_to_get", "make", "stand_in")
    ),
)
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


def config_hash(cfg: DictConfig) -> str:
    """8 hex digits over the composed config, without the keys that do not change a result.

    Interpolations are hashed as they are written: what they point to is hashed at its own place,
    or does not matter (`${paths.data_dir}/...`).
    """
    plain: Any = OmegaConf.to_container(cfg, resolve=False)
    for key in _UNHASHED:
        *parents, leaf = key.split(".")
        node = plain
        for parent in parents:
            node = (node or {}).get(parent)
        if isinstance(node, dict):
            node.pop(leaf, None)
    text = json.dumps(plain, sort_keys=True, ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


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
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ConfigError(f"seed must be a whole number >= 0, got {seed!r}; e.g. seed=0")
    return seed


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
def locked(folder: str | Path) -> Iterator[None]:
    """Own the folder until the block, or the process, ends (however it ends).

    Raises:
        Qs3Error: another process is training there.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / ".lock", "ab") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise Qs3Error(
                f"another process is training in {folder}; wait for it, stop it, "
                "or choose another seed or experiment_name"
            ) from error
        yield


def _read_json(path: Path) -> dict[str, Any] | None:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise DataError(f"{path} cannot be read ({error}); delete it or run with force=true") from (
            error
        )
