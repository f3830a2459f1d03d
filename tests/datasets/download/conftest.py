import pytest

from qs3.datasets.download.fetching import Resuming
from tests.datasets.download.server import Site


@pytest.fixture
def site(monkeypatch):
    """A server without files; proxies of the surroundings are passed by, and nobody waits."""
    monkeypatch.setenv("no_proxy", "*")
    monkeypatch.setattr(Resuming, "tries", 4)
    monkeypatch.setattr(Resuming, "wait_s", 0.01)
    monkeypatch.setattr(Resuming, "timeout_s", 5.0)
    running = Site()
    yield running
    running.close()
