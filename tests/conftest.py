"""What all tests share."""

import gc
import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

_SLOW_S = 2400

# One thread a process: tests start many short ones, and two OpenMP teams on two cores spend
# their time waiting for each other. Set before anything imports torch.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Pictures need no screen.
os.environ.setdefault("MPLBACKEND", "Agg")

# How long an example takes says how busy the machine is, not whether the code is right.
settings.register_profile("qs3", deadline=None)
settings.load_profile("qs3")

if os.environ.get("QS3_CHECK_SHAPES"):  # `make test-all`
    from jaxtyping import install_import_hook

    checked = ("geometry.neighbours", "geometry.sampling", "models", "methods")
    checked += ("datamodules.augment", "evaluation.metrics")
    install_import_hook([f"qs3.{name}" for name in checked], "beartype.beartype")


@pytest.hookimpl(tryfirst=True)  # before pytest leaves out what is marked
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give slow tests the time that a busy machine takes; leave out Blender where it is not."""
    for item in items:
        if item.get_closest_marker("blender") and find_spec("bpy") is None:
            item.add_marker(pytest.mark.skip(reason="there is no bpy for this Python"))
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(_SLOW_S))


def pytest_collection_finish(session: pytest.Session) -> None:
    """The collector need not look through the imported libraries again and again: they stay."""
    gc.collect()
    gc.freeze()


# The toy of tests/training, for all tests. A fixture that modules import is made for each of them.


@pytest.fixture(scope="session")
def toy_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder `data` with the two toy domains, written once."""
    from tests.training.toy import write_toy

    folder = tmp_path_factory.mktemp("toy")
    write_toy(folder / "data")
    return folder / "data"


@pytest.fixture
def toy(toy_data: Path, tmp_path: Path):
    """Composes the config of a toy run whose logs lie in this test's folder."""
    from tests.training.toy import toy_config

    def config(*more: str) -> Any:
        return toy_config(tmp_path, f"paths.data_dir={toy_data}", *more)

    return config


@pytest.fixture(scope="session")
def finished(toy_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the toy run with seed 0, never interrupted."""
    from qs3.config.hydra import run_folder
    from qs3.training.command import train
    from tests.training.toy import toy_config

    cfg = toy_config(tmp_path_factory.mktemp("finished"), f"paths.data_dir={toy_data}")
    train(cfg)
    return run_folder(cfg)
