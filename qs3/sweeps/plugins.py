"""Our sweepers in Hydra's list of plugins: it takes none from elsewhere.

Their names must begin with `hydra_plugins`. Hydra's own way, a namespace package of that name,
would be a second top-level package beside qs3.
"""

from __future__ import annotations

from typing import Any

from hydra.core.plugins import Plugins

from qs3.sweeps.listed_jobs import ListedJobs
from qs3.sweeps.search import LabelFreeSearch


def register() -> None:
    """Tell Hydra of our sweepers, before it looks for one."""
    known: dict[str, Any] = Plugins.instance().class_name_to_class
    for sweeper in (ListedJobs, LabelFreeSearch):
        known[f"hydra_plugins.qs3.{sweeper.__name__}"] = sweeper
