"""What training may see: labelled clouds of one domain, and the target's clouds without labels.

Labels have owners. `Labelled` clouds may be trained on; `Unlabelled` ones have no labels to give.
The target's test clouds do not come here at all: only `qs3.evaluation` holds them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor

from qs3.data.augment import Augment
from qs3.data.batches import Batches, Table, generator_of
from qs3.data.prepare import prepare
from qs3.data.store import PointSet
from qs3.errors import DataError
from qs3.selftraining.scheme import Phases, Scheme
from qs3.settings import one_of


@dataclass(frozen=True, eq=False)
class Labelled:
    """Clouds [n, p, 3] with their ids and labels [n] int64."""

    points: Tensor
    ids: tuple[str, ...]
    labels: Tensor

    def at(self, index: np.ndarray) -> Labelled:
        """A part."""
        rows = torch.from_numpy(index)
        return Labelled(self.points[rows], tuple(self.ids[i] for i in index), self.labels[rows])


@dataclass(frozen=True, eq=False)
class Unlabelled:
    """Clouds [n, p, 3] with their ids."""

    points: Tensor
    ids: tuple[str, ...]


def load_clouds(dataset: PointSet, split: str, points: int, cache_dir: Path | None) -> Labelled:
    """A split's clouds, prepared (see `prepare`)."""
    part = dataset.split(split)
    key = f"{dataset.name}-{dataset.sha256[:16]}-{split}"
    clouds = prepare(part.points, points, cache_dir, key)
    return Labelled(torch.from_numpy(clouds), part.ids, torch.from_numpy(np.array(part.labels)))


def without_labels(clouds: Labelled) -> Unlabelled:
    """The clouds alone."""
    return Unlabelled(clouds.points, clouds.ids)


def split_lineage(clouds: Labelled) -> tuple[Labelled, Labelled]:
    """(train, validation): of the objects sorted by id, positions with i % 10 >= 8 validate.

    The rule of DefRec, GAST and QS3. Ids begin with the class, so each class is split 4 : 1.
    Further scans of an object (`generate.py scans=N` calls them id~1, id~2, ...) go where it
    goes: else training would see the validation shapes.

    Raises:
        DataError: fewer than nine objects, so that there is nothing to validate on.
    """
    order = np.argsort(np.array(clouds.ids), kind="stable")
    objects, place = np.unique(
        [_FURTHER_SCAN.sub("", name) for name in clouds.ids], return_inverse=True
    )
    validation = place[order] % 10 >= 8
    if not validation.any():
        raise DataError(
            f"only {len(objects)} labelled training objects; at least 9 are needed, so that every "
            "ninth and tenth can validate"
        )
    return clouds.at(order[~validation]), clouds.at(order[validation])


_FURTHER_SCAN = re.compile(r"~\d+$")
_SPLITS = {"lineage": split_lineage}


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
        val: rule that takes a validation set from `labelled`.
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
        eval_batch_size: int = 64,
        uses_target: bool = False,
    ) -> None:
        super().__init__()
        split = _SPLITS[one_of("data.val", val, sorted(_SPLITS))]
        self.labelled, self.validation = split(labelled)
        self.target = target
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
            tables["target"] = Table(self.target.points, {})
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
        table = Table(self.validation.points, {f"y_{self.owner}": self.validation.labels})
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
        return Table(self.labelled.points, {f"y_{self.owner}": self.labelled.labels})

    def _pseudo_labelled(self) -> Table:
        assert self.pseudo is not None, "a round has begun without pseudo-labels"
        index, labels = self.pseudo
        return Table(self.target.points[index], {"y_pseudo": labels})
