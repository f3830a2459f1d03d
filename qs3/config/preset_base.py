"""Where a preset that a command writes may not go: over one that it is made of."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from qs3.config.location import CONF
from qs3.errors import ConfigError
from qs3.utils.yamls import load_yaml

_FOLDER = re.compile(r"file://([^,\]'\"]+)")  # in hydra.searchpath=[file:///FOLDER]


def check_no_base(out: Path, group: str, base: str, words: Sequence[str] = ()) -> None:
    """Refuse to write a preset over one that it is made of: it would be made of itself.

    Presets are found by their names, so one that is called as its base is refused in any folder.

    Args:
        out: the file to be written; it has `base` in its defaults list.
        group: of both.
        base: name of the preset that it begins with.
        words: of the command line; more folders are in those that begin `hydra.searchpath=`.

    Raises:
        ConfigError: `out` is the file of `base` or of one in its defaults list, or has its name.
    """
    more = [word for word in words if word.lstrip("+").startswith("hydra.searchpath=")]
    folders = [CONF, *(Path(f) for word in more for f in _FOLDER.findall(word))]
    seen, names = set[str](), [base]
    while names:
        name = names.pop()
        files = [file for f in folders if (file := f / group / f"{name}.yaml").is_file()]
        if name == out.stem or any(file.resolve() == out.resolve() for file in files):
            what = f"{base} itself" if name == base else f"{name}, which {base} is made of"
            raise ConfigError(
                f"out={out} is {what}: its values would be lost, and the preset made of itself; "
                "give out= another name"
            )
        seen.add(name)
        for file in files[:1]:
            found = load_yaml(file.read_text("utf-8"), file)
            listed = found.get("defaults") if isinstance(found, dict) else None
            names += [one for one in listed or () if isinstance(one, str) and one not in seen]
