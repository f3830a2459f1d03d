"""A method in a user's own file: `method=own method.file=my_method.py`.

Importing a file runs it, as it would in `python my_method.py`: the user has named it, and nothing
here makes a file of somebody else harmless. It is read once, and what is run are the bytes whose
SHA-256 is in the run's config: so the run's hash knows the method, and an edited file is another
run, never the same one gone on with.
"""

import hashlib
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from qs3.errors import ConfigError
from qs3.methods.base import Method
from qs3.utils.files import reading


def own(file: str, sha256: str, **settings: Any) -> Method:
    """The method of a file, which has one class derived from `Method`.

    Args:
        file: Python source; of more than one file only this one is in the hash.
        sha256: 64 hex digits, of the content that is meant.
        settings: of the class's `__init__`.

    Raises:
        MissingDataError: the file does not exist.
        ConfigError: its content is another one, it has no such class or several, or it asks for
            labels of the target.
    """
    path = Path(file).expanduser()
    with reading(path):
        source = path.read_bytes()
    if hashlib.sha256(source).hexdigest() != sha256:
        raise ConfigError(f"method.file={file} has changed since this run was asked for")
    module = _imported(path, source, sha256)
    found = [
        value
        for value in vars(module).values()
        if isinstance(value, type)
        and issubclass(value, Method)
        and value.__module__ == module.__name__
    ]
    if len(found) != 1 or found[0].labels != "source":
        raise ConfigError(
            f"method.file={file} must have one class derived from qs3.methods.base.Method, of "
            f"labels of the source; found {', '.join(cls.__name__ for cls in found) or 'none'}"
        )
    return found[0](**settings)


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
    except BaseException:
        del sys.modules[name]
        raise
    return module
