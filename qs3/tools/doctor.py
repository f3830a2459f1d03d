"""What works on this machine, and which system package would help: `qs3 doctor`.

Each check runs in a process of its own, because a library that does not fit (an unsuitable
LLVM, a missing X library) may end the process.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass

from qs3.utils.cli import FLAG, Command, Option

BLENDER_PACKAGES = (
    "libxi6",
    "libxxf86vm1",
    "libxfixes3",
    "libxrender1",
    "libxkbcommon0",
    "libsm6",
    "libgl1",
    "libegl1",
)


@dataclass(frozen=True)
class Check:
    """One thing that may be missing.

    Attributes:
        name: what it is.
        code: Python that prints one line and exits with 0 if it works.
        packages: Debian packages that bring it.
        without: what happens where it is missing.
    """

    name: str
    code: str
    packages: tuple[str, ...]
    without: str


CHECKS = (
    Check(
        "Blender (bpy)",
        "import bpy; print(bpy.app.version_string)",
        BLENDER_PACKAGES,
        "renderer=blender does not work; renderer=mitsuba does",
    ),
    Check(
        "Mitsuba, fast variant",
        "from qs3.sensors.renderers.llvm import find_variant\n"
        "name = find_variant().variant; print(name); raise SystemExit(name.startswith('scalar'))",
        ("libllvm19",),
        "Mitsuba falls back to scalar_rgb, 20 to 40 times slower",
    ),
    Check("PyTorch", "import torch; print(torch.__version__)", (), "nothing can be trained"),
    Check("OpenCV", "import cv2; print(cv2.__version__)", (), "nothing can be matched"),
)


def _doctor(install: bool) -> None:
    for check in CHECKS:
        works, text = run(check)
        if not works and check.packages and install and install_packages(check.packages):
            works, text = run(check)
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


def install_packages(packages: tuple[str, ...]) -> bool:
    """Try apt-get; False where it may not or cannot."""
    apt = shutil.which("apt-get")
    if apt is None or os.geteuid() != 0:
        print("    install=true needs apt-get, and root's rights")
        return False
    print(f"installing {' '.join(packages)}", flush=True)
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for arguments in (["update", "-qq"], ["install", "-y", "-qq", *packages]):
        done = subprocess.run([apt, *arguments], env=environment, capture_output=True, check=False)
        if done.returncode and arguments[0] == "install":
            return False
    return True


DOCTOR = Command(
    "qs3 doctor",
    "what works on this machine, and which system package would help",
    _doctor,
    (Option("install", FLAG, "install missing Debian packages, as root", False),),
    ("qs3 doctor", "qs3 doctor install=true"),
)
