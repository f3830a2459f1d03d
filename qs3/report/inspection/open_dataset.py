"""From the words of a command line to a dataset: a domain's config, or the folder of a store."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from qs3.config.compose import choices
from qs3.datasets.domain import Domain, compose_domain
from qs3.errors import ConfigError
from qs3.store.manifest import ManifestRow, read_manifest
from qs3.store.meta import MadeOf
from qs3.store.store import PointSet, is_finished, open_pointset


@dataclass(frozen=True, eq=False)
class Opened:
    """A dataset, its manifest's rows (also of failed objects), and what to call it.

    `name` is short, for file names; `label` has title and symbol. `made_of` is the domain's word,
    which knows how many clouds were published; a folder's store has only its own. `unit` is "m",
    or "" where nobody knows.
    """

    name: str
    label: str
    folder: Path
    variant: str
    data: PointSet
    rows: tuple[ManifestRow, ...]
    made_of: MadeOf
    unit: str = ""

    @property
    def kept(self) -> list[ManifestRow]:
        """The rows of the clouds, in order."""
        return [row for row in self.rows if row.status == "ok"]

    @property
    def twin(self) -> PointSet | None:
        """The clean twins of these clouds, if the store has them."""
        if self.variant == "points_clean" or "points_clean" not in self.data.meta["sha256"]:
            return None
        return open_pointset(self.folder, "points_clean", verify=False)


def open_named(name: str, overrides: Mapping[str, str]) -> Opened:
    """Open a domain by the name of its config, or a store by its folder.

    Overrides are keys of the domain's config (`variant`, `published.folder`) or `paths.data_dir`;
    for a folder only `variant`.

    Raises:
        ConfigError: there is no such domain, or no such key.
        MissingDataError: the domain's files are not there.
        DataError: they are damaged.
    """
    if _is_path(name):
        if unknown := sorted(set(overrides) - {"variant", "paths.data_dir"}):
            raise ConfigError(f"{', '.join(unknown)}: a folder of a dataset takes variant= only")
        folder, variant = Path(name).expanduser(), overrides.get("variant", "points")
        data = open_pointset(folder, variant)
        more = [variant] * (variant != "points") + ["simulated"] * bool(data.meta.get("simulated"))
        label = f"{data.name} ({', '.join(more)})" if more else data.name
        rows = tuple(read_manifest(folder, data.classes))
        return Opened(data.name, label, folder, variant, data, rows, data.made_of)
    domain = compose_domain(name, overrides)
    domain.tell_of_judging()
    return opened_domain(domain, domain.open())


def _is_path(name: str) -> bool:
    """Whether a place is meant; a domain's name stays one beside a file or folder called so."""
    if is_finished(name) or "/" in name or name.startswith((".", "~")):
        return True
    return name not in choices("domain") and Path(name).exists()


def opened_domain(domain: Domain, data: PointSet) -> Opened:
    """A domain whose dataset is open."""
    unit = "m" if domain.unit == "metres" else ""
    rows = tuple(read_manifest(domain.folder, data.classes))
    where = (domain.name, domain.label, domain.folder, domain.variant)
    return Opened(*where, data, rows, domain.made_of(data), unit)
