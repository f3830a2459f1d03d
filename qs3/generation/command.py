"""The story of generate.py: meshes in, a checked dataset out.

Light to import: renderers live in worker processes only.
"""

from __future__ import annotations

import csv
import io
import logging
import time
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from qs3.config.hydra import build
from qs3.datasets.domain import Domain
from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.generation.checks import check, check_recipe
from qs3.generation.code_fingerprint import code_fingerprint
from qs3.generation.contact_sheets import OBJECTS, clouds_picture, infrared_picture
from qs3.generation.disk import check_folder, disk_errors_explained
from qs3.generation.made_of import made_of
from qs3.generation.materials import DRAWN
from qs3.generation.mesh_sizes import warn_of_sizes
from qs3.generation.object_parts import ELSEWHERE, InParts, Parts
from qs3.generation.objects import left_alone, mesh_folder, mesh_items, mesh_root
from qs3.generation.plan import benchmark, describe, keep, stated_hash, stored_config
from qs3.generation.provenance import PROVENANCE
from qs3.generation.recipe_fingerprint import recipe_fingerprint
from qs3.generation.travel import software
from qs3.generation.workers import COLLIDERS, Job, Outcome, renderer_provenance, scan_all
from qs3.meshes.source import MeshItem
from qs3.store.manifest import MANIFEST
from qs3.store.parts import CLOUDS, CONFIG, COSTS, INFRARED, check_ours, delete_dataset
from qs3.store.store import (
    ManifestRow,
    PointSet,
    counts_text,
    is_finished,
    open_pointset,
    write_pointset,
)
from qs3.utils.files import write_text
from qs3.utils.locks import owned
from qs3.utils.plural import counted
from qs3.utils.pool import Pool
from qs3.utils.progress import progress_bar

log = logging.getLogger(__name__)

_FAILURES_SHOWN = 5
_FOLDERS_SHOWN = 8


def generate(cfg: DictConfig) -> PointSet:
    """Make the dataset that `cfg` describes, or continue it, or find it finished.

    Args:
        cfg: conf/generate.yaml, composed.

    Returns:
        The dataset.

    Raises:
        ConfigError: a setting is wrong, or the folder holds another dataset.
        MissingDataError: the mesh folder or one of its classes is not there.
        RenderError: the renderer cannot be used on this machine.
        DataError: every object failed (or, with strict=true, any), the disk is full, or the
            folder holds, or the domain has, a published dataset.
    """
    check(cfg)
    domain: Domain = build(cfg.domain)
    folder = domain.folder
    _check_place(domain, cfg.force)
    items = mesh_items(cfg)
    pool: Pool = build(cfg.engine)
    parts = Parts(folder)
    job = Job(
        recipe=build(cfg.recipe),
        make_renderer=partial(build, OmegaConf.to_container(cfg.renderer, resolve=True)),
        seed=cfg.seed,
        keep=keep(cfg, items, folder),
        save=parts.save,
    )
    check_recipe(job.recipe, cfg)
    check_folder(folder, cfg.paths.data_dir)
    other = f"wait for it, or give another {ELSEWHERE}"
    with (
        owned(folder, doing="making the dataset in", advice=other),
        disk_errors_explained(folder, lambda: parts.state(len(items))),
    ):
        renderer = renderer_provenance(job)
        recipe = describe(cfg, items, renderer)
        if cfg.force:  # not before: without a renderer nothing would take its place
            delete_dataset(folder)
        if is_finished(folder):
            parts.check(recipe)
            parts.clear()  # a kill after the last write leaves them
            log.info("%s is already there: %s", domain.label, folder)
            pointset = open_pointset(folder, domain.variant)
            _warn_of_failed(pointset, items, folder)
            _check_strict(cfg, pointset, items, folder)
            return pointset
        start = time.perf_counter()
        _warn_of_meshes(cfg, job, items)
        parts.begin_by(code_fingerprint(), recipe)
        if pool.elsewhere:
            place = partial(parts.check_there, parts.recipe_sha256()) if pool.shared_disk else None
            job = replace(job, expected={**software(), **renderer}, check_place=place)
        passing = _scan_missing(job, items, parts, pool, _heading(domain))
        outcomes = _collect(items, parts, passing, folder)
        # The dataset last: with meta.yaml it counts as finished, and the parts can go.
        _draw(domain, items, outcomes, folder)
        write_text(folder / CONFIG, OmegaConf.to_yaml(cfg, resolve=True))
        write_text(folder / COSTS, _costs(items, outcomes))
        pointset = _write(domain, items, outcomes, recipe, cfg)
        parts.clear()
    _report(pointset, items, outcomes, folder, time.perf_counter() - start)
    stated = stated_hash(cfg, recipe)
    if stated and stated != pointset.sha256:
        log.warning(
            "the stated content hash is %s: another processor or library version made other bytes",
            stated[:16],
        )
    _check_strict(cfg, pointset, items, folder)
    return pointset


def _warn_of_meshes(cfg: DictConfig, job: Job, items: list[MeshItem]) -> None:
    """What of the user's meshes will not come out as one may think."""
    if cfg.meshes is not None and (unread := mesh_folder(cfg).unread()):
        log.warning(
            "left out, because this format is not read: %s: export STL, OBJ or glTF",
            unread[0] if len(unread) == 1 else f"{unread[0]} and {len(unread) - 1} more",
        )
    warn_of_sizes(getattr(job.recipe, "placing", None), items)


def _check_place(domain: Domain, force: bool) -> None:
    """Raise where the dataset would replace, or pass for, one that was not made here."""
    try:
        check_ours(domain.folder, "generate.py")
        domain.check_unpublished()
    except OSError as error:  # a name that no folder can have
        raise ConfigError(
            f"cannot make the folder {domain.folder}: {error.strerror}; choose another one, "
            "paths.data_dir=PATH"
        ) from error
    if force and domain.folder != Path(domain.path).absolute():
        raise ConfigError(
            f"{domain.name} is part of the dataset in {domain.folder}, and force=true would "
            "replace all of it: generate that domain with force=true"
        )


def _warn_of_failed(pointset: PointSet, items: list[MeshItem], folder: Path) -> None:
    """Of a dataset that is there already: what it lacks, which its first run said."""
    failed = len(items) - len(pointset.ids)
    if not failed:
        return
    there = {pointset.classes[label] for label in pointset.labels}
    none = sorted({item.cls for item in items} - there)
    has = f"; no object of {', '.join(none)} is in it" * bool(none)
    log.warning(
        "%d of %d objects had failed (%s says why)%s", failed, len(items), folder / MANIFEST, has
    )


def _check_strict(cfg: DictConfig, pointset: PointSet, items: list[MeshItem], folder: Path) -> None:
    failed = len(items) - len(pointset.ids)
    if cfg.strict and failed:
        raise DataError(f"{failed} of {len(items)} objects failed; see {folder / 'manifest.csv'}")


def _scan_missing(
    job: Job, items: list[MeshItem], parts: Parts, pool: Pool, label: str
) -> dict[str, Outcome]:
    """Scan what has no part yet; the failures that are not the objects' fault, by id.

    Those get no part: should this run be interrupted, the next one tries them again.
    """
    missing = [item for item in items if not parts.done(item.id)]
    passing = {}
    if len(missing) < len(items):
        log.info("continuing: %d of %d objects are done", len(items) - len(missing), len(items))
    with progress_bar(label, total=len(items), done=len(items) - len(missing)) as advance:
        for outcome in scan_all(job, missing, pool):
            if not outcome.lasting:
                passing[outcome.item_id] = outcome
            elif not outcome.saved:
                parts.save(outcome)
            advance()
            if outcome.reason:
                log.warning("%s: %s", outcome.item_id, outcome.reason)
    return passing


def _collect(
    items: list[MeshItem], parts: Parts, passing: dict[str, Outcome], folder: Path
) -> list[Outcome]:
    """One outcome an item.

    Raises:
        MissingDataError: meshes could not be read any more; the parts of the others stay.
        DataError: no object gave a cloud.
    """
    if gone := [outcome for outcome in passing.values() if outcome.unavailable]:
        raise MissingDataError(
            f"{len(gone)} of {len(items)} meshes cannot be read any more; the first: "
            f"{gone[0].reason}. Run the same command again when they can: "
            f"{parts.state(len(items))}"
        )
    outcomes: list[Outcome] = []
    for item in items:
        outcome = passing.get(item.id) or parts.load(item.id)
        if outcome is None:
            raise DataError(f"the part of {item.id} is gone: run the same command again")
        outcomes.append(outcome)
    if all(outcome.cloud is None for outcome in outcomes):
        delete_dataset(folder)  # nothing is lost, and corrected settings are not refused
        one = "the only object" if len(items) == 1 else f"all {len(items)} objects"
        raise DataError(f"{one} failed; the first: {items[0].id}: {outcomes[0].reason}")
    return outcomes


def _draw(domain: Domain, items: list[MeshItem], outcomes: list[Outcome], folder: Path) -> None:
    """clouds.png and, where something was looked at, infrared.png: for people only."""
    clouds: dict[str, list[Any]] = {item.cls: [] for item in items}
    previews = {}
    for item, outcome in zip(items, outcomes, strict=True):
        if outcome.cloud is None:
            continue
        if len(clouds[item.cls]) < OBJECTS:
            clouds[item.cls].append(outcome.cloud.arrays)
        if outcome.cloud.preview and item.cls not in previews:
            previews[item.cls] = (item.id, outcome.cloud.preview)
    heading = _heading(domain)
    twin = any("points_clean" in arrays for some in clouds.values() for arrays in some)
    clouds_picture(folder / CLOUDS, clouds, heading, twin)
    if previews:
        infrared_picture(folder / INFRARED, previews, heading)


def _heading(domain: Domain) -> str:
    """What its pictures are called: classes of one's own are another dataset than the published."""
    own = domain.classes is not None and not isinstance(domain.classes, str)
    return f"{domain.folder.name}, scanned as {domain.label}" if own else domain.label


def _costs(items: list[MeshItem], outcomes: list[Outcome]) -> str:
    """costs.csv. Not in manifest.csv, which is the same whoever scanned the objects."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(("id", "seconds", "peak_memory_mb"))
    for item, outcome in zip(items, outcomes, strict=True):
        rows.writerow((item.id, f"{outcome.seconds:g}", f"{outcome.memory_mb:g}"))
    return text.getvalue()


def _write(
    domain: Domain, items: list[MeshItem], outcomes: list[Outcome], recipe: Any, cfg: DictConfig
) -> PointSet:
    good = [outcome.cloud for outcome in outcomes if outcome.cloud is not None]
    made = made_of(
        cfg,
        (item.cls for item, o in zip(items, outcomes, strict=True) if o.cloud is not None),
        (outcome.mesh_sha256 for outcome in outcomes),
        benchmark(cfg, recipe),
        recipe_fingerprint(recipe, (o.item_id for o in outcomes if o.cloud is not None)),
    )
    others = left_alone(cfg)
    rows = [
        ManifestRow(
            id=item.id,
            cls=item.cls,
            split=item.split,
            seed=cfg.seed,
            mesh_sha256=outcome.mesh_sha256,
            origin=item.origin,
            views=outcome.cloud.views if outcome.cloud else None,
            valid_points=outcome.cloud.valid_points if outcome.cloud else None,
            status="ok" if outcome.cloud else "failed",
            reason=_without_root(outcome.reason, cfg) or outcome.note,
        )
        for item, outcome in zip(items, outcomes, strict=True)
    ]
    made_here = write_pointset(
        domain.folder,
        name=domain.folder.name,
        classes=domain.names,
        arrays={name: InParts(good, name) for name in good[0].arrays},
        rows=rows,
        meta={
            "simulated": domain.simulated,
            **made.meta,
            **({"folders_left_alone": {"count": len(others), "names": others}} if others else {}),
            "settings": recipe["settings"],
            "versions": recipe["versions"],
            "config": stored_config(cfg),
        },
        tables={"provenance": PROVENANCE} if cfg.provenance else None,
    )
    if domain.variant == "points":
        return made_here
    return open_pointset(domain.folder, domain.variant, verify=False)


def _without_root(reason: str, cfg: DictConfig) -> str:
    """The reason with paths relative to the mesh folder: a manifest is the same anywhere."""
    if cfg.meshes is None:
        return reason
    root = mesh_root(cfg)
    return reason.replace(f"{root.resolve()}/", "").replace(f"{root}/", "")


def _report(
    pointset: PointSet, items: list[MeshItem], outcomes: list[Outcome], folder: Path, seconds: float
) -> None:
    """Counts a class, failures with their reasons, where things are, and the content hash."""
    failures = [o for o in outcomes if o.cloud is None]
    failed = Counter(item.cls for item, o in zip(items, outcomes, strict=True) if o.cloud is None)
    for line in counts_text(pointset, "failed", failed):
        log.info("%s", line)
    for outcome in failures[:_FAILURES_SHOWN]:
        log.warning("failed: %s: %s", outcome.item_id, outcome.reason)
    if len(failures) > _FAILURES_SHOWN:
        more = len(failures) - _FAILURES_SHOWN
        log.warning("and %d more: %s says why", more, folder / "manifest.csv")
    if passing := sum(not outcome.lasting for outcome in failures):
        log.warning(
            "%s not by fault of the mesh itself: force=true makes the dataset again",
            counted(passing, "object failed", "objects failed"),
        )
    if noted := sum(COLLIDERS in outcome.note for outcome in outcomes):
        hold = counted(noted, "file holds", "files hold")
        log.info("%s colliders, which were left out (manifest.csv); colliders=keep", hold)
    if drawn := sum(DRAWN in outcome.note for outcome in outcomes):
        log.info(
            "files that do not say of all their faces what they are made of: %d of %d; for the "
            "other faces materials were drawn (manifest.csv)",
            drawn,
            len(outcomes),
        )
    if others := pointset.meta.get("folders_left_alone"):
        names, count = others["names"][:_FOLDERS_SHOWN], others["count"]
        more = ", ..." * (count > len(names))
        left = counted(count, "folder of another class was", "folders of other classes were")
        log.info("%s left alone: %s%s", left, ", ".join(names), more)
    log.info("made of: %s", pointset.made_of)
    pictures = " and ".join(n for n in (CLOUDS, INFRARED) if (folder / n).is_file())
    log.info("in %s: look at %s", folder, pictures)
    log.info("content hash %s, %.0f s", pointset.sha256[:16], seconds)
