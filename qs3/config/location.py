"""Where the config files are, and how the two Hydra commands are started from where we are.

In a checkout these are conf/, train.py and generate.py; a wheel holds conf/ as qs3/conf and
installs the commands as qs3-train and qs3-generate.
"""

import sys
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]
_INSTALLED = (PACKAGE / "conf").is_dir()
_ROOT = PACKAGE if _INSTALLED else PACKAGE.parent

CONF = _ROOT / "conf"


def python_command(name: str) -> list[str]:
    """Begin of a process's arguments that run `train` or `generate`, in any folder."""
    if _INSTALLED:
        return [sys.executable, "-m", f"qs3.commands.{name}"]
    return [sys.executable, str(_ROOT / f"{name}.py")]


def typed(text: str) -> str:
    """A text with commands such as `python train.py ...` as they are typed in this folder."""
    for name in ("train", "generate"):
        if _INSTALLED or not Path(f"{name}.py").is_file():
            text = text.replace(f"python {name}.py", f"qs3-{name}")
    return text
