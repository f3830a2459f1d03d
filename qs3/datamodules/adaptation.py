"""What training may see: labelled clouds of one domain, and the target's clouds without labels.

Labels have owners. `Labelled` clouds may be trained on; `Unlabelled` ones have no labels to give.
The target's test clouds do not come here at all: only `qs3.evaluation.metrics` holds them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from lightning.pytorch import LightningDataModule
from torch import Tensor

from qs3.config.checks import check_choice
from qs3.data.store import PointSet
from qs3.datamodules.augment import Augment
from qs3.datamodules.batches import Batches, Table, generator_of
from qs3.datamodules.clouds import Clouds
from qs3.datamodules.fps_cache import prepare
from qs3.datamodules.phases import Phases, Scheme
from qs3.datamodules.validation_split import RULES
from qs3.errors import ConfigError

SAMPLERS = ("shuffled", "balanced")


@dataclass(frozen=True, eq=False)
class Unlabelled:
    """n clouds with their ids."""

    clouds: Clouds
    ids: tuple[str, ...]

    @property
    def points(self) -> Float[Tensor, "n m 3"]:
        """The clouds in memory as evaluation sees them; made anew each time."""
        return self.clouds.all()


@dataclass(frozen=True, eq=False)
class Labelled:
    """n clouds with their ids and labels [n] int64."""

    clouds: Clouds
    ids: tuple[str, ...]
    labels: Int[Tensor, " n"]

    def at(self, index: np.ndarray) -> Labelled:
        """A part."""
        ids = tuple(self.ids[i] for i in index)
        return Labelled(self.clouds.at(index), ids, self.labels[torch.from_numpy(index)])


def load_clouds(
    dataset: PointSet, split: str, points: int, starts: int = 1, cache_dir: Path | None = None
) -> Unlabelled:
    """A split's clouds, prepared (see `prepare`), without their labels."""
    part = dataset.split(split)
    key = f"{dataset.name}-{dataset.sha256[:16]}-{split}"
    clouds = prepare(part.points, points, starts=starts, cache_dir=cache_dir, key=key)
    return Unlabelled(clouds, part.ids)


def labels_of(dataset: PointSet, split: str) -> Int[Tensor, " n"] | None:
    """A split's labels, for those who may have them; None if the dataset has none."""
    if not dataset.labelled:
        return None
    return torch.from_numpy(np.array(dataset.labels[dataset.indices(split)]))


def with_labels(clouds: Unlabelled, dataset: PointSet, split: str, what: str) -> Labelled:
    """The clouds of `load_clouds` with their labels.

    Args:
        clouds: of this split.
        dataset: theirs.
        split: theirs.
        what: who asks for labels, for the message.

    Raises:
        ConfigError: the dataset has no labels.
    """
    labels = labels_of(dataset, split)
    if labels is None:
        raise ConfigError(
            f"{what} needs labels, but the clouds of {dataset.name} have none; label them, or "
            "choose another dataset or method"
        )
    return Labelled(clouds.clouds, clouds.ids, labels)


def few_of_each_split(dataset: PointSet, count: int) -> PointSet:
    """At most `count` clouds of each split, at even steps; for `debug=fast`.

    They keep their order and ids, and the hash is still that of the whole dataset.
    """
    chosen: list[int] = []
    for split in dataset.counts():
        members = dataset.indices(split)
        few = min(count, len(members))
        chosen += [int(members[i * len(members) // few]) for i in range(few)]
    return dataset.at(np.sort(chosen))


def first_of_each_class(labelled: Labelled, count: int) -> Labelled:
    """The first `count` clouds of each class, in their order; for `debug=overfit`."""
    chosen = np.zeros(len(labelled.ids), dtype=bool)
    for k in labelled.labels.unique().tolist():
        chosen[np.flatnonzero(labelled.labels.numpy() == k)[:count]] = True
    return labelled.at(np.flatnonzero(chosen))


class UdaData(LightningDataModule):
    """Batches of each phase: labelled ones in the warm-up, pseudo-labelled ones in the rounds.

    Args:
        labelled: training clouds with labels.
        owner: whose labels these are: "source", or "target_train" for the upper bound
            (`method=supervised`), which alone asks for them.
        target: the target's training clouds.
        phases: which epoch belongs to which phase.
        scheme: settings of the rounds.
        augment: applied to every training batch, on its device.
        batch_size: of the warm-up, at least 2 (batch norm).
        seed: of the run.
        val: rule that takes a validation set from `labelled` (see
            `qs3.datamodules.validation_split`).
        sampler: "shuffled" trains on each labelled cloud once an epoch; "balanced" on as many
            clouds of each class (see `qs3.datamodules.batches.balanced`). For the source alone: how
            often the target's classes occur is not known.
        uses_target: whether warm-up batches hold unlabelled target clouds as well.
    """

    def __init__(
        self,
        labelled: Labelled,
        target: Unlabelled,
        *,
        phases: Phases,
        scheme: Scheme,
        augment: Augment,
        batch_size: int,
        seed: int,
        owner: str = "source",
        val: str = "lineage",
        sampler: str = "shuffled",
        eval_batch_size: int = 64,
        uses_target: bool = False,
    ) -> None:
        super().__init__()
        rule = RULES[check_choice("data.val", val, sorted(RULES))]
        train, validation = rule(labelled.ids, labelled.labels.numpy())
        self.labelled, self.validation = labelled.at(train), labelled.at(validation)
        self.target = target
        self.sampler = check_choice("data.sampler", sampler, SAMPLERS)
        if sampler == "balanced" and owner != "source":
            raise ConfigError(
                "data.sampler=balanced draws source clouds only. Balancing the target's classes "
                "takes its true labels, which one released code does and which makes its figures "
                "incomparable; set data.sampler=shuffled"
            )
        self.owner, self.uses_target = owner, uses_target
        self.phases, self.scheme, self.augment = phases, scheme, augment
        self.batch_size, self.eval_batch_size, self.seed = batch_size, eval_batch_size, seed
        self.pseudo: tuple[Tensor, Tensor] | None = None  # indices into target, labels

    def set_pseudo_labels(self, index: Tensor, labels: Tensor) -> None:
        """What the next round trains on: positions in `target` [m], and their labels [m]."""
        self.pseudo = (index, labels)

    def train_dataloader(self) -> Batches:
        """The batches of the current epoch (the trainer asks anew each epoch)."""
        epoch = self.trainer.current_epoch if self.trainer else 0
        warmup = self.phases.phase(epoch) == 0
        tables = {} if not warmup and not self.scheme.use_source else {"source": self._labelled()}
        if not warmup:
            tables = {"target": self._pseudo_labelled(), **tables}
        elif self.uses_target:
            tables["target"] = Table(self.target.clouds, {})
        return Batches(
            tables,
            self.batch_size if warmup else self.scheme.batch_size,
            seed=self.seed,
            epoch=epoch,
            rank=self.trainer.global_rank if self.trainer else 0,
            world=self.trainer.world_size if self.trainer else 1,
        )

    def val_dataloader(self) -> Batches:
        """Validation clouds of the labelled domain, all of them in every process."""
        table = Table(self.validation.clouds, {f"y_{self.owner}": self.validation.labels})
        return Batches(
            {"source": table}, self.eval_batch_size, seed=self.seed, epoch=0, shuffle=False
        )

    def on_after_batch_transfer(self, batch: dict[str, Any], dataloader_idx: int) -> dict[str, Any]:
        """Augment training batches, each domain with its own randomness."""
        if self.trainer is None or not self.trainer.training:
            return batch
        result = dict(batch)
        for name, part in batch.items():
            if isinstance(part, dict):
                points, rank = part["points"], self.trainer.global_rank
                generator = generator_of(batch, name, self.seed, rank, points.device)
                result[name] = {**part, "points": self.augment(points, generator)}
        return result

    def state_dict(self) -> dict[str, Any]:
        """The pseudo-labels in use."""
        return {} if self.pseudo is None else {"index": self.pseudo[0], "labels": self.pseudo[1]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore `state_dict`."""
        self.pseudo = (state_dict["index"], state_dict["labels"]) if state_dict else None

    def _labelled(self) -> Table:
        y = f"y_{self.owner}"
        balance = y if self.sampler == "balanced" else None
        return Table(self.labelled.clouds, {y: self.labelled.labels}, balance)

    def _pseudo_labelled(self) -> Table:
        assert self.pseudo is not None, "a round has begun without pseudo-labels"
        index, labels = self.pseudo
        return Table(self.target.clouds.at(index.numpy()), {"y_pseudo": labels})
