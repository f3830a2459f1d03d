"""What several tests of the report share."""

import pytest

from qs3.report.tables import build_table, table_names


@pytest.fixture(scope="session")
def empty(tmp_path_factory):
    """All tables without any runs, by name."""
    log_dir = tmp_path_factory.mktemp("logs")
    return {name: build_table(name, log_dir) for name in table_names()}
