"""One domain as a LightningDataModule, for any LightningModule.

    data = DomainData("specklenet10", points=256, batch_size=32)
    Trainer(max_epochs=10).fit(my_module, data)

or, from conf/datamodule, `hydra.utils.instantiate(cfg.datamodule)` with `+datamodule=domain`.

A batch is `{"points": [B, N, 3] float32, "labels": [B] int64}`: clouds in the unit ball (or in
metres, if `scale` says so), z up, sampled by farthest points. Without labels the key "labels" is
not there; without a trainer, that takes them away, the step's "index" and "epoch" are there too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch import LightningDataModule

from qs3.datamodules.augment import Augment
from qs3.datamodules.batches import Batches, generator_of
from qs3.datamodules.clouds import Clouds, Labelled, labels_of, load_clouds
from qs3.datamodules.splits import first_of_class, lineage
from qs3.datasets.domain import Domain, compose_domain
from qs3.errors import ConfigError, DataError
from qs3.store.store import PointSet


class DomainData(LightningDataModule):
    """Clouds of one domain, loaded from its store.

    Args:
        domain: a `Domain`, or the name of one of conf/domain, such as "modelnet10".
        points: of a cloud as a net sees it.
        scale: "unit_ball", "metres", "above_floor" or "seen": see `Clouds.scale`.
        fps_starts: samples of each training cloud, at least 1, from other first points; an epoch
            draws one.
        batch_size: of training batches, at least 2 (batch norm).
        eval_batch_size: of all others.
        augment: applied to training batches on their device; None leaves them as they are.
        sampler: "shuffled" trains on each cloud once an epoch, "balanced", which takes labels, on
            as many of each class.
        seed: of order, samples and augmentation, each a function of (seed, epoch).
        labels: False reads no label and keeps none; then it has no validation clouds.
        cache_dir: where farthest points are kept for the next time; None keeps none.
        clouds_a_split: only so many clouds of each split, at even steps.
        clouds_a_class: train on the first so many clouds of each class alone, and validate on at
            most as many, which takes labels.
        data_dir: where the dataset of a named domain lies.

    Attributes:
        train, validation, test: clouds of each part, after `setup`.
        whole: clouds of the training split before it was divided, without their labels; with
            `clouds_a_class` those that it leaves.
        classes: names in label order, after `setup`.

    Raises:
        ConfigError, DataError: no such domain, no clouds for training or of such a scale, no labels
            where they are asked for.
        MissingDataError: from `prepare_data`, if files are missing; says how to get them.
    """

    def __init__(
        self,
        domain: Domain | str,
        *,
        points: int = 1024,
        scale: str = "unit_ball",
        fps_starts: int = 4,
        batch_size: int = 16,
        eval_batch_size: int = 64,
        augment: Augment | None = None,
        sampler: str = "shuffled",
        seed: int = 0,
        labels: bool = True,
        cache_dir: str | Path | None = None,
        clouds_a_split: int | None = None,
        clouds_a_class: int | None = None,
        data_dir: str | Path = "data",
    ) -> None:
        super().__init__()
        if isinstance(domain, str):
            domain = compose_domain(domain, {"paths.data_dir": str(data_dir)})
        domain.check_scale(scale)
        assert sampler in ("shuffled", "balanced")
        assert labels or (sampler == "shuffled" and clouds_a_class is None)
        self.domain, self.scale, self.points = domain, scale, points
        self.fps_starts = fps_starts
        self.batch_size, self.eval_batch_size = batch_size, eval_batch_size
        self.augment, self.seed, self.sampler = augment, seed, sampler
        self.has_labels = labels
        self.clouds_a_split, self.clouds_a_class = clouds_a_split, clouds_a_class
        # Indices that are cached are those of whole splits.
        self.cache_dir = Path(cache_dir) if cache_dir and clouds_a_split is None else None
        self.whole: Clouds | None = None
        self.train: Labelled | Clouds | None = None
        self.validation: Labelled | None = None
        self.test: Labelled | Clouds | None = None
        self.classes: tuple[str, ...] = ()
        self._checked = False
        self._epochs = 0  # that have begun without a trainer

    def prepare_data(self) -> None:
        """Bring published files into the store if that has not been done; check it, once."""
        if not self._checked:
            self.domain.open()
            self._checked = True

    def setup(self, stage: str | None = None) -> None:
        """Load what a stage needs, once: "fit" training and validation clouds, "test" the others.

        The dataset itself is not kept: it holds all labels.
        """
        dataset = self.domain.open(verify=False)
        self.classes = tuple(dataset.classes)
        if self.clouds_a_split is not None:
            dataset = dataset.fewer(self.clouds_a_split)
        if stage in (None, "fit", "validate") and self.train is None:
            self._setup_training(dataset)
        if stage in (None, "test", "predict") and self.test is None and "test" in dataset.counts():
            self.test = self._load(dataset, "test", starts=1)

    def train_dataloader(self) -> Loader:
        """Training batches; each pass is the next epoch, or the trainer's."""
        return self._loader(self.train, self.batch_size, shuffle=True)

    def val_dataloader(self) -> Loader | list:
        """Held-out training clouds; nothing without labels."""
        if self.validation is None:
            return []
        return self._loader(self.validation, self.eval_batch_size)

    def test_dataloader(self) -> Loader:
        """The test split, in order."""
        return self._loader(self.test, self.eval_batch_size)

    def predict_dataloader(self) -> Loader:
        """The same."""
        return self.test_dataloader()

    def on_after_batch_transfer(self, batch: dict[str, Any], dataloader_idx: int) -> dict[str, Any]:
        """Augment training batches, on their device."""
        # Lightning could not tell a batch's size for `self.log` if these numbers stayed in it.
        result = {key: value for key, value in batch.items() if key not in ("index", "epoch")}
        if self.augment is None or self.trainer is None or not self.trainer.training:
            return result
        points, rank = batch["points"], self.trainer.global_rank
        chance = generator_of(batch, "augment", self.seed, rank, points.device)
        return {**result, "points": self.augment(points, chance, self.scale)}

    def _setup_training(self, dataset: PointSet) -> None:
        if len(dataset.indices("train")) == 0:
            raise DataError(f"domain {self.domain.name} has no clouds for training (split train)")
        train = self._load(dataset, "train", starts=self.fps_starts)
        if isinstance(train, Clouds):
            self.whole = self.train = train
            return
        labels, left = train.labels.numpy(), train
        chosen, held_out = lineage(train.ids)
        if (few := self.clouds_a_class) is not None:
            chosen, held_out = (first_of_class(part, labels, few) for part in (chosen, held_out))
            left = train.at(np.sort(np.concatenate([chosen, held_out])))
        self.whole = left.clouds
        self.train, self.validation = train.at(chosen), train.at(held_out)

    def _load(self, dataset: PointSet, split: str, starts: int) -> Labelled | Clouds:
        cache = self.cache_dir
        found = load_clouds(dataset, split, self.points, starts, cache, scale=self.scale)
        if not self.has_labels:
            return found
        labels = labels_of(dataset, split)
        if labels is None:
            raise ConfigError(f"the clouds of {dataset.name} have no labels, which are asked for")
        return Labelled(found, labels, balanced=self.sampler == "balanced")

    def _loader(
        self, part: Labelled | Clouds | None, batch_size: int, shuffle: bool = False
    ) -> Loader:
        assert part is not None, "setup() of this stage comes first, and the split has clouds"
        trainer = self.trainer if shuffle else None
        rank, world = (trainer.global_rank, trainer.world_size) if trainer else (0, 1)
        more: dict[str, Any] = {"seed": self.seed, "shuffle": shuffle, "rank": rank, "world": world}
        make = partial(Batches, {"domain": part}, batch_size, **more)
        return Loader(make, self._epoch if shuffle else int)

    def _epoch(self) -> int:
        if self.trainer is not None:
            return self.trainer.current_epoch
        self._epochs += 1
        return self._epochs - 1


class Loader:
    """The batches of one domain that `make` makes anew for each pass, whose `epoch` is asked."""

    def __init__(self, make: Callable[..., Batches], epoch: Callable[[], int]) -> None:
        self._make, self._epoch = make, epoch
        self._length = len(make(epoch=0))

    def __len__(self) -> int:
        return self._length

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for batch in self._make(epoch=self._epoch()):
            yield {**batch["domain"], "index": batch["index"], "epoch": batch["epoch"]}
