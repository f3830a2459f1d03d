"""The story of generate.py: meshes in, a checked dataset out.

Light to import: renderers live in worker processes only.
"""

from __future__ import annotations

import logging
import math
import platform
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from qs3.classes import CLASSES
from qs3.data.domain import Domain
from qs3.data.store import ManifestRow, PointSet, is_finished, open_pointset, write_pointset
from qs3.errors import ConfigError, DataError
from qs3.hydra_glue import build
from qs3.meshes.folder import MeshFolder
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
    with locked(folder):
        if cfg.force:
            forget(folder)
        recipe = describe(cfg, items, renderer_provenance(job))
        if is_finished(folder):
            check_same_recipe(folder, recipe)
            log.info("%s is already there: %s", domain.label, folder)
            return open_pointset(folder, domain.variant)
        start = time.perf_counter()
        parts = Parts(folder)
        parts.begin(recipe)
        _scan_missing(job, items, parts, cfg.workers, domain.label)
        pointset = _assemble(domain, items, parts, recipe, cfg)
        parts.clear()
    _report(pointset, items, time.perf_counter() - start)
    failed = len(items) - len(pointset.ids)
    if cfg.strict and failed:
        raise DataError(f"{failed} of {len(items)} objects failed; see {folder / 'manifest.csv'}")
    return pointset


def check(cfg: DictConfig) -> None:
    """Raise ConfigError for settings that no later step would explain as well."""
    if not isinstance(cfg.seed, int) or cfg.seed < 0:
        raise ConfigError(f"seed must be a whole number >= 0, got {cfg.seed!r}")
    if cfg.workers < 0:
        raise ConfigError(f"workers must be at least 0, got {cfg.workers}")
    if cfg.limit is not None and cfg.limit < 1:
        raise ConfigError(f"limit must be at least 1, got {cfg.limit}")
    if cfg.scans < 1:
        raise ConfigError(f"scans must be at least 1, got {cfg.scans}")
    if not 0 < cfg.fraction <= 1:
        raise ConfigError(f"fraction must be in (0, 1], got {cfg.fraction}")
    unknown = sorted(set(cfg.classes or ()) - set(CLASSES))
    if unknown:
        raise ConfigError(f"classes: {unknown} are not among the known {', '.join(CLASSES)}")


def mesh_items(cfg: DictConfig) -> list[MeshItem]:
    """The objects to scan, from the user's folder or the embedded catalogue."""
    classes = tuple(cfg.classes) if cfg.classes else None
    if cfg.meshes is not None:
        items = MeshFolder(
            path=Path(cfg.meshes).expanduser(),
            classes=classes,
            test_fraction=cfg.test_fraction,
            half=cfg.half,
        ).items()
    elif cfg.half == "all":
        items = build(cfg.catalogue, classes=classes or CLASSES).items()
    else:
        raise ConfigError("half= divides a folder of meshes: give one with meshes=PATH")
    kept = _first_of_each(items, cfg.limit, cfg.fraction)
    return [_scan_of(item, scan) for item in kept for scan in range(cfg.scans)]


def describe(cfg: DictConfig, items: list[MeshItem], renderer: dict[str, str]) -> dict[str, Any]:
    """All that decides the bytes of a dataset: what a resume is compared with.

    A folder of meshes is described by what is in it, not by where it lies.
    """
    plain: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
    settings = {key: plain[key] for key in ("seed", "recipe")}
    settings["domain"] = cfg.domain.path and Path(cfg.domain.path).name
    settings["version"] = plain.get("version", 1)  # of the recipe, where it is a benchmark
    settings["meshes"] = plain.get("catalogue") if cfg.meshes is None else "folder"
    if renderer:
        settings["renderer"] = plain["renderer"]
    return {
        "settings": settings,
        "objects": [f"{item.id} {item.origin}" for item in items],
        "versions": {
            **renderer,
            "numpy": version("numpy"),
            "opencv": version("opencv-python-headless"),
            "machine": platform.machine(),
        },
    }


def _make_renderer(settings: Any) -> Any:
    return build(settings)


def _scan_of(item: MeshItem, scan: int) -> MeshItem:
    """The same mesh under another id, so with other randomness; scan 0 keeps its id."""
    return item if scan == 0 else replace(item, id=f"{item.id}~{scan}")


def _first_of_each(items: Sequence[MeshItem], limit: int | None, fraction: float) -> list[MeshItem]:
    totals = Counter((item.cls, item.split) for item in items)
    seen: Counter[tuple[str, str]] = Counter()
    kept = []
    for item in items:
        group = (item.cls, item.split)
        wanted = math.ceil(fraction * totals[group] - 1e-9)
        if seen[group] < min(wanted, limit or wanted):
            kept.append(item)
        seen[group] += 1
    return kept


def _scan_missing(job: Job, items: list[MeshItem], parts: Parts, workers: int, label: str) -> None:
    missing = [item for item in items if not parts.done(item.id)]
    if len(missing) < len(items):
        log.info("continuing: %d of %d objects are done", len(items) - len(missing), len(items))
    with progress_bar(label, total=len(items), done=len(items) - len(missing)) as advance:
        for outcome in scan_all(job, missing, workers):
            parts.save(outcome)
            advance()
            if outcome.cloud is None:
                log.warning("%s: %s", outcome.item_id, outcome.reason)


def _assemble(
    domain: Domain, items: list[MeshItem], parts: Parts, recipe: dict[str, Any], cfg: DictConfig
) -> PointSet:
    outcomes: list[Outcome] = []
    for item in items:
        outcome = parts.load(item.id)
        if outcome is None:
            raise DataError(f"the part of {item.id} is gone: run the same command again")
        outcomes.append(outcome)
    good = [outcome.cloud for outcome in outcomes if outcome.cloud is not None]
    if not good:
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
            reason=outcome.reason,
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
            "settings": recipe["settings"],
            "versions": recipe["versions"],
        },
    )


def _report(pointset: PointSet, items: list[MeshItem], seconds: float) -> None:
    for split, counts in pointset.counts().items():
        text = ", ".join(f"{name} {n}" for name, n in counts.items() if n)
        log.info("%s: %d clouds (%s)", split, sum(counts.values()), text)
    failed = len(items) - len(pointset.ids)
    if failed:
        log.warning("%d objects failed; manifest.csv says why", failed)
    log.info("content hash %s, %.0f s", pointset.sha256[:16], seconds)
