"""A domain: one dataset as an experiment sees it, whether generated here or published by others.

Light on purpose: `train.py` asks `Domain.check` before it imports anything heavy.
"""

import logging
import os
import shlex
import subprocess
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from qs3.classes import class_list
from qs3.config.compose import composed
from qs3.config.location import python_command, typed
from qs3.datasets.importing import Importer, import_into
from qs3.errors import ConfigError, DataError, MissingDataError, Qs3Error
from qs3.store.meta import MadeOf, is_begun, is_finished, read_meta
from qs3.store.store import HEIGHTS, PointSet, open_pointset
from qs3.utils.settings import settings

log = logging.getLogger(__name__)


@settings
class Domain:
    """Where a dataset is, what it is called, and what to do if it is not there.

    Attributes:
        name, symbol, title: on the command line, in the paper's tables, and in a sentence:
            "specklenet10", "S", "SpeckleNet10".
        path: folder of the store.
        variant: which array of the store: "points", or "points_clean" for the clean twin.
        twin_of: folder of a store that holds the same objects, and `variant` next to its clouds, if
            that store was generated; what `path` holds itself comes first.
        published: how to read the published files, if there are any: an `Importer`, or its
            config (instantiated when it is needed).
        simulated: the target's reality is simulated; every output about it says so.
        gravity: the axis that points up in the store: "z"; or "none" for clouds in the frame of
            their camera, which training should not turn about z (protocol.augment.rotate_z=false).
        unit: of the store's coordinates, "metres"; or "none": sizes mean nothing or are not known.
        floor_m: z of the floor in the store: 0 where objects stand on it, minus the camera's height
            where the camera is the origin; None: not known.
        classes: names in label order; "modelnet40"; None: the ten of the benchmark.
        expected_counts: clouds of each class, in label order, by split, as published.
        how_to_get: where the published files come from.
        make, stand_in: commands that make the dataset, if one can, and something to try instead.
        synthesis: settings of `generate.py`, not used here.
    """

    name: str
    symbol: str
    title: str
    path: Path
    variant: Literal["points", "points_clean"] = "points"
    twin_of: Path | None = None
    published: Any = None
    simulated: bool = False
    gravity: Literal["z", "none"] = "z"
    unit: Literal["metres", "none"] = "none"
    floor_m: float | None = None
    how_to_get: str = ""
    make: str | None = None
    stand_in: str | None = None
    synthesis: Any = None
    classes: str | list[str] | None = None
    expected_counts: dict[str, list[int]] | None = None

    def __post_init__(self) -> None:
        if len(set(self.names)) < max(1, len(self.names)):
            raise ConfigError(f"domain {self.name}: classes are {self.names}: empty or twice")

    @property
    def names(self) -> tuple[str, ...]:
        """The classes in label order."""
        return class_list(self.classes)

    @property
    def folder(self) -> Path:
        """The store's folder as an absolute path."""
        own = self.path.absolute()
        if self.twin_of is None or is_finished(own) or is_begun(own):
            return own
        other = self.twin_of.absolute()
        has_variant = is_finished(other) and (other / f"{self.variant}.npy").is_file()
        return other if has_variant else own

    @property
    def label(self) -> str:
        """How tables and logs call it: title and symbol, and "simulated" where that is so."""
        return f"{self.title} ({self.symbol}{', simulated' if self.simulated else ''})"

    def importer(self) -> Importer | None:
        """The reader of the published files, instantiated from its config if need be."""
        if self.published is None or isinstance(self.published, Importer):
            return self.published
        from qs3.config.hydra import build

        importer: Importer = build(self.published)
        return importer

    def check_scale(self, scale: str) -> None:
        """Raise ConfigError if a net cannot see the clouds at this scale (`data.scale`)."""
        lacks = "unit=metres" if scale != "unit_ball" and self.unit != "metres" else ""
        if scale in HEIGHTS and self.floor_m is None:
            lacks = lacks or "floor_m"
        if lacks:
            raise ConfigError(f"data.scale={scale}: set {lacks} of domain {self.name}")

    def check(self) -> Importer | None:
        """Find out, in milliseconds, whether `open` has something to open; returns `importer()`.

        Raises:
            MissingDataError: what was looked for, where to get it, and the commands.
            DataError: a dataset that was made here and the published files are both there.
        """
        importer = self.importer()
        there = importer is not None and importer.is_there()
        if is_finished(self.folder):
            if importer and there and "imported" not in read_meta(self.folder):
                raise DataError(
                    f"domain {self.name}: there are two datasets, {self.folder}, which was made "
                    f"here, and {importer.root}: move one away, or set published=null"
                )
        elif not there:
            looked = [self.folder / "meta.yaml"]
            if importer:
                looked += importer.files() or [importer.root / importer.holds]
            places = " and ".join(map(str, looked))
            lines = {
                f"domain {self.name}: {self.label} is not there. Looked for": places,
                "Where to get it": self.how_to_get.strip(),
                "Make it": self.make,
                "Or make a stand-in": self.stand_in,
            }
            text = "\n".join(f"{what}:\n  {how}" for what, how in lines.items() if how)
            raise MissingDataError(typed(text))
        return importer

    def open(self, verify: bool = True) -> PointSet:
        """Open the dataset; the first time, bring the published files into the store.

        Raises:
            MissingDataError: as `check`.
            DataError: damaged files, or a store imported under other settings.
        """
        importer = self.check()
        if not is_finished(self.folder):
            assert importer is not None  # `check` passed
            log.info("importing %s from %s", self.label, importer.root)
            import_into(self.folder, importer, name=self.folder.name, classes=self.names)
        elif importer is not None:
            self._refuse_stale(importer)
        dataset = open_pointset(self.folder, self.variant, verify=verify)
        if self.classes is not None and dataset.classes != self.names:
            raise DataError(f"{self.folder} has the classes {dataset.classes}, not {self.names}")
        if "imported" in dataset.meta and (other := self._other_counts(dataset)):
            log.warning("%s: other numbers of clouds than published: %s", self.label, other)
        return replace(dataset, floor_m=self.floor_m)

    def check_unpublished(self) -> None:
        """Raise DataError if published files are there: a dataset made here would pass for them."""
        importer = self.importer()
        if importer is not None and importer.is_there():
            raise DataError(
                f"{importer.root} holds published files of {self.name}; see domain.published=null"
            )

    def made_of(self, dataset: PointSet) -> MadeOf:
        """What this domain's dataset is made of; incomplete published files are not published."""
        made = dataset.made_of
        if made.published and self._other_counts(dataset):
            return replace(made, published=False, objects=f"{made.objects}, in other numbers")
        return made

    def _other_counts(self, dataset: PointSet) -> list[str]:
        """In which splits and classes there are not as many clouds as were published."""
        found = dataset.counts()
        return [
            f"{split} {cls} {have} instead of {count}"
            for split, counts in (self.expected_counts or {}).items()
            for cls, count in zip(dataset.classes, counts, strict=True)
            if (have := found.get(split, {}).get(cls, 0)) != count
        ]

    def _refuse_stale(self, importer: Importer) -> None:
        """Raise DataError if the store was imported by other settings, or from other files."""
        imported = read_meta(self.folder).get("imported")
        if imported is None:  # generated here
            return
        now = importer.settings()
        if not importer.is_there():  # the published files were put away after the import
            now.update({key: imported[key] for key in ("folder", "files") if key in imported})
        if imported.get("on_error") == "stop":  # nothing was wrong, so nothing was left out
            now["on_error"] = "stop"
        changed = sorted(k for k in {*now, *imported} if now.get(k) != imported.get(k))
        if changed:
            was, wanted = ({key: of.get(key) for key in changed} for of in (imported, now))
            raise DataError(f"{self.folder} was imported with {was}, now it is {wanted}: delete it")


def check_or_make(source: Domain, target: Domain, make_source: bool) -> None:
    """Find out, in milliseconds, whether both domains are there.

    With `make_source`, `generate.py` is run for a source that is not there; an interrupted one goes
    on where it stopped. Raises MissingDataError, which lists all that is missing.
    """
    problems = {}
    for domain in (source, target):
        try:
            domain.check()
        except MissingDataError as error:
            problems[domain.name] = str(error)
    words = shlex.split(source.make or "")
    if make_source and [*problems] == [source.name] and words[:2] == ["python", "generate.py"]:
        if int(os.environ.get("LOCAL_RANK", 0)) == 0:  # the first process makes it
            log.info("%s is not there and is made: %s", source.label, typed(shlex.join(words)))
            done = subprocess.run([*python_command("generate"), *words[2:]], check=False)
            if done.returncode:
                raise Qs3Error(f"domain {source.name} could not be made ({done.returncode})")
    elif problems:
        raise MissingDataError("\n\n".join(problems.values()))


def compose_domain(name: str, overrides: Mapping[str, str]) -> Domain:
    """conf/domain/NAME.yaml with changes, instantiated."""
    from qs3.config.hydra import build

    prefix = {key: "" if key.startswith("paths.") else "domain." for key in overrides}
    words = [f"{prefix[key]}{key}={value}" for key, value in overrides.items()]
    cfg = composed(None, f"+domain={name}", "+paths=default", *words, place=f"domain={name}: ")
    domain: Domain = build(cfg.domain)
    return domain
