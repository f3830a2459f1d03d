"""`qs3 doctor`: what works on this machine, and which system package would help.

Each check runs in a process of its own, because a library that does not fit (an unsuitable
LLVM, a missing X library) may end the process.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from typing import Annotated

BLENDER_PACKAGES = (
    *("libxi6", "libxxf86vm1", "libxfixes3", "libxrender1"),
    *("libxkbcommon0", "libsm6", "libgl1", "libegl1"),
)


@dataclass(frozen=True)
class Check:
    """One thing that may be missing.

    Attributes:
        name: what it is.
        code: Python that prints one line and exits with 0 if it works.
        without: what happens where it is missing.
        packages: Debian packages that bring it.
    """

    name: str
    code: str
    without: str
    packages: tuple[str, ...] = ()


CHECKS = (
    Check(
        "Blender (bpy)",
        "import bpy; print(bpy.app.version_string)",
        "renderer=blender does not work; renderer=mitsuba does",
        BLENDER_PACKAGES,
    ),
    Check(
        "Mitsuba, fast variant",
        "from qs3.sensors.renderers.llvm import find_variant\n"
        "name = find_variant().variant; print(name); raise SystemExit(name.startswith('scalar'))",
        "Mitsuba falls back to scalar_rgb, 20 to 40 times slower",
        ("libllvm19",),
    ),
    Check("PyTorch", "import torch; print(torch.__version__)", "nothing can be trained"),
    Check("OpenCV", "import cv2; print(cv2.__version__)", "nothing can be matched"),
)


def doctor(*, install: Annotated[bool, "install missing Debian packages, as root"] = False) -> None:
    """What works on this machine, and which system package would help."""
    for check in CHECKS:
        works, text = run(check)
        if not works and check.packages and install:
            works, text = (_install(check.packages) and run(check)) or (works, text)
        print(f"  {check.name:24} {'ok' if works else 'MISSING'}  {text}", flush=True)
        if not works:
            print(f"    without it: {check.without}")
            if check.packages:
                print(f"    to fix it: apt-get install {' '.join(check.packages)}")


def run(check: Check) -> tuple[bool, str]:
    """Whether it works, and its last line of output."""
    command = [sys.executable, "-c", check.code]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    except subprocess.TimeoutExpired:
        return False, "no answer within 5 minutes"
    lines = (done.stdout.strip() or done.stderr.strip()).splitlines()
    return done.returncode == 0, lines[-1] if lines else f"ended with status {done.returncode}"


def _install(packages: tuple[str, ...]) -> bool:
    """Try apt-get; False where it is missing or fails."""
    if (apt := shutil.which("apt-get")) is None:
        return False
    print(f"installing {' '.join(packages)}", flush=True)
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    subprocess.run([apt, "update", "-qq"], env=environment, check=False)
    install = [apt, "install", "-y", "-qq", *packages]
    return subprocess.run(install, env=environment, check=False).returncode == 0
