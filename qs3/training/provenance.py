"""What a run notes when it starts, and compares when it goes on or is asked for again.

A finished run is the result of its command, unless its data, its settings or its classifier have
changed since. Somebody who works on a method or a net runs it again and again, and the version of
qs3 stays while they do: so hashes of the code that a run executes are compared, too. Imports no
torch before it is needed.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import inspect
import logging
import os
import platform
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

from qs3.config import hashing
from qs3.errors import MissingDataError
from qs3.runs import folder as runs
from qs3.runs.metrics import RunMetrics, read_metrics
from qs3.store.store import PointSet, is_finished
from qs3.training.run import Run, run_of
from qs3.utils.files import remove_leftovers
from qs3.utils.version import VERSION, commit

if TYPE_CHECKING:
    from qs3.training.given import Given

log = logging.getLogger(__name__)

WEIGHTS = "the classifier that weights= names"


def note_start(
    run: Run, source: PointSet, target: PointSet, given: Given | None = None
) -> dict[str, Any]:
    """Read `started.json` and compare it with today's data, or write it; `force` begins anew."""
    import torch

    from qs3.datamodules.fps_samples import remove_old_leftovers
    from qs3.runs.checkpoints import LAST

    weights = {"weights": f"{given.name} {given.sha256}"} if given else {}
    now: dict[str, Any] = {
        "data": {"source": source.sha256, "target": target.sha256},
        "versions": versions() | weights,
        "commit": commit(),
        "files": files_sha256(run.cfg),
        "threads": torch.get_num_threads(),
        "config_sha256": hashing.config_sha256(run.cfg),
    }
    if int(os.environ.get("LOCAL_RANK", 0)) > 0:
        first = runs.read_started(run.folder) or {}
        assert first.get("config_sha256") == now["config_sha256"], "conf/ changed during the start"
        return {**now, "threads": first.get("threads")}
    if run.cfg.force:  # not before: without its data an old result would be lost for nothing
        runs.clear(run.folder)
    for folder in (run.folder, *run.folder.glob("round_*")):
        remove_leftovers(folder)
    if run.cfg.data.cache_dir:
        remove_old_leftovers(Path(run.cfg.data.cache_dir))
    started = runs.read_started(run.folder)
    if started is not None:
        compare(run.folder, started, now)
        if (run.folder / LAST).is_file():
            return started
    runs.write_started(run.folder, now)
    return now


def compare(folder: Path, started: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Refuse to continue the run in a folder with other settings, data or another classifier.

    Raises:
        ConfigError, DataError: something differs.
    """
    runs.check_config(folder, started.get("config_sha256"), now["config_sha256"])
    for role in ("source", "target"):
        runs.check_data(folder, f"data.{role}", started["data"][role], now["data"][role])
    runs.check_data(folder, WEIGHTS, given_sha256(started), given_sha256(now))


def given_sha256(started: Mapping[str, Any]) -> str:
    """Of the classifier that a run was begun with; "" without one."""
    return started["versions"].get("weights", "").rpartition(" ")[2]


def versions() -> dict[str, str]:
    """Of what decides a result besides settings and data."""
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


def warn_of_changes(started: Mapping[str, Any]) -> None:
    """Warn if a run goes on with other code, versions or threads than it was begun with."""
    if found := changed(started):
        log.warning(
            "begun with %s, continued with %s: the result may differ from an uninterrupted run's",
            ", ".join(f"{name} {was}" for name, (was, _) in found.items()),
            ", ".join(f"{name} {now}" for name, (_, now) in found.items()),
        )


PACKAGES = (
    *("utils", "geometry", "datamodules", "models", "methods", "evaluation", "engine"),
    *("kernels", "selftraining", "training"),
)
"""Those of qs3 whose code a training runs."""

_GROUPS = ("data", "model", "method", "protocol", "callbacks", "selftraining")
_QS3 = "qs3's code"
_VERSIONED = ("qs3.", "torch.", "lightning.")  # by `PACKAGES`, or by their versions


def check_finished(cfg: DictConfig, instead: str = runs.ANEW) -> bool:
    """Whether the run that `cfg` describes is finished.

    `instead`: of bringing the old data back, for people.

    Raises:
        DataError, ConfigError: it is, and its data, its classifier or its settings have changed.
    """
    run = run_of(cfg)
    metrics = read_metrics(run.folder)
    if metrics is not None:
        refuse_changed(run, metrics, instead)
    return metrics is not None


def refuse_changed(run: Run, metrics: RunMetrics, instead: str = runs.ANEW) -> None:
    """Raise if what is there is not what the finished run used; datasets may have been put away.

    Raises:
        DataError, ConfigError: names what it is.
    """
    now = hashing.config_sha256(run.cfg)
    runs.check_config(run.folder, metrics.config_sha256, now, instead)
    used = {"source": run.source, "target": run.target}
    if run.is_upper_bound:
        del used["source"]
    for role, domain in used.items():
        if is_finished(domain.folder):
            was, now = getattr(metrics.data, role), domain.open(verify=False).sha256
            runs.check_data(run.folder, domain.name, was, now, instead)
    if run.cfg.weights is not None:
        from qs3.training.given import read_given

        name, _, sha256 = metrics.versions.get("weights", "").rpartition(" ")
        with contextlib.suppress(MissingDataError):
            given = read_given(run.cfg)
            assert given is not None
            runs.check_data(run.folder, f"the classifier {name}", sha256, given.sha256, instead)


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
    folders = [root / name for name in PACKAGES]
    for folder in folders if own is None else [own]:
        for file in sorted(folder.glob("*.py") if own else folder.rglob("*.py")):
            sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
            digest.update(f"{file.name} {sha256}\n".encode())
    return digest.hexdigest()


def _targets(node: Any) -> Iterator[str]:
    """All `_target_` of a part of a config that are the user's own."""
    plain = OmegaConf.to_container(node, resolve=False) if OmegaConf.is_config(node) else node
    if isinstance(plain, dict):
        if (target := str(plain.get("_target_", "qs3."))) and not target.startswith(_VERSIONED):
            yield target
        plain = list(plain.values())
    for value in plain if isinstance(plain, list) else ():
        yield from _targets(value)


def _folder(target: str) -> Path | None:
    """Where a class lies; None if it is not written in Python, or cannot be imported."""
    try:
        file = inspect.getsourcefile(get_object(target))
    except Exception:  # whatever its module does; building it raises the same
        return None
    return Path(file).resolve().parent if file else None
