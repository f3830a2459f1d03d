"""The story of generate.py: meshes in, a checked dataset out.

Light to import: renderers live in worker processes only.
"""

import contextlib
import logging
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from qs3.config.hydra import build
from qs3.datasets.domain import Domain
from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.generation.kept import OBJECTS, PROVENANCE, clouds_picture
from qs3.generation.made_of import made_of
from qs3.generation.plan import Plan, code_fingerprint, planned
from qs3.generation.rooms import Rooms
from qs3.generation.workers import (
    COLLIDERS,
    Job,
    Outcome,
    has_part,
    load_part,
    renderer_provenance,
    save_part,
    scan_all,
    software,
)
from qs3.meshes.mesh import MeshItem
from qs3.meshes.placement import RealSize
from qs3.store.meta import MANIFEST, OK, ManifestRow, is_finished
from qs3.store.parts import (
    CLOUDS,
    CONFIG,
    PARTS,
    PartFiles,
    check_ours,
    delete_dataset,
)
from qs3.store.store import PointSet, counts_text, open_pointset, write_pointset
from qs3.utils.files import owned, write_text
from qs3.utils.pool import Pool
from qs3.utils.progress import progress_bar

log = logging.getLogger(__name__)

_ELSEWHERE = "paths.data_dir"
_SHOWN = 5  # failures in the log
_JUDGED = 20  # meshes whose size is looked at, evenly over all of them


def generate(cfg: DictConfig) -> PointSet:
    """Make the dataset that `cfg` describes, or continue it, or find it finished.

    Args:
        cfg: conf/generate.yaml, composed.

    Returns:
        The dataset.
    """
    plan = planned(cfg)
    domain, folder, tasks = plan.domain, plan.domain.folder, plan.tasks
    _check_place(domain, plan.options.force)
    pool: Pool = build(cfg.engine)
    parts = PartFiles(folder)
    job = Job(
        recipe=plan.recipe,
        make_renderer=partial(build, plan.renderer),
        seed=plan.options.seed,
        keep=plan.keep(folder),
        save=partial(save_part, parts),
    )
    with owned(folder, doing="making the dataset in"):
        renderer = renderer_provenance(job, pool)
        recipe = plan.describe(renderer)
        if plan.options.force:  # not before: without a renderer nothing would take its place
            delete_dataset(folder)
        if is_finished(folder):
            parts.check(recipe)
            parts.clear()  # a kill after the last write leaves them
            log.info("%s is already there: %s", domain.label, folder)
            pointset = open_pointset(folder, domain.variant)
            _judge_failed(plan, pointset)
            return pointset
        start = time.perf_counter()
        _warn_of_sizes(plan.recipe, plan.items)
        _begin(parts, recipe)
        if pool.elsewhere:
            place = partial(parts.check_there, parts.recipe_sha256()) if pool.shared_disk else None
            job = replace(job, expected={**software(), **renderer}, check_place=place)
        kind = "rooms" if isinstance(plan.recipe, Rooms) else "objects"
        passing = _scan_missing(job, tasks, parts, pool, f"{kind} of {domain.label}")
        outcomes = _collect(tasks, parts, passing, folder)
        made = _made(plan, outcomes)
        # The dataset last: with meta.yaml it counts as finished, and the parts can go.
        _draw(domain, made)
        write_text(folder / CONFIG, OmegaConf.to_yaml(cfg, resolve=True))
        pointset = _write(plan, made, recipe)
        parts.clear()
    _report(pointset, made, outcomes, time.perf_counter() - start)
    log.info("the clouds are in %s", folder)
    _judge_failed(plan, pointset)
    return pointset


def _check_place(domain: Domain, force: bool) -> None:
    """Raise where the dataset would replace, or pass for, one that was not made here."""
    check_ours(domain.folder, "generate.py")
    domain.check_unpublished()
    if force and domain.folder != Path(domain.path).absolute():
        raise ConfigError(
            f"{domain.name} is part of the dataset in {domain.folder}, and force=true would "
            "replace all of it: generate that domain with force=true"
        )


def _judge_failed(plan: Plan, pointset: PointSet) -> None:
    """Warn of the objects that a dataset lacks; with strict=true they are an error."""
    failed = pointset.meta["failed"]
    problem = f"{failed} of {len(plan.tasks)} failed; see {plan.domain.folder / MANIFEST}"
    if failed and plan.options.strict:
        raise DataError(problem)
    if failed:
        log.warning("%s", problem)


def _begin(parts: PartFiles, recipe: dict[str, Any]) -> None:
    """Start, or continue what the same code made with the same recipe.

    A finished dataset is not asked for its code, as every change would make it another.
    """
    parts.begin(recipe)
    file, code = parts.folder / PARTS / "code.txt", code_fingerprint()
    if parts.count() and (not file.is_file() or file.read_text() != code):
        raise ConfigError(
            f"{parts.folder} was begun with another version of qs3's code, which may make other "
            f"clouds: finish it with that version, or give another {_ELSEWHERE} or force=true"
        )
    write_text(file, code)


def _warn_of_sizes(recipe: Any, items: Sequence[MeshItem]) -> None:
    """Warn of files that are not in metres, where objects keep their size, before hours of scans.

    `RealSize` makes any mesh of an implausible size as large as it takes an object to be, so that
    millimetres give a dataset in which all objects are of one size.
    """
    placing, files = getattr(recipe, "placing", None), [item for item in items if item.path]
    if not isinstance(placing, RealSize):
        return
    few, lost = files[:: max(1, len(files) // _JUDGED)], 0
    for item in few:
        with contextlib.suppress(DataError):  # it will be recorded when it is scanned
            lost += not placing.keeps(item.load())
    if lost:
        log.warning(
            "%d of %d meshes looked at are not in metres: each is scaled to %g m",
            *(lost, len(few), placing.fallback_side_m),
        )


def _scan_missing(
    job: Job, items: list[MeshItem], parts: PartFiles, pool: Pool, label: str
) -> dict[str, Outcome]:
    """Scan what has no part yet; the failures that are not the objects' fault, by id.

    Those get no part: should this run be interrupted, the next one tries them again.
    """
    missing = [item for item in items if not has_part(parts, item.id)]
    passing = {}
    if len(missing) < len(items):
        log.info("continuing: %d of %d objects are done", len(items) - len(missing), len(items))
    with progress_bar(label, total=len(items), done=len(items) - len(missing)) as advance:
        for outcome in scan_all(job, missing, pool):
            if not outcome.lasting:
                passing[outcome.item_id] = outcome
            elif not outcome.saved:
                save_part(parts, outcome)
            advance()
            if outcome.reason:
                log.warning("%s: %s", outcome.item_id, outcome.reason)
    return passing


def _collect(
    items: list[MeshItem], parts: PartFiles, passing: dict[str, Outcome], folder: Path
) -> list[Outcome]:
    """One outcome an item."""
    if gone := [outcome for outcome in passing.values() if outcome.unavailable]:
        raise MissingDataError(
            f"{len(gone)} of {len(items)} meshes cannot be read any more; the first: "
            f"{gone[0].reason}. Run the same command again when they can: what is done is kept"
        )
    outcomes = [passing.get(item.id) or load_part(parts, item.id) for item in items]
    if all(outcome.cloud is None for outcome in outcomes):
        delete_dataset(folder)  # nothing is lost, and corrected settings are not refused
        raise DataError(f"all objects failed; the first: {items[0].id}: {outcomes[0].reason}")
    return outcomes


Made = tuple[ManifestRow, Mapping[str, np.ndarray] | None]
"""A row of the manifest, and its cloud's arrays; None if there is none."""


def _made(plan: Plan, outcomes: list[Outcome]) -> list[Made]:
    """What each object gave, or all clouds of rooms, class by class."""
    root = f"{plan.mesh_root}/"  # a manifest is the same wherever the folder lies
    made: list[Made] = []
    for item, outcome in zip(plan.tasks, outcomes, strict=True):
        cloud, reason = outcome.cloud, outcome.reason
        if plan.options.meshes is not None:
            reason = reason.replace(root, "")
        row = ManifestRow(
            id=item.id,
            cls=item.cls,
            split=item.split,
            seed=plan.options.seed,
            mesh_sha256=outcome.mesh_sha256,
            origin=item.origin,
            views=cloud.views if cloud else None,
            valid_points=cloud.valid_points if cloud else None,
            status=OK if cloud else "failed",
            reason=reason or outcome.note,
        )
        if cloud is None or cloud.found is None:
            made.append((row, cloud.arrays if cloud else None))
            continue
        for k, (cls, origin, sha256, points) in enumerate(cloud.found):
            name = f"{cls}/{item.split}/{item.id.rsplit('/', 1)[1]}_{k:02d}"
            of = replace(
                row, id=name, cls=cls, origin=origin, mesh_sha256=sha256, valid_points=points
            )
            made.append((of, _OfRoom(cloud.arrays, k)))
    order = {name: k for k, name in enumerate((*plan.domain.names, ""))}
    return sorted(made, key=lambda each: order[each[0].cls])


class _OfRoom(Mapping[str, np.ndarray]):
    """The arrays of one cloud of a room, each read when it is asked for."""

    def __init__(self, arrays: Mapping[str, np.ndarray], k: int) -> None:
        self._arrays, self._k = arrays, k

    def __getitem__(self, name: str) -> np.ndarray:
        return np.asarray(self._arrays[name][self._k])

    def __iter__(self) -> Iterator[str]:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)


def _draw(domain: Domain, made: Sequence[Made]) -> None:
    """clouds.png, for people only."""
    clouds: dict[str, list[Any]] = {row.cls: [] for row, _ in made if row.cls}
    for row, cloud in made:
        if cloud is not None and len(clouds[row.cls]) < OBJECTS:
            clouds[row.cls].append(cloud)
    clouds_picture(domain.folder / CLOUDS, clouds, domain.label)


class _Arrays(Sequence[np.ndarray]):
    """One array of many clouds, each read when it is asked for."""

    def __init__(self, clouds: Sequence[Mapping[str, np.ndarray]], name: str) -> None:
        self._clouds, self._name = clouds, name

    def __len__(self) -> int:
        return len(self._clouds)

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, slice):
            return [cloud[self._name] for cloud in self._clouds[key]]
        return self._clouds[key][self._name]


def _write(plan: Plan, made: Sequence[Made], recipe: dict[str, Any]) -> PointSet:
    domain = plan.domain
    others = plan.mesh_folder.left_alone() if plan.options.meshes is not None else []
    good = [cloud for _, cloud in made if cloud is not None]
    written = write_pointset(
        domain.folder,
        name=domain.folder.name,
        classes=domain.names,
        arrays={name: _Arrays(good, name) for name in good[0]},
        rows=[row for row, _ in made],
        meta={
            "simulated": domain.simulated,
            **made_of(plan, [row for row, _ in made], recipe).meta,
            **({"folders_left_alone": {"count": len(others), "names": others}} if others else {}),
            "settings": recipe["settings"],
            "versions": recipe["versions"],
            "config": plan.stored_config(),
        },
        tables={"provenance": PROVENANCE} if plan.options.provenance else None,
    )
    if domain.variant == "points":
        return written
    return open_pointset(domain.folder, domain.variant, verify=False)


def _report(
    pointset: PointSet, made: Sequence[Made], outcomes: list[Outcome], seconds: float
) -> None:
    """Counts a class, failures with their reasons, where things are, and the content hash."""
    failures = [o for o in outcomes if o.cloud is None]
    failed = Counter(row.cls for row, cloud in made if cloud is None)
    for line in counts_text(pointset, "failed", failed):
        log.info("%s", line)
    for outcome in failures[:_SHOWN]:
        log.warning("failed: %s: %s", outcome.item_id, outcome.reason)
    if passing := sum(not outcome.lasting for outcome in failures):
        log.warning("%d failed not by fault of the mesh: force=true makes it again", passing)
    if noted := sum(COLLIDERS in outcome.note for outcome in outcomes):
        log.info("%d files hold colliders, which were left out; see colliders=keep", noted)
    if others := pointset.meta.get("folders_left_alone"):
        log.info("folders of other classes: %s", ", ".join(others["names"]))
    log.info("made of: %s", pointset.made_of)
    log.info("content hash %s, %.0f s", pointset.sha256[:16], seconds)
