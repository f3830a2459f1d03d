"""Which Mitsuba variant runs on this machine, found out without risking the process.

Mitsuba's fast CPU variants compile their kernels with a system libLLVM, and some versions
of it (14 and 16 with mitsuba 3.9.1) abort the whole process. So every candidate first
renders a small scene in a child process. The answer is kept in the environment variable
`QS3_MITSUBA_PROBE`, so worker processes inherit it and do not probe again.
"""

import ctypes
import ctypes.util
import functools
import glob
import json
import os
import re
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from qs3.errors import RenderError

PROBE_VARIABLE = "QS3_MITSUBA_PROBE"
LIBRARY_VARIABLE = "DRJIT_LIBLLVM_PATH"

_FOLDERS = (
    "/usr/lib/*-linux-gnu", "/usr/lib/llvm-*/lib", "/usr/lib64", "/usr/lib64/llvm*/lib",
    "/usr/lib", "/usr/local/lib", "/opt/homebrew/opt/llvm*/lib",
)  # fmt: skip
_CHILD_TIMEOUT_S = 120.0
_CHILD_OK = "qs3-probe-ok"
_CHILD = f"""
import sys
from qs3.sensors.renderers.mitsuba import render_probe_scene
render_probe_scene(sys.argv[1])
print("{_CHILD_OK}")
"""


@dataclass(frozen=True)
class Probe:
    """A Mitsuba variant that works here, and the libLLVM that it needs, if any."""

    variant: str
    llvm_path: str | None = None


def libllvm_version(path: str) -> tuple[int, ...]:
    """Version in the name of a file: (19, 1) of libLLVM.so.19.1, () if there is none."""
    name = os.path.basename(os.path.realpath(path))
    match = re.search(r"LLVM-(\d+(?:\.\d+)*)", name) or re.search(r"\.so\.(\d+(?:\.\d+)*)", name)
    return tuple(int(part) for part in match.group(1).split(".")) if match else ()


def libllvm_candidates() -> list[str]:
    """Files of libLLVM to try: the user's own choice alone, else all installed, newest first."""
    chosen = os.environ.get(LIBRARY_VARIABLE)
    if chosen:
        return [chosen]
    found: dict[str, str] = {}  # real path -> path, so that links to one file are tried once
    for folder in _FOLDERS:
        for pattern in ("libLLVM*.so*", "libLLVM*.dylib"):
            for path in sorted(glob.glob(os.path.join(folder, pattern))):
                found.setdefault(os.path.realpath(path), path)
    return sorted(found, key=lambda real: (libllvm_version(real), real), reverse=True)


def cuda_may_work() -> bool:
    """Whether there is a CUDA library that may see a GPU."""
    hidden = os.environ.get("CUDA_VISIBLE_DEVICES") in ("", "-1")
    return not hidden and ctypes.util.find_library("cuda") is not None


def find_variant(variant: str = "auto") -> Probe:
    """The Mitsuba variant to use; RenderError if one that was asked for cannot run here.

    "auto": CUDA if there is a GPU that works, else LLVM with the newest libLLVM that works, else
    `scalar_rgb` (20 to 40x slower).
    """
    inherited = _inherited()
    if inherited is not None and variant in ("auto", inherited.variant):
        return inherited
    if variant == "auto":
        if cuda_may_work() and try_variant("cuda_ad_mono", None) is None:
            return _remember(Probe("cuda_ad_mono"))
        try:
            return _remember(_probe_llvm("llvm_ad_mono"))
        except RenderError:
            return _remember(Probe("scalar_rgb"))
    if variant.startswith("llvm_"):
        return _remember(_probe_llvm(variant))
    if variant.startswith("cuda_"):
        reason = "no libcuda found" if not cuda_may_work() else try_variant(variant, None)
        if reason is not None:
            raise RenderError(f"renderer.variant={variant} cannot run here: {reason}")
    return Probe(variant)


def try_variant(variant: str, llvm_path: str | None) -> str | None:
    """Render a small scene in a child process: None if that worked, else the reason why not."""
    environment = dict(os.environ)
    environment.pop(PROBE_VARIABLE, None)
    if llvm_path is not None:
        environment[LIBRARY_VARIABLE] = llvm_path
    # The child finds qs3 where this process found it, installed or not.
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    try:
        child = subprocess.run(
            [sys.executable, "-c", _CHILD, variant],
            env=environment,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_CHILD_TIMEOUT_S,
        )
    except subprocess.TimeoutExpired:
        return f"no answer within {_CHILD_TIMEOUT_S:.0f} s"
    if child.returncode == 0 and _CHILD_OK in child.stdout:
        return None
    printed = [line.strip() for line in child.stderr.splitlines() if line.strip()]
    last = printed[-1] if printed else "no message"
    reason = next((line for line in printed if "LLVM ERROR" in line), last)
    how = f"killed by signal {-child.returncode}" if child.returncode < 0 else "failed"
    return f"{how}: {reason[:300]}"


def _probe_llvm(variant: str) -> Probe:
    reasons = []
    for path in libllvm_candidates():
        reason = try_variant(variant, path)
        if reason is None:
            return Probe(variant, path)
        reasons.append(f"{path}: {reason}")
    raise RenderError(
        f"renderer.variant={variant} cannot run here ({'; '.join(reasons) or 'no libLLVM found'}): "
        f"apt install libllvm19, or name a libLLVM in {LIBRARY_VARIABLE}"
    )


def _inherited() -> Probe | None:
    """The answer of an earlier probe, of this process or of its parent."""
    if not os.environ.get(PROBE_VARIABLE):
        return None
    probe = Probe(**json.loads(os.environ[PROBE_VARIABLE]))
    # A library that has gone, or one that the user has chosen since, makes the answer stale.
    if probe.llvm_path is not None:
        chosen = os.environ.get(LIBRARY_VARIABLE) or probe.llvm_path
        if chosen != probe.llvm_path or not os.path.exists(probe.llvm_path):
            return None
    return probe


def _remember(probe: Probe) -> Probe:
    os.environ[PROBE_VARIABLE] = json.dumps(asdict(probe))
    return probe


WIDTH = 8
"""How many rays the LLVM kernels take at once: the same with and without AVX-512.

Alone Dr.Jit takes 16 where there is AVX-512 and 8 elsewhere. Embree resolves ties by it, of faces
that lie in each other, as in many CAD meshes: some points in a hundred thousand change."""

# Of drjit 1.5's llvm.h, as its compiler names them.
_GET_CPU, _GET_FEATURES = "_Z19jit_llvm_target_cpuv", "_Z24jit_llvm_target_featuresv"
_GET_WIDTH, _SET = "_Z21jit_llvm_vector_widthv", "_Z19jit_llvm_set_targetPKcS0_j"


def fix_width() -> int:
    """Let the active LLVM variant take `WIDTH` rays at once; returns how many it takes.

    0: not known, because this version of Dr.Jit has other calls.
    """
    import drjit as dr

    dr.eval(dr.llvm.Float(0.0) + 1)  # loads libLLVM
    library = _library()
    if library is None:
        return 0
    width, change = getattr(library, _GET_WIDTH), getattr(library, _SET)
    if width() != WIDTH:
        cpu, features = getattr(library, _GET_CPU)(), getattr(library, _GET_FEATURES)()
        change(cpu, features, WIDTH)
    return int(width())


@functools.cache
def _library() -> ctypes.CDLL | None:
    """Dr.Jit's core with all four calls; None where it has other ones."""
    import drjit as dr

    suffix = "dylib" if sys.platform == "darwin" else "so"
    try:
        library = ctypes.CDLL(str(Path(dr.__file__).parent / f"libdrjit-core.{suffix}"))
        for name in (_GET_CPU, _GET_FEATURES):
            getattr(library, name).restype = ctypes.c_char_p
        getattr(library, _GET_WIDTH).restype = ctypes.c_uint32
        change = getattr(library, _SET)
        change.restype, change.argtypes = None, (ctypes.c_char_p, ctypes.c_char_p, ctypes.c_uint32)
    except (OSError, AttributeError):
        return None
    return library
