"""What a run notes when it starts, and compares when it goes on or is asked for again.

A finished run is the result of its command, unless its data, its settings or its classifier have
changed since: hashes of the code that a run executes are compared, too, as the version stays while
somebody works on a method. Imports no torch before it is needed.
"""

import contextlib
import functools
import hashlib
import inspect
import logging
import os
import platform
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hydra.utils import get_object
from omegaconf import DictConfig, ListConfig, OmegaConf

from qs3.config.hydra import config_sha256
from qs3.errors import MissingDataError
from qs3.runs import folder as runs
from qs3.runs.metrics import RunMetrics
from qs3.store.meta import is_finished
from qs3.store.store import PointSet
from qs3.training.run import Run
from qs3.utils.files import remove_leftovers, sha256_file
from qs3.utils.version import VERSION, commit

log = logging.getLogger(__name__)


def note_start(run: Run, source: PointSet, target: PointSet) -> dict[str, Any]:
    """Read `started.json` and compare it with today's data, or write it; `force` begins anew.

    Raises:
        ConfigError, DataError: the run was begun with other settings or data.
    """
    import torch

    from qs3.runs.checkpoints import LAST

    weights = {"weights": _weights(run.cfg)} if run.cfg.weights is not None else {}
    now: dict[str, Any] = {
        "data": {"source": source.sha256, "target": target.sha256},
        "versions": versions() | weights,
        "commit": commit(),
        "files": files_sha256(run.cfg),
        "threads": torch.get_num_threads(),
        "config_sha256": config_sha256(run.cfg),
    }
    if int(os.environ.get("LOCAL_RANK", 0)) > 0:
        first = runs.read_started(run.folder) or {}
        assert first.get("config_sha256") == now["config_sha256"], "conf/ changed during the start"
        return {**now, "threads": first.get("threads")}
    if run.cfg.force:  # not before: without its data an old result would be lost for nothing
        runs.clear(run.folder)
    for folder in (run.folder, *run.folder.glob("round_*")):
        remove_leftovers(folder)
    started = runs.read_started(run.folder)
    if started is not None:
        folder = run.folder
        runs.check_config(folder, started.get("config_sha256"), now["config_sha256"])
        for role in ("source", "target"):
            runs.check_data(folder, f"data.{role}", started["data"][role], now["data"][role])
        was, is_now = (_sha256_of(one["versions"]) for one in (started, now))
        runs.check_data(folder, "the classifier that weights= names", was, is_now)
        if (run.folder / LAST).is_file():
            return started
    runs.write_started(run.folder, now)
    return now


def _weights(cfg: DictConfig) -> str:
    """Name and SHA-256 of the classifier that a run begins with."""
    from qs3.inference.model_file import read_result
    from qs3.runs.checkpoints import weights_sha256

    return f"{Path(cfg.weights).name} {weights_sha256(read_result(cfg.weights).weights)}"


def _sha256_of(versions: Mapping[str, str]) -> str:
    """SHA-256 of the classifier; "" without one."""
    return versions.get("weights", "").rpartition(" ")[2]


def versions() -> dict[str, str]:
    """Versions of what decides a result besides settings and data."""
    import lightning
    import numpy as np
    import torch

    return {
        "qs3": VERSION,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "lightning": lightning.__version__,
        "numpy": np.__version__,
    }


def changed(started: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """What differs from the start by name, as it was and as it is: code, versions, threads."""
    import torch

    now: dict[str, Any] = versions() | {"threads": torch.get_num_threads()}
    begun = {name: value for name, value in started["versions"].items() if name != "weights"}
    begun["threads"] = started.get("threads")
    for name, sha256 in changed_files(started["files"]).items():
        begun[name], now[name] = started["files"][name][:12], sha256[:12]
    names = [name for name in {**begun, **now} if begun.get(name) != now.get(name)]
    return {name: (begun.get(name), now.get(name)) for name in names}


PACKAGES = (
    *("utils", "geometry", "datamodules", "models", "methods", "evaluation", "engine"),
    *("kernels", "selftraining", "training"),
)
"""Those of qs3 whose code a training runs."""

_GROUPS = ("data", "model", "method", "protocol", "callbacks", "selftraining")
_QS3 = "qs3's code"
_VERSIONED = ("qs3.", "torch.", "lightning.")  # by `PACKAGES`, or by their versions


def refuse_changed(run: Run, metrics: RunMetrics) -> None:
    """Raise if what is there is not what the finished run used; datasets may have been put away.

    Raises:
        DataError, ConfigError: names what it is.
    """
    now = config_sha256(run.cfg)
    runs.check_config(run.folder, metrics.config_sha256, now)
    used = {"source": run.source, "target": run.target}
    if run.is_upper_bound:
        del used["source"]
    for role, domain in used.items():
        if is_finished(domain.folder):
            was, now = getattr(metrics.data, role), domain.open(verify=False).sha256
            runs.check_data(run.folder, domain.name, was, now)
    if run.cfg.weights is not None:
        with contextlib.suppress(MissingDataError):
            name, _, sha256 = _weights(run.cfg).rpartition(" ")
            was = _sha256_of(metrics.versions)
            runs.check_data(run.folder, f"the classifier {name}", was, sha256)


def files_sha256(cfg: DictConfig) -> dict[str, str]:
    """Hashes of all code that a run executes: of `PACKAGES`, and of each folder of the user's own.

    As it was when this process first asked, which executes it.
    """
    own = {_folder(target) for group in _GROUPS for target in _targets(cfg.get(group))}
    return {_QS3: _sha256(None)} | {str(one): _sha256(one) for one in sorted(filter(None, own))}


def changed_files(known: Mapping[str, str]) -> dict[str, str]:
    """What was edited of `files_sha256`, and its hash now; nothing of the user's is imported."""
    now = {
        name: _sha256(None if name == _QS3 else Path(name))
        for name in known
        if name == _QS3 or Path(name).is_dir()  # else it was on another machine
    }
    return {name: sha256 for name, sha256 in now.items() if sha256 != known[name]}


@functools.cache
def _sha256(own: Path | None) -> str:
    """64 hex digits over the Python files of a folder; None: of `PACKAGES`."""
    root, digest = Path(__file__).resolve().parents[1], hashlib.sha256()
    files = sorted(own.glob("*.py")) if own else []
    for name in () if own else PACKAGES:
        files += sorted((root / name).rglob("*.py"))
    for file in files:
        digest.update(f"{file.name} {sha256_file(file)}\n".encode())
    return digest.hexdigest()


def _targets(node: Any) -> Iterator[str]:
    """All `_target_` of a part of a config that are the user's own."""
    if isinstance(node, DictConfig | ListConfig):
        node = OmegaConf.to_container(node, resolve=False)
    if isinstance(node, dict):
        target = str(node.get("_target_", "qs3."))
        if not target.startswith(_VERSIONED):
            yield target
        node = list(node.values())
    for value in node if isinstance(node, list) else ():
        yield from _targets(value)


def _folder(target: str) -> Path | None:
    """Where a class lies; None if it is not written in Python, or cannot be imported."""
    try:
        file = inspect.getsourcefile(get_object(target))
    except Exception:  # whatever its module does; building it raises the same
        return None
    return Path(file).resolve().parent if file else None
