"""On another device than the CPU only benchmarks that take it are run."""

import pytest

from tests.benchmarks.device import DEVICE


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        module = getattr(item, "module", None)
        here = module is not None and module.__name__.startswith("tests.benchmarks.")
        if DEVICE.type != "cpu" and here and not hasattr(module, "DEVICE"):
            item.add_marker(pytest.mark.skip(reason="is of the CPU"))
