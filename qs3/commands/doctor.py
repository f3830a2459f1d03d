"""`qs3 doctor`: what works on this machine, and which system package would help.

Each check runs in a process of its own, because a library that does not fit (an unsuitable
LLVM, a missing X library) may end the process.
"""

import shutil
import subprocess
import sys
from importlib.util import find_spec
from typing import Annotated, NamedTuple


class Check(NamedTuple):
    """One thing that may be missing; `code` is Python that prints a line and ends with 0."""

    name: str
    code: str
    without: str
    packages: str = ""


BLENDER = Check(
    "Blender (bpy)",
    "import bpy; print(bpy.app.version_string)",
    "renderer=blender does not work; renderer=mitsuba does",
    "libxi6 libxxf86vm1 libxfixes3 libxrender1 libxkbcommon0 libsm6 libgl1 libegl1",
)
CHECKS = (
    *([BLENDER] if find_spec("bpy") else []),
    Check(
        "Mitsuba, fast variant",
        "from qs3.sensors.renderers.llvm import find_variant\n"
        "name = find_variant().variant; print(name); raise SystemExit(name.startswith('scalar'))",
        "Mitsuba falls back to scalar_rgb, 20 to 40 times slower",
        "libllvm19",
    ),
    Check("PyTorch", "import torch; print(torch.__version__)", "nothing can be trained"),
    Check("OpenCV", "import cv2; print(cv2.__version__)", "nothing can be matched"),
)


def doctor(*, install: Annotated[bool, "install missing Debian packages, as root"] = False) -> None:
    """What works on this machine, and which system package would help."""
    renderers = ["Mitsuba"]
    for check in CHECKS:
        works, text = run(check)
        if not works and check.packages and install and (apt := shutil.which("apt-get")):
            print(f"installing {check.packages}", flush=True)
            subprocess.run([apt, "update", "-qq"], check=False)
            subprocess.run([apt, "install", "-y", "-qq", *check.packages.split()], check=False)
            works, text = run(check)
        print(f"  {check.name:24} {'ok' if works else 'MISSING'}  {text}", flush=True)
        if not works:
            print(f"    without it: {check.without}")
            if check.packages:
                print(f"    to fix it: apt-get install {check.packages}")
        elif check is BLENDER:
            renderers.append("Blender")
    elsewhere = "; Blender of another interpreter: renderer=blender renderer.python=PATH"
    print(f"  renderers: {', '.join(renderers)}{elsewhere * (len(renderers) == 1)}")


def run(check: Check) -> tuple[bool, str]:
    """Whether it works, and its last line of output."""
    command = [sys.executable, "-c", check.code]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    except subprocess.TimeoutExpired:
        return False, "no answer within 5 minutes"
    lines = (done.stdout.strip() or done.stderr.strip()).splitlines()
    return done.returncode == 0, lines[-1] if lines else f"ended with status {done.returncode}"
