"""Arrays of a store that are trained on beside its clouds: twins, single views. Without torch."""

from __future__ import annotations

import itertools

from qs3.config.location import typed
from qs3.datasets.domain import Domain
from qs3.errors import ConfigError
from qs3.store.meta import sha256_of
from qs3.store.store import PointSet

SOURCE_TWINS = {"whole": "points_whole", "clean": "points_clean", "scan": None}
"""What a teacher can see of a source cloud, and the store's array; None: the cloud itself."""


def beside_sha256(domain: Domain, twin: str | None, verify: bool) -> str:
    """64 hex digits over what is loaded beside a domain's clouds; "" if nothing is.

    Args:
        domain: whose `views` says whether single views are.
        twin: one of `SOURCE_TWINS`; None: no twins.
        verify: whether the files are compared with their hashes.

    Raises:
        DataError, ConfigError: the store has no such arrays; says how to get them.
    """
    beside: list[PointSet] = []
    if twin and (array := SOURCE_TWINS[twin]):
        beside.append(domain.open_array(array, verify))
    if domain.views == "random":
        beside += itertools.chain(*views_of(domain, verify))
    return sha256_of(" ".join(one.sha256 for one in beside)) if beside else ""


def views_of(domain: Domain, verify: bool) -> tuple[list[PointSet], list[PointSet]]:
    """The views that a domain's store keeps, and their clouds without error, where it has them.

    Of a store without single views its clouds are the only view.

    Raises:
        ConfigError: there is neither more than a view nor a cloud without error: nothing to draw.
    """
    names = domain.kept_views() or ["points"]
    measured = [domain.open_array(name, verify) for name in names]
    exact = [f"{name}_exact" for name in names]
    known = domain.has_array(exact[0])
    if len(names) == 1 and not known:
        raise ConfigError(
            f"data.source.views=random: the store of {domain.name} keeps neither views nor clouds "
            "without error. Generate it again with them: "
            + typed(f"python generate.py domain={domain.name} force=true twins=[views,exact]")
            + ", or twins=[exact] if it has one view; its clouds will be the same"
        )
    return measured, [domain.open_array(name, verify) for name in exact] if known else []
