"""Datasets as commands name them, and clouds of them to be shown."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from qs3.config.compose import choices
from qs3.datasets.domain import Domain, compose_domain
from qs3.errors import ConfigError
from qs3.report.viewer import Part, Shown, drawn
from qs3.store.meta import MadeOf, ManifestRow, is_finished, read_manifest
from qs3.store.store import PointSet, open_pointset


@dataclass(frozen=True, eq=False)
class Opened:
    """A dataset, its manifest's rows (also of failed objects), and what to call it.

    `name` is short, for file names; `label` has title and symbol. `made_of` is the domain's, which
    knows how many clouds were published. `unit` is "m", or "" where it is not known.
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


def open_named(name: str, overrides: Mapping[str, str]) -> Opened:
    """Open a domain by the name of its config, or a store by its folder.

    Overrides are keys of the domain's config (`variant`, `published.folder`) or `paths.data_dir`;
    of a folder only `variant`.
    """
    if not is_finished(name) and (name in choices("domain") or not Path(name).exists()):
        domain = compose_domain(name, overrides)
        return opened_domain(domain, domain.open())
    if unknown := sorted({*overrides} - {"variant", "paths.data_dir"}):
        raise ConfigError(f"{', '.join(unknown)}: a dataset's folder takes variant= alone")
    folder, variant = Path(name).expanduser(), overrides.get("variant", "points")
    data = open_pointset(folder, variant)
    more = [variant] * (variant != "points") + ["simulated"] * bool(data.meta.get("simulated"))
    label = f"{data.name} ({', '.join(more)})" if more else data.name
    rows = tuple(read_manifest(folder))
    return Opened(data.name, label, folder, variant, data, rows, data.made_of)


def opened_domain(domain: Domain, data: PointSet) -> Opened:
    """A domain whose dataset is open."""
    rows = tuple(read_manifest(domain.folder))
    where = (domain.name, domain.label, domain.folder, domain.variant)
    return Opened(*where, data, rows, domain.made_of(data), "m" * (domain.unit == "metres"))


def chosen(data: PointSet, most: int, match: str = "") -> list[int]:
    """Positions of at most so many clouds whose ids hold `match`: as many of each class."""
    there = np.array([match in id_ for id_ in data.ids])
    groups = [data.labels == k for k in np.unique(data.labels)]
    members = [found for group in groups if len(found := np.flatnonzero(group & there))]
    taken: list[int] = []
    for i, own in enumerate(sorted(members, key=len)):  # what small classes leave, others get
        taken += drawn(own, -(-(most - len(taken)) // (len(members) - i)))
    return sorted(taken[:most], key=lambda i: (data.labels[i], i))


def part_of(opened: Opened, positions: Sequence[int]) -> Part:
    """Clouds of a dataset for the viewer, in this order."""
    data, kept = opened.data, opened.kept
    shown = []
    for i in positions:
        label = "" if data.labels[i] < 0 else data.classes[data.labels[i]]
        note = ", ".join(filter(None, (kept[i].origin, kept[i].more.get("tier", ""))))
        shown.append(Shown(data.ids[i], np.asarray(data.points[i]), label, note=note))
    about = f"{len(shown)} of {len(data)} clouds of {opened.label}, made of: {opened.made_of}"
    return Part(shown, about, opened.unit)
