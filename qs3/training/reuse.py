"""A finished run is the result of its command, unless what it was trained on has changed since.

Somebody who works on a method or a net runs it again and again, and the version of qs3 stays while
they do: so hashes of the code that a run executes are compared, too.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import inspect
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

from qs3.config import hashing
from qs3.errors import MissingDataError
from qs3.runs import folder as runs
from qs3.runs.metrics import RunMetrics, read_metrics
from qs3.store.store import is_finished
from qs3.training.run import Run, run_of

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
        from qs3.training.given import read_given  # and torch with it

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
