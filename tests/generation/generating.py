"""How the tests of this folder call generate.py."""

import hashlib
import sys
from pathlib import Path

from tests.composing import compose

ROOT = Path(__file__).resolve().parents[2]
QUICK = [
    "sensor=speckle_stereo_small",
    "renderer.samples=2",
    "views=2",
    "classes=[chair,table,lamp]",
]


def composed(*overrides, name="generate"):
    return compose(name, overrides)


def config(data_dir, meshes=None, *overrides, domain="specklenet10"):
    where = [f"paths.data_dir={data_dir}", *([f"meshes={meshes}"] if meshes else [])]
    settings = QUICK[-1:] if domain.startswith("modelnet") else QUICK
    return composed(f"domain={domain}", *settings, *where, *overrides)


def command(data_dir, meshes, *overrides):
    return [
        sys.executable, "generate.py", "domain=specklenet10", *QUICK,
        f"paths.data_dir={data_dir}", f"meshes={meshes}", *overrides,
    ]  # fmt: skip


def fingerprint(folder):
    """Hash of every file of a finished dataset."""
    names = ("points.npy", "points_clean.npy", "manifest.csv", "meta.yaml", "clouds.png")
    return {n: hashlib.sha256((folder / n).read_bytes()).hexdigest() for n in names}
