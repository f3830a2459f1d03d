"""One domain as a LightningDataModule, for any LightningModule.

    data = SpeckleNetData(points=256, batch_size=32)
    Trainer(max_epochs=10).fit(my_module, data)

or, from conf/datamodule, `hydra.utils.instantiate(cfg.datamodule)` with `+datamodule=specklenet`.

A batch is `{"points": [B, N, 3] float32, "labels": [B] int64}`: clouds in the unit ball (or in
metres, if `scale` says so), z up, sampled by farthest points. Without labels the key "labels" is
not there; without a trainer, that takes them away, the step's "index" and "epoch" are there too.
With `twin="whole"` a training batch holds each cloud's whole object as "twin", turned alike.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor

from qs3.config.checks import check_bool, check_choice, check_int
from qs3.datamodules.augment import Augment
from qs3.datamodules.batches import Batches, Table, generator_of
from qs3.datamodules.beside import SOURCE_TWINS, beside_sha256, views_of
from qs3.datamodules.clouds import Clouds
from qs3.datamodules.random_views import RandomViews
from qs3.datamodules.splits import (
    Labelled,
    Unlabelled,
    first_of_class,
    labels_of,
    load_clouds,
    subsample_splits,
)
from qs3.datamodules.twins import augmented
from qs3.datamodules.validation_split import RULES
from qs3.datasets.domain import Domain, compose_domain
from qs3.errors import ConfigError, DataError
from qs3.store.store import PointSet

SAMPLERS = ("shuffled", "balanced")


class DomainData(LightningDataModule):
    """Clouds of one domain, loaded from its store.

    Args:
        domain: a `Domain`, or the name of one of conf/domain, such as "modelnet10".
        points: of a cloud as a net sees it.
        scale: "unit_ball", "metres" for clouds that keep their size, or "above_floor" for those
            that keep their height above the floor, too.
        fps_starts: samples of each training cloud, at least 1, from other first points; an epoch
            draws one.
        batch_size: of training batches, at least 2 (batch norm).
        eval_batch_size: of all others, at least 1.
        augment: applied to training batches on their device; None leaves them as they are.
        val: rule that takes validation clouds from the training split (`validation_split.RULES`).
        sampler: "shuffled" trains on each cloud once an epoch, "balanced", which takes labels, on
            as many of each class.
        seed: of order, samples and augmentation, each a function of (seed, epoch).
        labels: False reads no label and keeps none; then there are no validation clouds.
        cache_dir: where farthest points are kept for the next time; None keeps none.
        clouds_a_split: only so many clouds of each split, at even steps; at least 1.
        clouds_a_class: train on the first so many clouds of each class alone, and validate on at
            most as many, which takes labels; at least 1.
        data_dir: where the dataset of a named domain lies.
        asks: who needs the labels, for the message where there are none; None: the domain.
        twin: one of `beside.SOURCE_TWINS`: load the twins of the training clouds, too.

    Attributes:
        train, validation, test: clouds of each part, after `setup`.
        whole: clouds of the training split before it was divided, without their labels; with
            `clouds_a_class` those that it leaves.
        twins: of the clouds of `whole`, after `setup`; None if they were not asked for.
        random_views: what is drawn from in place of `whole`, after `setup`; None unless
            `domain.views` says so. Validation and test clouds are those that are stored.
        classes: names in label order, after `setup`.
        sha256: of the dataset, after `setup`.
        beside_sha256: of what is loaded beside it, after `prepare_data`; "" if nothing is.

    Raises:
        ConfigError: no such domain, rule, sampler or scale; a number is none or too small; labels
            are asked for and there are none, or a setting takes them and `labels` is False; metres
            are asked for and the clouds are not in metres, or heights above a floor of which nobody
            knows where it is.
        DataError: from a loader, if its clouds have not been set up or there is no such split.
        MissingDataError: from `prepare_data`, if there are no files; says how to get them.
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
        val: str = "lineage",
        sampler: str = "shuffled",
        seed: int = 0,
        labels: bool = True,
        cache_dir: str | Path | None = None,
        clouds_a_split: int | None = None,
        clouds_a_class: int | None = None,
        data_dir: str | Path = "data",
        asks: str | None = None,
        twin: str | None = None,
    ) -> None:
        super().__init__()
        if isinstance(domain, str):
            domain = compose_domain(domain, {"paths.data_dir": str(data_dir)})
        domain.check_scale(scale)
        self.domain, self.scale = domain, scale
        self.points = check_int("data.points", points, 1)
        self.fps_starts = check_int("data.fps_starts", fps_starts, 1)
        self.batch_size = check_int("data.batch_size", batch_size, 2)
        self.eval_batch_size = check_int("data.eval_batch_size", eval_batch_size, 1)
        self.seed = check_int("data.seed", seed, 0)
        self.augment, self.has_labels = augment, check_bool("data.labels", labels)
        self.val = check_choice("data.val", val, sorted(RULES))
        self.sampler = check_choice("data.sampler", sampler, SAMPLERS)
        few, each = clouds_a_split, clouds_a_class
        self.clouds_a_split = few if few is None else check_int("data.clouds_a_split", few, 1)
        self.clouds_a_class = each if each is None else check_int("data.clouds_a_class", each, 1)
        if not labels and (sampler == "balanced" or each is not None):
            key = "sampler=balanced" if sampler == "balanced" else f"clouds_a_class={each}"
            raise ConfigError(f"data.{key} goes by classes, but data.labels=false reads no label")
        self.twin = twin if twin is None else check_choice("twin", twin, sorted(SOURCE_TWINS))
        self.asks = asks or f"domain {domain.name}"
        # Indices that are cached are those of whole splits.
        self.cache_dir = Path(cache_dir) if cache_dir and clouds_a_split is None else None
        self.whole: Unlabelled | None = None
        self.train: Labelled | Unlabelled | None = None
        self.twins: Clouds | None = None
        self.random_views: RandomViews | None = None
        self.validation: Labelled | None = None
        self.test: Labelled | Unlabelled | None = None
        self.classes: tuple[str, ...] = ()
        self.sha256 = self.beside_sha256 = ""
        self._checked = False
        self._epochs = 0  # that have begun without a trainer

    def prepare_data(self) -> None:
        """Bring published files into the store if that has not been done; check it, once."""
        if not self._checked:
            self.domain.open()
            self.beside_sha256 = beside_sha256(self.domain, self.twin, verify=True)
            self._checked = True

    def setup(self, stage: str | None = None) -> None:
        """Load what a stage needs, once: "fit" training and validation clouds, "test" the others.

        The dataset itself is not kept: it holds all labels.
        """
        dataset = self.domain.open(verify=False)
        self.classes, self.sha256 = tuple(dataset.classes), dataset.sha256
        dataset = self._fewer(dataset)
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
        rank, device = self.trainer.global_rank, batch["points"].device

        def generator(use: str) -> torch.Generator:
            return generator_of(batch, f"augment {use}".strip(), self.seed, rank, device)

        return augmented(self.augment, result, generator, self.scale, together=True)

    def training_table(self, labels: Mapping[str, Tensor], balance: str | None = None) -> Table:
        """The training clouds, for `Batches`: random views in their place if the domain says so."""
        assert self.train is not None, "setup() comes first"
        clouds = self.train.clouds
        drawn = self.random_views
        return Table(clouds, labels, balance, {"points": drawn.at(clouds.rows)} if drawn else {})

    def with_twins(self, table: Table) -> Table:
        """A table of training clouds with their twins, row by row, under "twin"."""
        if self.twins is not None:
            twins = self.twins.at(table.clouds.rows)
        elif self.random_views is not None:  # "scan": each cloud is its own, as it was drawn
            return replace(table, repeated=("twin",))
        else:
            twins = table.clouds
        return replace(table, beside={**table.beside, "twin": twins})

    def _fewer(self, dataset: PointSet) -> PointSet:
        few = self.clouds_a_split
        return dataset if few is None else subsample_splits(dataset, few)

    def _setup_beside(self) -> None:
        """Twins and random views of the training split, as many and in the order of its clouds."""
        if self.twin and (array := SOURCE_TWINS[self.twin]):
            twins = self._fewer(self.domain.open_array(array, verify=False))
            self.twins = self._clouds(twins, "train", self.fps_starts).clouds
        if self.domain.views == "random":
            measured, exact = (
                [self._fewer(one).split("train").points for one in kept]
                for kept in views_of(self.domain, verify=False)
            )
            rows, floor = np.arange(len(measured[0])), self.domain.floor_m or 0.0
            self.random_views = RandomViews(measured, exact, self.points, rows, self.scale, floor)

    def _setup_training(self, dataset: PointSet) -> None:
        if len(dataset.indices("train")) == 0:
            raise DataError(
                f"domain {self.domain.name}: {dataset.name} has no clouds for training, only for "
                f"{' and '.join(sorted(dataset.counts()))}, and a training takes some of its "
                "source and of its target: put them into a folder train/, or an archive of "
                "objects needs parts (`dev`), some of them in published.train_parts; then delete "
                f"{self.domain.folder} to import it again"
            )
        self._setup_beside()
        train = self._load(dataset, "train", starts=self.fps_starts)
        if isinstance(train, Unlabelled):
            self.whole = self.train = train
            return
        labels, left = train.labels.numpy(), train
        chosen, held_out = RULES[self.val](train.ids, labels)
        if (few := self.clouds_a_class) is not None:
            chosen, held_out = (first_of_class(part, labels, few) for part in (chosen, held_out))
            left = train.at(np.sort(np.concatenate([chosen, held_out])))
        self.whole = Unlabelled(left.clouds, left.ids)
        self.train, self.validation = train.at(chosen), train.at(held_out)

    def _load(self, dataset: PointSet, split: str, starts: int) -> Labelled | Unlabelled:
        found = self._clouds(dataset, split, starts)
        if not self.has_labels:
            return found
        labels = labels_of(dataset, split)
        if labels is None:
            raise ConfigError(
                f"{self.asks} needs labels, but the clouds of {dataset.name} have none; label "
                "them, or choose another dataset or method"
            )
        return Labelled(found.clouds, found.ids, labels)

    def _clouds(self, dataset: PointSet, split: str, starts: int) -> Unlabelled:
        return load_clouds(dataset, split, self.points, starts, self.cache_dir, scale=self.scale)

    def _loader(
        self, part: Labelled | Unlabelled | None, batch_size: int, shuffle: bool = False
    ) -> Loader:
        if part is None:
            raise DataError(
                f"domain {self.domain.name}: these clouds are not loaded; call setup() for this "
                "stage first. If that was done, its dataset has no such split"
            )
        labels = {"labels": part.labels} if isinstance(part, Labelled) else {}
        balance = "labels" if labels and shuffle and self.sampler == "balanced" else None
        trainer = self.trainer
        rank, world = (trainer.global_rank, trainer.world_size) if trainer else (0, 1)

        table = Table(part.clouds, labels, balance)
        if shuffle:
            table = self.training_table(labels, balance)
            if self.twin:
                table = self.with_twins(table)

        def batches(epoch: int) -> Batches:
            return Batches(
                {Loader.KEY: table},
                batch_size,
                seed=self.seed,
                epoch=epoch,
                shuffle=shuffle,
                rank=rank if shuffle else 0,
                world=world if shuffle else 1,
            )

        return Loader(batches, self._epoch if shuffle else int)

    def _epoch(self) -> int:
        if self.trainer is not None:
            return self.trainer.current_epoch
        self._epochs += 1
        return self._epochs - 1


class Loader:
    """Batches of one domain, made anew for each pass.

    Args:
        make: the batches of an epoch, of a table called `KEY`.
        epoch: which one the next pass is.
    """

    KEY: ClassVar[str] = "domain"

    def __init__(self, make: Callable[[int], Batches], epoch: Callable[[], int]) -> None:
        self._make, self._epoch = make, epoch
        self._length = len(make(0))

    def __len__(self) -> int:
        return self._length

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for batch in self._make(self._epoch()):
            yield {**batch[self.KEY], "index": batch["index"], "epoch": batch["epoch"]}


class SpeckleNetData(DomainData):
    """SpeckleNet10: CAD meshes as a simulated speckle-stereo sensor sees them; see `DomainData`."""

    def __init__(self, domain: Domain | str = "specklenet10", **settings: Any) -> None:
        super().__init__(domain, **settings)


class ModelNetData(DomainData):
    """ModelNet10: samples of the meshes' surfaces; see `DomainData`."""

    def __init__(self, domain: Domain | str = "modelnet10", **settings: Any) -> None:
        super().__init__(domain, **settings)


class DepthScanNetData(DomainData):
    """DepthScanNet10: objects of ScanNet's depth images, the real target; see `DomainData`."""

    def __init__(self, domain: Domain | str = "depthscannet10", **settings: Any) -> None:
        super().__init__(domain, **settings)
