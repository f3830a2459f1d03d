"""First stage: the datasets, what training may see of them, and what evaluation holds."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from qs3.config.hydra import build
from qs3.datamodules.adaptation import AdaptationData
from qs3.datamodules.splits import labels_of, load_clouds, subsample_splits
from qs3.datasets.domain import Domain
from qs3.errors import ConfigError, DataError
from qs3.evaluation.metrics import Evaluation
from qs3.methods.base import Method
from qs3.runs.metrics import DataMadeOf
from qs3.store.manifest import read_manifest
from qs3.store.store import PointSet
from qs3.training import class_shares
from qs3.training.given import Given
from qs3.training.provenance import note_start
from qs3.training.real_sizes import check_real_sizes
from qs3.training.run import Run

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Loaded:
    """What the later stages need to know about the data.

    Attributes:
        data: what training may see.
        evaluation: the target's evaluated clouds with their labels, which nothing else holds.
        split: which split of the target is evaluated.
        stored_points: of a cloud on disk.
        started: what `started.json` says: hashes of data and config, versions.
        made_of: what the labelled dataset and the target are made of.
        labelled: shares of the classes in the labelled clouds, as they are drawn.
        learnt: the same in what the first teacher learnt from; another's, if it was given.
    """

    data: AdaptationData
    evaluation: Evaluation
    split: str
    stored_points: int
    started: dict[str, Any]
    made_of: DataMadeOf
    labelled: class_shares.Shares
    learnt: class_shares.Shares


def load_data(run: Run, method: Method, given: Given | None = None) -> Loaded:
    """Open both domains, compare them with what the run was begun with, and load their clouds.

    Target labels go to the method that asks for them by name, and to the evaluation. `given`: the
    classifier that the run begins with.

    Raises:
        DataError, ConfigError: data and settings do not fit, or are not those of an earlier start.
    """
    cfg = run.cfg
    data: AdaptationData = build(cfg.data, _partial_=True)(
        phases=run.phases,
        scheme=run.scheme,
        augment=build(cfg.protocol.augment),
        batch_size=cfg.protocol.batch_size,
        seed=run.seed,
        owner=method.labels,
        uses_target=method.uses_target,
        wants=method.wants,
    )
    data.prepare_data()
    source, target = run.source.open(verify=False), run.target.open(verify=False)
    _check_classes(source, target, cfg.num_classes)
    if given:
        given.check_classes(target.classes)
    used = source if data.owner == "source" else target
    started = note_start(run, used, target, given, data.labelled_domain.beside_sha256)
    of_target = run.target.made_of(target)
    labelled = run.source.made_of(source) if data.owner == "source" else of_target
    data.setup("fit")
    _warn_of_untrained(data, target.classes)
    _check_norms(run, len(data.target.ids))
    _check_rounds(run, len(data.target.ids))
    learnt = drawn = class_shares.of_labelled(data, len(target.classes))
    if given and run.cfg.selection.teacher == "given" and given.learnt is not None:
        learnt = given.learnt
    # What is no prior ends a run before it trains.
    class_shares.prior_of(cfg.evaluation, target.classes, learnt, lambda: learnt[None])
    if (few := cfg.data.clouds_a_split) is not None:
        target = subsample_splits(target, few)
    split = _evaluated_split(target)
    evaluation = Evaluation(
        load_clouds(
            target,
            split,
            cfg.data.points,
            cache_dir=data.target_domain.cache_dir,
            scale=cfg.data.scale,
        ),
        labels_of(target, split) if split == "test" else None,
        _labels_by_id(target, "train"),
        target.classes,
        cfg.evaluation.rotations,
        _objects_by_id(target, run.target),
        _tiers_by_id(target, run.target),
    )
    tested = [evaluation.test] if split == "test" else []  # else they are those for training
    check_real_sizes(run.target.name, data.all_labelled, data.target, *tested)
    made_of = DataMadeOf(source=labelled, target=of_target)
    return Loaded(data, evaluation, split, target.points.shape[1], started, made_of, drawn, learnt)


def _check_classes(source: PointSet, target: PointSet, num_classes: int) -> None:
    if source.classes != target.classes:
        raise DataError(
            f"{source.name} has the classes {source.classes}, {target.name} {target.classes}; "
            "they must be the same, in the same order"
        )
    if len(source.classes) != num_classes:
        raise ConfigError(
            f"num_classes is {num_classes}, but {source.name} has {len(source.classes)} classes; "
            f"set num_classes={len(source.classes)}"
        )


def _warn_of_untrained(data: AdaptationData, classes: Sequence[str]) -> None:
    """Of classes that no cloud teaches: a net cannot name them."""
    train, held_out = (
        np.bincount(part.labels.numpy(), minlength=len(classes))
        for part in (data.labelled, data.validation)
    )
    for no_clouds, why in (
        ((train == 0) & (held_out == 0), "it has none"),
        (
            (train == 0) & (held_out > 0),
            f"data.val={data.labelled_domain.val} holds out all that it has; set "
            "data.val=stratified, which leaves each class one",
        ),
    ):
        if no_clouds.any():
            names = ", ".join(np.array(classes)[no_clouds])
            name = data.labelled_domain.domain.name
            log.warning("%s: nothing is trained of %s: %s", name, names, why)


def _check_norms(run: Run, clouds: int) -> None:
    """Refuse statistics of one target cloud: where a cloud is one vector, that has no variance."""
    norms = run.cfg.evaluation.norms
    if norms != "trained" and clouds < 2:
        raise DataError(
            f"evaluation.norms={norms} takes the statistics of batch norms from the target's "
            f"training clouds, of which {run.target.name} has {clouds}, and two are needed; set "
            "evaluation.norms=trained, or give it more clouds"
        )


def _check_rounds(run: Run, clouds: int) -> None:
    """Refuse rounds on one target cloud before the warm-up: a student's batch needs two."""
    if run.scheme.rounds and clouds < 2:
        raise DataError(
            f"self-training learns from the target's training clouds, of which {run.target.name} "
            f"has {clouds}, and two are needed; set selftraining=none, or give it more clouds"
        )


def _evaluated_split(target: PointSet) -> str:
    """The test split; the training split if there is no other, e.g. of somebody's own scans."""
    if "test" in target.counts():
        if labels_of(target, "test") is None:
            log.warning("%s has no labels: no accuracy, only counts of predictions", target.name)
        return "test"
    log.warning(
        "%s has no test split: no accuracy, only counts of predictions for its training clouds",
        target.name,
    )
    return "train"


def _labels_by_id(dataset: PointSet, split: str) -> dict[str, int] | None:
    labels = labels_of(dataset, split)
    if labels is None:
        return None
    return dict(zip(dataset.split(split).ids, labels.tolist(), strict=True))


def _objects_by_id(dataset: PointSet, domain: Domain) -> dict[str, str]:
    """What each cloud shows: its mesh, or what the publisher's ids tell; where that is known."""
    importer = domain.importer()
    of_id = importer.object_of if importer else lambda _: ""
    rows = read_manifest(domain.folder, dataset.classes)
    known = {row.id: row.mesh_sha256 or of_id(row.id) for row in rows}
    return {id_: name for id_, name in known.items() if name}


def _tiers_by_id(dataset: PointSet, domain: Domain) -> dict[str, str]:
    """How much of its object each cloud shows, as its importer says: "clean" or "hard"."""
    rows = read_manifest(domain.folder, dataset.classes)
    return {row.id: row.more["tier"] for row in rows if row.more.get("tier")}
