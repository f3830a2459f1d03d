"""A domain: one dataset as an experiment sees it, whether generated here or published by others.

Light on purpose: `train.py` asks `Domain.check` before it imports anything heavy.
"""

from __future__ import annotations

import functools
import itertools
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from qs3.classes import class_list
from qs3.config.checks import check_choice, check_float
from qs3.config.compose import choices, composed
from qs3.config.location import typed
from qs3.datasets.importers import Importer, import_into, lie_deeper
from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.store.manifest import read_manifest
from qs3.store.meta import MadeOf
from qs3.store.store import (
    PointSet,
    has_variant,
    is_begun,
    is_finished,
    open_pointset,
    read_meta,
)
from qs3.utils.plural import counted

log = logging.getLogger(__name__)

VARIANTS = ("points", "points_clean", "points_whole")
SCALES = ("unit_ball", "metres", "above_floor")
"""How clouds are as a net sees them: divided by their radius; of their size, about their centroid;
or of their size, over the floor."""


@dataclass(frozen=True)
class Domain:
    """Where a dataset is, what it is called, and what to do if it is not there.

    Attributes:
        name: as on the command line, e.g. "specklenet10".
        symbol: of the paper's tables, e.g. "S".
        title: as in a sentence, e.g. "SpeckleNet10".
        path: folder of the store.
        variant: which array of the store: "points", "points_clean" for the clean twin, or
            "points_whole" for the whole surface (generated with twins=[whole]).
        twin_of: folder of a store that holds the same objects, and `variant` beside its clouds, if
            that store was generated; what `path` holds itself comes first.
        published: how to read the published files, if there are any: an `Importer`, or its
            config (instantiated when it is needed).
        simulated: the target's reality is simulated; every output about it says so.
        gravity: the axis that points up in the store: "z"; or "none" for clouds in the frame of
            their camera, which training should not turn about z (protocol.augment.rotate_z=false).
        unit: of the store's coordinates, "metres"; or "none" if sizes mean nothing (CAD shapes,
            clouds that were normalised) or nobody knows.
        floor_m: z of the floor in the store: 0 where objects stand on it, minus the camera's height
            where the camera is the origin; None: nobody knows.
        views: what training sees of a source: "stored", its clouds; "random", each time others of
            the views and twins that its store keeps (`qs3.datamodules.random_views`).
        classes: names in label order; "modelnet40"; None: the ten of the benchmark.
        expected_counts: clouds of each class, in label order, by split, as published.
        how_to_get: where the published files come from.
        make: the command that makes the dataset; None if only published files can give it.
        stand_in: a command that makes something to try instead.
        synthesis: settings of `generate.py`; not used here, and never instantiated by us.
    """

    name: str
    symbol: str
    title: str
    path: str | Path
    variant: str = "points"
    twin_of: str | Path | None = None
    published: Importer | Mapping[str, Any] | None = None
    simulated: bool = False
    gravity: str = "z"
    unit: str = "none"
    floor_m: float | None = None
    views: str = "stored"
    how_to_get: str = ""
    make: str | None = None
    stand_in: str | None = None
    synthesis: Any = None
    classes: str | Sequence[str] | None = None
    expected_counts: Mapping[str, Sequence[int]] | None = None

    def __post_init__(self) -> None:
        if self.variant not in VARIANTS:
            raise ConfigError(
                f"domain {self.name}: variant is {self.variant!r}, expected one of {VARIANTS}"
            )
        if self.gravity not in ("z", "none"):
            raise ConfigError(
                f"domain {self.name}: gravity is {self.gravity!r}, but the clouds of a store stand "
                "on z; let the importer turn them (its key `up`)"
            )
        check_choice(f"domain {self.name}: unit", self.unit, ("metres", "none"))
        check_choice(f"domain {self.name}: views", self.views, ("stored", "random"))
        if self.views == "random" and self.variant != "points":
            raise ConfigError(
                f"domain {self.name}: views=random draws from what was measured, and its variant "
                f"is {self.variant}: leave views out"
            )
        if self.floor_m is not None:
            check_float(f"domain {self.name}: floor_m", self.floor_m)
        object.__setattr__(self, "path", Path(self.path))
        classes = class_list(self.classes)
        if not classes or len(set(classes)) < len(classes):
            raise ConfigError(f"domain {self.name}: classes are {list(classes)}: empty or twice")
        for split, counts in (self.expected_counts or {}).items():
            if len(counts) != len(classes):
                raise ConfigError(
                    f"domain {self.name}: expected_counts.{split} has "
                    f"{counted(len(counts), 'number')} for "
                    f"{counted(len(classes), 'class', 'classes')}: give one for each class, or "
                    "expected_counts=null"
                )

    @property
    def names(self) -> tuple[str, ...]:
        """The classes in label order."""
        return class_list(self.classes)

    @property
    def folder(self) -> Path:
        """The store's folder as an absolute path."""
        own = Path(self.path).absolute()
        if self.twin_of is None or is_finished(own) or is_begun(own):
            return own
        other = Path(self.twin_of).absolute()
        return other if has_variant(other, self.variant) else own

    @property
    def label(self) -> str:
        """How tables and logs call it: title and symbol, and "simulated" where that is so."""
        return f"{self.title} ({self.symbol}{', simulated' if self.simulated else ''})"

    def importer(self) -> Importer | None:
        """The reader of the published files, instantiated from its config if need be."""
        if self.published is None or isinstance(self.published, Importer):
            return self.published
        from hydra.errors import InstantiationException
        from hydra.utils import instantiate

        try:
            return instantiate(self.published)
        except InstantiationException as error:
            raise ConfigError(
                f"domain {self.name}: `published` is wrong: {error.__cause__ or error}"
            ) from error

    def tell_of_judging(self, keys: str = "") -> None:
        """Say so if the test clouds are to be looked at once; `keys` stands before the domain's."""
        importer = self.importer()
        if importer is not None and (judges := importer.judges()):
            log.info(
                "%s: this looks at what judges, %s; %spublished.fold=0 looks at the part for "
                "training alone",
                self.label,
                judges,
                keys,
            )

    def check_scale(self, scale: str) -> None:
        """Find out whether a net can see the clouds at this scale.

        Raises:
            ConfigError: not one of `SCALES`; metres of clouds that are not in metres; heights above
                a floor of which nobody knows where it is.
        """
        if check_choice("data.scale", scale, SCALES) == "unit_ball":
            return
        if self.unit != "metres":
            raise ConfigError(
                f"data.scale={scale}: the clouds of domain {self.name} are not in metres, or "
                "nobody knows (its key `unit`). Set data.scale=unit_ball, choose a domain with "
                "real sizes such as roomscan10, or, if you know that they are in metres, say so: "
                "data.source.unit=metres or data.target.unit=metres"
            )
        if scale == "above_floor" and self.floor_m is None:
            raise ConfigError(
                f"data.scale=above_floor: nobody knows where the floor is in the clouds of domain "
                f"{self.name} (its key `floor_m`). Set data.scale=metres, or say it: "
                "data.source.floor_m=0 if objects stand on z = 0, data.target.floor_m=-1.25 if the "
                "origin is a camera 1.25 m above the floor"
            )

    def check(self) -> None:
        """Find out, in milliseconds, whether `open` has something to open.

        Raises:
            MissingDataError: what was looked for, where to get it, and the commands.
            DataError: a dataset that was made here and the published files are both there.
        """
        importer = self.importer()
        published = importer if importer is not None and importer.is_there() else None
        if is_finished(self.folder):
            if published is not None:
                self._refuse_two(published)
            return
        if published is not None:
            return
        unfinished = is_begun(self.folder)
        why = self._absent(importer)
        lines = [
            f"domain {self.name}: {why}{self.label} is not there. Looked for:",
            f"  {self.folder / 'meta.yaml'}{'   (begun but not finished)' * unfinished}",
            *([f"  {Path(self.twin_of).absolute() / self.variant}.npy"] if self.twin_of else []),
            *(f"  {pattern}" for pattern in (importer.looks_for() if importer else [])),
            *lie_deeper(importer),
        ]
        if self.how_to_get:
            lines.append(f"Where to get it: {self.how_to_get.strip()}")
        if self.make:
            verb = "Continue making it" if unfinished else "Make it"
            lines.append(f"{verb}:\n  {self.make}")
        if self.stand_in and not why:  # who named a folder mistyped it, and has clouds
            lines.append(f"Or make a stand-in and use that one:\n  {self.stand_in}")
        raise MissingDataError(typed("\n".join(lines)))

    def _absent(self, importer: Importer | None) -> str:
        """What is wrong with the place that somebody named; "" if it is the config's own."""
        if importer is None:
            return ""
        data_dir = Path(self.path).absolute().parent
        usual = importer.place == data_dir or importer.place.is_relative_to(data_dir / "published")
        return "" if usual else f"{importer.absent()}; "

    def open(self, verify: bool = True) -> PointSet:
        """Open the dataset; the first time, bring the published files into the store.

        Raises:
            MissingDataError: as `check`.
            DataError: damaged files, or a store imported under other settings.
        """
        self.check()
        importer = self.importer()
        if not is_finished(self.folder):
            assert importer is not None  # `check` passed
            log.info("importing %s from %s", self.label, importer.looks_for()[0])
            import_into(self.folder, importer, name=self.folder.name, classes=self.names)
        elif importer is not None:
            self._refuse_stale(importer)
        dataset = open_pointset(self.folder, self.variant, verify=verify)
        if self.classes is not None and dataset.classes != self.names:
            raise DataError(
                f"{self.folder} was made with the classes {', '.join(dataset.classes)}; the config "
                f"of domain {self.name} says {', '.join(self.names)}"
            )
        if "imported" in dataset.meta and (problems := self._other_counts(dataset)):
            text = "%s does not have the published numbers of clouds: %s"
            log.warning(text, self.label, ", ".join(problems))
        return replace(dataset, floor_m=self.floor_m)

    def open_array(self, name: str, verify: bool = True) -> PointSet:
        """The same clouds in another array of the store, such as "points_whole".

        Raises:
            DataError: the store lacks it; says how to get it.
        """
        if not self.has_array(name):
            twin = "whole" if name == "points_whole" else "exact,views"
            raise DataError(
                f"{self.folder} has no {name}.npy: generate it again with it, "
                + typed(f"python generate.py domain={self.name} force=true twins=[{twin}]")
                + " (its clouds will be the same), or set method.sees=scan, which takes the clouds "
                "themselves"
            )
        return replace(open_pointset(self.folder, name, verify=verify), floor_m=self.floor_m)

    def has_array(self, name: str) -> bool:
        """Whether the store has this array of clouds."""
        return has_variant(self.folder, name)

    def kept_views(self) -> list[str]:
        """Names of the arrays of single views that the store keeps, in order; often none."""
        names = (f"points_view{i}" for i in itertools.count())
        return list(itertools.takewhile(self.has_array, names))

    def check_unpublished(self) -> None:
        """Raise DataError if published files are there: a dataset made here would pass for them."""
        importer = self.importer()
        if importer is not None and importer.is_there():
            raise DataError(
                f"domain {self.name}: the published files of {self.label} are in {importer.root}, "
                "and a dataset made here would be taken for them. Give it a place of its own with "
                "paths.data_dir=PATH, move the published files away, or say that they are not "
                "meant: domain.published=null here, data.source.published=null in training"
            )

    def _refuse_two(self, importer: Importer) -> None:
        """Raise DataError if the store was not imported: which of the two is meant?"""
        meta = read_meta(self.folder)
        if "imported" not in meta:
            raise DataError(
                f"domain {self.name}: two datasets are there for {self.label}: in {self.folder} "
                f"one that was made here ({MadeOf.of(meta)}), in {importer.root} the published "
                "files. To use the published ones, delete or rename the first folder; to use the "
                "one made here, move the published files away or set published=null (in training "
                "data.source.published=null or data.target.published=null)"
            )

    def made_of(self, dataset: PointSet) -> MadeOf:
        """What this domain's dataset is made of; incomplete published files are not published."""
        made = dataset.made_of
        if made.published and self._other_counts(dataset):
            return replace(made, published=False, objects=f"{made.objects}, in other numbers")
        return made

    def _other_counts(self, dataset: PointSet) -> list[str]:
        """In which splits and classes there are not as many clouds as were published."""
        found, problems = dataset.counts(), []
        for split, counts in (self.expected_counts or {}).items():
            have = found.get(split, {})
            problems += [
                f"{split} {cls} {have.get(cls, 0)} instead of {count}"
                for cls, count in zip(dataset.classes, counts, strict=True)
                if have.get(cls, 0) != count
            ]
        return problems

    def _refuse_stale(self, importer: Importer) -> None:
        """Raise DataError if the store was imported by other settings or rules than today's."""
        meta = read_meta(self.folder)
        imported = meta.get("imported")
        if imported is None:  # generated here
            return
        now = importer.settings()
        if not importer.is_there():  # the published files were put away after the import
            self._refuse_another(importer, Path(str(imported.get("folder", ""))))
            now.update({key: imported.get(key) for key in ("folder", "files") if key in now})
        if imported.get("on_error") == "stop":  # nothing was wrong, so nothing was left out
            now["on_error"] = "stop"
        changed = {key for key in {*now, *imported} if now.get(key) != imported.get(key)}
        if not changed:
            rows = functools.partial(read_manifest, self.folder, meta["classes"])
            if not (outdated := importer.outdated(rows)):
                return
            problem = f"{self.folder} was imported by an earlier version of qs3, which took "
            problem += f"{outdated}; delete it"
        elif changed == {"files"}:
            origins = {row.origin for row in read_manifest(self.folder, meta["classes"])}
            problem = f"{self.folder} is not what its folder holds today: "
            problem += f"{importer.changes(origins)}; delete {self.folder}"
        else:  # of other settings there is more to say than a digest
            keys = sorted(changed - {"files"})
            was, wanted = ({key: of.get(key) for key in keys} for of in (imported, now))
            problem = f"{self.folder} was imported with {was}, the config says {wanted}; "
            words = [f"published.{key}={_said(value)}" for key, value in was.items()]
            plain = all(isinstance(value, bool | int | float | str) for value in was.values())
            if plain and not changed & {"files", "folder", "format"}:
                problem += f"say {' '.join(words)} to take it as it is, "
            problem += "delete it"
        raise DataError(f"{problem} to import it again, or give another `path`")

    def _refuse_another(self, importer: Importer, was: Path) -> None:
        """Raise DataError for a mistyped name; by the name alone, because all may have moved."""
        why = self._absent(importer)
        if why and was.name and importer.root.name != was.name:
            told = f"{self.folder} holds what was in {was}: give that, or a folder that is there"
            raise DataError(f"domain {self.name}: {why}{told} (and another `path`)")


def _said(value: object) -> str:
    """A value as a word of the command line has it."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def check_all(*domains: Domain) -> None:
    """Check several domains and tell of all that are missing at once.

    Raises:
        MissingDataError: as `Domain.check`, for each one that is not there.
    """
    problems = []
    for domain in {domain.name: domain for domain in domains}.values():
        try:
            domain.check()
        except MissingDataError as error:
            problems.append(str(error))
    if problems:
        raise MissingDataError("\n\n".join(problems))


def compose_domain(name: str, overrides: Mapping[str, str]) -> Domain:
    """conf/domain/NAME.yaml with changes, instantiated.

    Raises:
        ConfigError: there is no such domain, or no such key.
    """
    known = choices("domain")
    if name not in known:
        raise ConfigError(
            f"domain={name} is unknown; there are {', '.join(known)}, or give the folder of a "
            "dataset (with a / in it)"
        )
    words = [
        f"{key if key.startswith('paths.') else f'domain.{key}'}={value}"
        for key, value in overrides.items()
    ]
    from qs3.config.hydra import build

    cfg = composed(None, f"+domain={name}", "+paths=default", *words, place=f"domain={name}: ")
    domain: Domain = build(cfg.domain)
    return domain
