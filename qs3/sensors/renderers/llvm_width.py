"""How many rays Mitsuba's LLVM kernels take at once: the same with and without AVX-512.

By itself Dr.Jit takes 16 where there is AVX-512 and 8 elsewhere. Embree resolves ties by it, of
faces that lie in each other, as in many CAD meshes: some points in a hundred thousand change. The
instructions that kernels are compiled to make no difference on one processor. Python has no call
for the width, so Dr.Jit's own library is asked.
"""

from __future__ import annotations

import ctypes
import sys
from functools import cache
from pathlib import Path

WIDTH = 8
"""Every processor that Mitsuba's wheels run on can do it; of 16 some would emulate half."""

# Of drjit 1.5's llvm.h, as its compiler names them.
_GET_CPU, _GET_FEATURES = "_Z19jit_llvm_target_cpuv", "_Z24jit_llvm_target_featuresv"
_GET_WIDTH, _SET = "_Z21jit_llvm_vector_widthv", "_Z19jit_llvm_set_targetPKcS0_j"


def fix_width() -> int:
    """Take `WIDTH` rays at once from here on; returns how many are taken, 0 where nobody knows.

    That is so where this version of Dr.Jit has other calls. An LLVM variant of Mitsuba has to be
    active.
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


@cache
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
