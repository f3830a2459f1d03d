"""The story of generate.py: meshes in, a checked dataset out.

Light to import: renderers live in worker processes only.
"""

from __future__ import annotations

import logging
import time
from functools import partial
from typing import Any

from omegaconf import DictConfig, OmegaConf

from qs3.classes import CLASSES
from qs3.data.domain import Domain
from qs3.data.store import ManifestRow, PointSet, is_finished, open_pointset, write_pointset
from qs3.errors import DataError
from qs3.generation_plan import (
    benchmark,
    check,
    check_recipe,
    describe,
    mesh_items,
    mesh_root,
    stated_hash,
)
from qs3.hydra_glue import build
from qs3.meshes.source import MeshItem
from qs3.runs import locked
from qs3.synthesis.parts import Parts, check_same_recipe, forget
from qs3.synthesis.progress import progress_bar
from qs3.synthesis.workers import Job, Outcome, renderer_provenance, scan_all

log = logging.getLogger(__name__)


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
        DataError: every object failed (or, with strict=true, any).
    """
    check(cfg)
    domain: Domain = build(cfg.domain)
    folder = domain.folder
    items = mesh_items(cfg)
    job = Job(
        recipe=build(cfg.recipe),
        make_renderer=partial(_make_renderer, OmegaConf.to_container(cfg.renderer, resolve=True)),
        seed=cfg.seed,
    )
    check_recipe(job.recipe, cfg)
    with locked(
        folder, doing="making the dataset in", advice="wait for it, or give another paths.data_dir"
    ):
        parts = Parts(folder)
        if cfg.force:
            forget(folder)
        recipe = describe(cfg, items, renderer_provenance(job))
        if is_finished(folder):
            check_same_recipe(folder, recipe)
            parts.clear()  # a kill after the last write leaves them
            log.info("%s is already there: %s", domain.label, folder)
            return open_pointset(folder, domain.variant)
        start = time.perf_counter()
        parts.begin(recipe)
        passing = _scan_missing(job, items, parts, cfg.workers, domain.label)
        pointset = _assemble(domain, items, parts, passing, recipe, cfg)
        parts.clear()
    _report(pointset, items, time.perf_counter() - start)
    stated = stated_hash(cfg, recipe)
    if stated and stated != pointset.sha256:
        log.warning(
            "the stated content hash is %s: another processor or library version made other bytes",
            stated[:16],
        )
    failed = len(items) - len(pointset.ids)
    if cfg.strict and failed:
        raise DataError(f"{failed} of {len(items)} objects failed; see {folder / 'manifest.csv'}")
    return pointset


def _make_renderer(settings: Any) -> Any:
    return build(settings)


def _scan_missing(
    job: Job, items: list[MeshItem], parts: Parts, workers: int, label: str
) -> dict[str, Outcome]:
    """Scan what has no part yet; the failures that are not the objects' fault, by id.

    Those get no part: should this run be interrupted, the next one tries them again.
    """
    missing = [item for item in items if not parts.done(item.id)]
    passing = {}
    if len(missing) < len(items):
        log.info("continuing: %d of %d objects are done", len(items) - len(missing), len(items))
    with progress_bar(label, total=len(items), done=len(items) - len(missing)) as advance:
        for outcome in scan_all(job, missing, workers):
            if outcome.lasting:
                parts.save(outcome)
            else:
                passing[outcome.item_id] = outcome
            advance()
            if outcome.cloud is None:
                log.warning("%s: %s", outcome.item_id, outcome.reason)
    return passing


def _assemble(
    domain: Domain,
    items: list[MeshItem],
    parts: Parts,
    passing: dict[str, Outcome],
    recipe: dict[str, Any],
    cfg: DictConfig,
) -> PointSet:
    outcomes: list[Outcome] = []
    for item in items:
        outcome = passing.get(item.id) or parts.load(item.id)
        if outcome is None:
            raise DataError(f"the part of {item.id} is gone: run the same command again")
        outcomes.append(outcome)
    good = [outcome.cloud for outcome in outcomes if outcome.cloud is not None]
    if not good:
        forget(domain.folder)  # nothing is lost, and mended settings are not refused
        raise DataError(
            f"all {len(items)} objects failed; the first: {items[0].id}: {outcomes[0].reason}"
        )
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
            reason=_without_root(outcome.reason, cfg),
        )
        for item, outcome in zip(items, outcomes, strict=True)
    ]
    return write_pointset(
        domain.folder,
        name=domain.folder.name,
        classes=CLASSES,
        arrays={name: [cloud.arrays[name] for cloud in good] for name in good[0].arrays},
        rows=rows,
        meta={
            "simulated": domain.simulated,
            "benchmark": benchmark(cfg, recipe),
            "settings": recipe["settings"],
            "versions": recipe["versions"],
        },
    )


def _without_root(reason: str, cfg: DictConfig) -> str:
    """The reason with paths relative to the mesh folder: a manifest is the same anywhere."""
    if cfg.meshes is None:
        return reason
    root = mesh_root(cfg)
    return reason.replace(f"{root.resolve()}/", "").replace(f"{root}/", "")


def _report(pointset: PointSet, items: list[MeshItem], seconds: float) -> None:
    for split, counts in pointset.counts().items():
        text = ", ".join(f"{name} {n}" for name, n in counts.items() if n)
        log.info("%s: %d clouds (%s)", split, sum(counts.values()), text)
    failed = len(items) - len(pointset.ids)
    if failed:
        log.warning("%d objects failed; manifest.csv says why", failed)
    if kind := pointset.meta.get("benchmark"):
        log.info("this is %s", kind)
    log.info("content hash %s, %.0f s", pointset.sha256[:16], seconds)
