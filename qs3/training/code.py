"""What the code of a run was: somebody who works on a method or a net runs it again and again.

The version of qs3 stays while they do, and a checkpoint by code that has been edited since is none
of the present one's, nor is the result of a finished run.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import inspect
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

PACKAGES = (
    *("utils", "geometry", "datamodules", "models", "methods", "evaluation", "engine"),
    *("selftraining", "training"),
)
"""Those of qs3 whose code a warm-up runs."""

_GROUPS = ("data", "model", "method", "protocol", "callbacks")  # what is built of them is trained
_QS3 = "qs3's code"
_VERSIONED = ("qs3.", "torch.", "lightning.")  # by `PACKAGES`, or by their versions in started.json


def code_sha256(cfg: DictConfig) -> str:
    """64 hex digits over the Python files that a warm-up of this config runs.

    Those of `PACKAGES`, and of a class of one's own (`model._target_=my_nets.Net`) the file and all
    that lie in its folder. As they were when this process first asked, which runs them.
    """
    return _sha256(_own(cfg, _GROUPS), PACKAGES)


def files_sha256(cfg: DictConfig) -> dict[str, str]:
    """Hashes of all code that a run runs: of `PACKAGES`, of each folder of one's own.

    A selector's is among them, which no warm-up runs.
    """
    own = _own(cfg, (*_GROUPS, "selftraining"))
    return {_QS3: _sha256((), PACKAGES)} | {str(one): _sha256((one,), ()) for one in own}


def changed_files(known: Mapping[str, str]) -> dict[str, str]:
    """What was edited of `files_sha256`, and its hash now; nothing of one's own is imported."""
    now = {
        name: _sha256((), PACKAGES) if name == _QS3 else _sha256((Path(name),), ())
        for name in known
        if name == _QS3 or Path(name).is_dir()  # else it was on another machine
    }
    return {name: sha256 for name, sha256 in now.items() if sha256 != known[name]}


def _own(cfg: DictConfig, groups: Iterable[str]) -> tuple[Path, ...]:
    """Folders of what is somebody's own in these groups."""
    own = {_folder(target) for group in groups for target in _targets(cfg.get(group))}
    return tuple(sorted(folder for folder in own if folder is not None))


@functools.cache
def _sha256(own: tuple[Path, ...], packages: tuple[str, ...]) -> str:
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    # Of qs3 the bytes: to parse its 140 files would take a third of a second of each start.
    for name in packages:
        for file in sorted(root.joinpath(name).rglob("*.py")):
            _add(digest, file, file.read_bytes())
    for folder in own:
        for file in sorted(folder.glob("*.py")):
            _add(digest, file, _does(file))
    return digest.hexdigest()


def _add(digest: Any, file: Path, does: bytes) -> None:
    digest.update(f"{file.name} {hashlib.sha256(does).hexdigest()}\n".encode())


def _does(file: Path) -> bytes:
    """What one's own file says to Python: a comment or a line break more trains nothing anew."""
    data = file.read_bytes()
    try:
        return ast.dump(ast.parse(data)).encode()
    except (SyntaxError, ValueError):  # beside a net of one's own may lie what nobody imports
        return data


def _targets(node: Any) -> Iterator[str]:
    """All `_target_` of a part of a config that are somebody's own."""
    plain = OmegaConf.to_container(node, resolve=False) if OmegaConf.is_config(node) else node
    if isinstance(plain, dict):
        for key, value in plain.items():
            if key == "_target_" and not str(value).startswith(_VERSIONED):
                yield str(value)
            yield from _targets(value)
    elif isinstance(plain, list):
        for value in plain:
            yield from _targets(value)


def _folder(target: str) -> Path | None:
    """Where a class lies; None of one that is not written in Python, or cannot be imported."""
    try:
        file = inspect.getsourcefile(get_object(target))
    except Exception:  # whatever its module does; whoever builds it will say so
        return None
    return Path(file).resolve().parent if file else None
