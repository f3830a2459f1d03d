"""Hashes of the code that a run executes.

Somebody who works on a method or a net runs it again and again, and the version of qs3 stays while
they do: a checkpoint or a result by code that has been edited since is not that of the present one.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

PACKAGES = (
    *("utils", "geometry", "datamodules", "models", "methods", "evaluation", "engine"),
    *("kernels", "selftraining", "training"),
)
"""Those of qs3 whose code a training runs."""

_GROUPS = ("data", "model", "method", "protocol", "callbacks", "selftraining")
_QS3 = "qs3's code"
_VERSIONED = ("qs3.", "torch.", "lightning.")  # by `PACKAGES`, or by their versions


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
