"""A method in a user's own file: `method=own method.file=my_method.py`.

Importing a file runs it, as it would in `python my_method.py`: the user has named it, and nothing
here makes a file of somebody else harmless. It is read once, and what is run are the bytes whose
SHA-256 is in the run's config: so the run's hash knows the method, and a file that was edited since
is another run, never the same one gone on with.
"""

from __future__ import annotations

import hashlib
import sys
import traceback
from pathlib import Path
from types import ModuleType
from typing import Any

from qs3.errors import ConfigError, MissingDataError
from qs3.methods.base import Method


def own(file: str, sha256: str, **settings: Any) -> Method:
    """The method of a file, which has one class derived from `Method` and its `loss`.

    Args:
        file: Python source; of more than one file only this one is in the hash.
        sha256: 64 hex digits, of the content that is meant.
        settings: of the class's `__init__`.

    Raises:
        MissingDataError: there is no such file.
        ConfigError: its content is another one, it cannot be imported, it has no such class or
            several, the settings are not its own, its `__init__` leaves out `Method`'s, or it
            asks for labels of the target.
    """
    path = Path(file).expanduser()
    try:
        source = path.read_bytes()
    except OSError as error:
        raise MissingDataError(f"method.file={file} cannot be read ({error})") from error
    if (found := hashlib.sha256(source).hexdigest()) != sha256:
        raise ConfigError(
            f"method.file={file} has changed since this run was asked for (SHA-256 {found[:12]}, "
            f"not {sha256[:12]}); give the command again: the new content is a run of its own"
        )
    cls = _class_of(_imported(path, source, sha256), file)
    try:
        method = cls(**settings)
    except TypeError as error:  # of an unknown setting, above all
        raise ConfigError(f"method.file={file}: {cls.__name__}: {error}") from error
    if "_modules" not in vars(method):  # torch's own words come later and name neither
        raise ConfigError(
            f"method.file={file}: {cls.__name__}.__init__ must begin with super().__init__()"
        )
    if method.labels != "source":
        raise ConfigError(
            f"method.file={file}: {cls.__name__}.labels is {method.labels!r}: a method of one's "
            "own gets labels of the source alone"
        )
    return method


def _imported(path: Path, source: bytes, sha256: str) -> ModuleType:
    """The file as a module that other modules can ask for by its name (dataclasses do)."""
    name = f"qs3_own_{sha256[:16]}"
    if name in sys.modules:
        return sys.modules[name]
    module = ModuleType(name)
    module.__file__ = str(path)
    sys.modules[name] = module
    try:
        exec(compile(source, str(path), "exec", dont_inherit=True), module.__dict__)
    except Exception as error:
        del sys.modules[name]
        frames = traceback.extract_tb(error.__traceback__)
        lines = [frame.lineno for frame in frames if frame.filename == str(path)]
        line = error.lineno if isinstance(error, SyntaxError) else lines[-1]
        raise ConfigError(
            f"method.file={path}, line {line}: {type(error).__name__}: {error}"
        ) from error
    return module


def _class_of(module: ModuleType, file: str) -> type[Method]:
    """The one class of a module that is a method and was not imported there."""
    found = [
        value
        for value in vars(module).values()
        if isinstance(value, type)
        and issubclass(value, Method)
        and value.__module__ == module.__name__
    ]
    if len(found) != 1 or found[0].loss is Method.loss:
        names = ", ".join(cls.__name__ for cls in found) or "none"
        raise ConfigError(
            f"method.file={file}: expected one class derived from qs3.methods.base.Method, with a "
            f"loss of its own; found {names}"
        )
    return found[0]
