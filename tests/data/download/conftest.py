import pytest

from tests.data.download.server import Site


@pytest.fixture
def site(monkeypatch):
    """A server without files; proxies of the surroundings are passed by."""
    monkeypatch.setenv("no_proxy", "*")
    running = Site()
    yield running
    running.close()
