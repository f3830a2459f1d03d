"""First stage: the datasets, what training may see of them, and what evaluation holds."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from omegaconf import DictConfig, OmegaConf

from qs3.catalogue import FAMILY
from qs3.config.hydra import build
from qs3.datamodules.adaptation import AdaptationData
from qs3.datamodules.clouds import Clouds, labels_of, load_clouds
from qs3.datamodules.phases import SelfTrainingConfig
from qs3.datasets.domain import Domain
from qs3.errors import ConfigError, DataError
from qs3.evaluation.metrics import Evaluation
from qs3.evaluation.prior import ESTIMATED, Prior, estimate_shares, read_prior, shares_of
from qs3.inference.model_file import Result, read_result
from qs3.methods.base import Method
from qs3.runs.metrics import DataMadeOf, RoundRecord
from qs3.store.meta import ManifestRow, read_manifest
from qs3.store.store import HEIGHTS
from qs3.training.provenance import note_start
from qs3.training.run import Run

log = logging.getLogger(__name__)

_TIMES = 10.0  # larger: centimetres, millimetres, inches, or strays metres away from the object
_BELOW_M = 0.3  # under all of the other domain; floors are known to a decimetre or two
_LOOKED_AT = 1000  # clouds, for the floor: those are read from disk

Shares = Float[np.ndarray, " c"]
"""[C], of the classes in what a net learnt from: u in `qs3.evaluation.prior`."""


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
    labelled: Shares
    learnt: Shares


def read_given(cfg: DictConfig) -> Result | None:
    """The trained classifier that `weights` names, which a run begins with; None without a name.

    Raises:
        MissingDataError, DataError: it is not there, or damaged.
        ConfigError: its net or its clouds are not those of the config.
    """
    if cfg.weights is None:
        return None
    result = read_result(cfg.weights)
    model: Any = OmegaConf.to_container(cfg.model, resolve=True)
    for key in sorted({*model, *result.model} - ({"file"} if "sha256" in model else set())):
        if (was := result.model.get(key)) != model.get(key):
            raise ConfigError(f"weights={cfg.weights} has model.{key}={was}, not {model.get(key)}")
    if result.scale != cfg.data.scale:
        raise ConfigError(f"weights={cfg.weights} has data.scale={result.scale}")
    return result


def load_data(run: Run, method: Method, given: Result | None = None) -> Loaded:
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
        beside_source=method.beside_source,
    )
    data.prepare_data()
    source, target = run.source.open(verify=False), run.target.open(verify=False)
    for classes in (source.classes, *([given.classes] if given else [])):
        if classes != target.classes or len(classes) != cfg.num_classes:
            raise DataError(
                f"the classes {', '.join(classes)} and those of {target.name}, "
                f"{', '.join(target.classes)}, must be the same num_classes={cfg.num_classes}"
            )
    started = note_start(run, source if data.owner == "source" else target, target)
    of_target = run.target.made_of(target)
    labelled = run.source.made_of(source) if data.owner == "source" else of_target
    data.setup("fit")
    labels = data.labelled.labels.numpy()
    counts = np.bincount(labels, minlength=len(target.classes))
    if not counts.all():
        names = ", ".join(np.array(target.classes)[counts == 0])
        log.warning("no labelled cloud for training: %s", names)
    balanced = data.labelled_domain.sampler == "balanced"
    learnt = drawn = shares_of([] if balanced else labels, len(target.classes))
    if given and cfg.selection.teacher == "given" and given.shares is not None:
        learnt = given.shares
    # What is not a prior ends a run before it trains.
    prior_beside(cfg.evaluation, target.classes, learnt, lambda: learnt[None])
    if (few := cfg.data.clouds_a_split) is not None:
        target = target.fewer(few)
    split = "test" if "test" in target.counts() else "train"  # somebody's own scans have no other
    if split == "train" or labels_of(target, split) is None:
        log.warning("%s has no labels for a test: only predictions are counted", target.name)
    cache, scale = data.target_domain.cache_dir, cfg.data.scale
    rows = read_manifest(run.target.folder)
    known = labels_of(target, "train")
    ids = target.split("train").ids
    evaluation = Evaluation(
        load_clouds(target, split, cfg.data.points, cache_dir=cache, scale=scale),
        labels_of(target, split) if split == "test" else None,
        None if known is None else dict(zip(ids, known.tolist(), strict=True)),
        target.classes,
        objects_by_id(rows, run.target),
        {row.id: tier for row in rows if (tier := row.more.get("tier"))},
    )
    tested = [evaluation.test] if split == "test" else []  # else they are those for training
    check_real_sizes(run.target.name, data.all_labelled, data.target, *tested)
    made_of = DataMadeOf(source=labelled, target=of_target)
    return Loaded(data, evaluation, split, target.points.shape[1], started, made_of, drawn, learnt)


def shares_of_student(scheme: SelfTrainingConfig, labelled: Shares, last: RoundRecord) -> Shares:
    """Class shares of the last round's pseudo-labels; with as many of the source, of both."""
    counts = list(last.selected.values())
    pseudo = shares_of(np.repeat(np.arange(len(counts)), counts), len(counts))
    return (pseudo + labelled) / 2 if scheme.use_source else pseudo


def prior_beside(
    settings: Any,
    classes: Sequence[str],
    learnt: Shares,
    probabilities: Callable[[], Float[np.ndarray, "n c"]],
) -> Prior | None:
    """`evaluation.prior` against these shares; None without one.

    `probabilities`: the net's, of the target's training clouds, for shares that are estimated.

    Raises:
        ConfigError: it is not a prior.
    """
    if settings.prior is None:
        return None
    given: Any = settings.prior
    if given == ESTIMATED:
        given = dict(zip(classes, estimate_shares(probabilities(), learnt).tolist(), strict=True))
    given = OmegaConf.to_container(given) if OmegaConf.is_config(given) else given
    return read_prior(given, classes, learnt, settings.prior_power)


def objects_by_id(rows: Sequence[ManifestRow], domain: Domain) -> dict[str, str]:
    """What clouds have in common, so that they are not independent samples; where it is known.

    The structural family of the catalogue's objects, or their mesh, or what a publisher's ids say.
    """
    importer = domain.importer()

    def of(row: ManifestRow) -> str:
        if row.origin.startswith(FAMILY):
            return row.origin
        return row.mesh_sha256 or (importer.object_of(row.id) if importer else "")

    known = {row.id: of(row) for row in rows}
    return {id_: name for id_, name in known.items() if name}


def check_real_sizes(target: str, source: Clouds, *parts: Clouds) -> None:
    """Compare parts of a target's clouds with the labelled ones, if the net sees sizes.

    That they are in metres is the user's word (`unit`, `floor_m`). Files in millimetres would train
    without an error, on a target of which the net then predicts one class. A floor that half of the
    clouds reach through is a warning.

    Raises:
        DataError: more than half of a part are more than ten times as large as any labelled cloud,
            or more than half of the source's clouds compared with all of the target's.
    """
    if source.scale == "unit_ball":
        return
    of_source = source.radius[source.rows]
    for part in parts:
        of_part = part.radius[part.rows]
        large = of_part > _TIMES * of_source.max()
        if np.mean(large) > 0.5 or np.mean(of_source > _TIMES * of_part.max()) > 0.5:
            raise DataError(
                f"{target}: the median radius of its clouds is {np.median(of_part):.3g}, of the "
                f"labelled ones {np.median(of_source):.3g}: one of the two is not in metres"
            )
        if source.scale in HEIGHTS:
            lowest = _lowest(part)
            if np.mean(lowest < _lowest(source).min() - _BELOW_M) > 0.5:
                log.warning("%s: half of the clouds reach below floor_m=%g", target, part.floor)


def _lowest(clouds: Clouds) -> np.ndarray:
    """Height above the floor of the lowest point of each cloud, or of some, evenly spaced."""
    some = np.unique(np.linspace(0, len(clouds) - 1, min(len(clouds), _LOOKED_AT)).astype(int))
    return clouds.at(some).points[:, :, 2].min(dim=1).values.numpy()
