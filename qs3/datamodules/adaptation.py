"""What training may see: labelled clouds of one domain, and the target's clouds without labels.

Two `DomainData` and which of them a batch is taken from. The target's test clouds do not come here
at all: only `qs3.evaluation.metrics` holds them.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from lightning.pytorch import LightningDataModule
from torch import Tensor

from qs3.datamodules.augment import Augment
from qs3.datamodules.batches import Batches, Piece, generator_of
from qs3.datamodules.clouds import Clouds, Labelled
from qs3.datamodules.domain import DomainData
from qs3.datamodules.phases import Phases, SelfTrainingConfig
from qs3.datasets.domain import Domain, check_or_make
from qs3.utils.seeding import derive


class AdaptationData(LightningDataModule):
    """Batches of each phase: labelled ones in the warm-up, pseudo-labelled ones in the rounds.

    Args:
        source: labelled domain.
        target: the other one.
        phases: which epoch belongs to which phase.
        scheme: settings of the rounds.
        augment: applied to every training batch, on its device.
        batch_size: of the warm-up, at least 2 (batch norm).
        seed: of the run.
        owner: whose labels are trained on: "source", or "target_train" for the upper bound and
            what lies below it (`method=supervised`, `few_labels`), which alone ask for them.
        uses_target: whether warm-up batches hold unlabelled target clouds as well.
        beside_source: whether they hold the source's with their labels, too, as "beside".
        make_source: a generated source that is not there is made first.
        sampler, clouds_a_class: of the labelled domain, see `DomainData`. "balanced" is for
            the source alone: to balance the target's classes takes its true labels.
        shared: points, scale, fps_starts, eval_batch_size, cache_dir and clouds_a_split of both.

    Attributes:
        labelled_domain, target_domain: what it is composed of.
        labelled, validation: clouds of the warm-up, and the held-out ones, after `setup`.
        all_labelled: both of these, without their labels, likewise.
        target: its training clouds, likewise.
        pseudo: positions in `target` [m] and their labels [m], or class probabilities [m, C],
            which the rounds train on; None in the warm-up.
    """

    def __init__(
        self,
        source: Domain,
        target: Domain,
        *,
        phases: Phases,
        scheme: SelfTrainingConfig,
        augment: Augment,
        batch_size: int,
        seed: int,
        owner: str = "source",
        uses_target: bool = False,
        beside_source: bool = False,
        make_source: bool = False,
        sampler: str = "shuffled",
        clouds_a_class: int | None = None,
        **shared: Any,
    ) -> None:
        super().__init__()
        assert sampler == "shuffled" or owner == "source"
        self.source, self.make_source = source, make_source
        labelled = source if owner == "source" else target
        shown: dict[str, Any] = {"sampler": sampler, "clouds_a_class": clouds_a_class}
        self.labelled_domain = DomainData(labelled, **shown, **shared)
        self.target_domain = DomainData(target, labels=False, **shared)
        self.beside_domain = DomainData(source, **shared) if beside_source else None
        self.owner, self.uses_target = owner, uses_target
        self.phases, self.scheme, self.augment = phases, scheme, augment
        self.scale = self.target_domain.scale
        self.eval_batch_size = self.target_domain.eval_batch_size
        self.batch_size, self.seed = batch_size, seed
        self.pseudo: tuple[Tensor, Tensor] | None = None

    def prepare_data(self) -> None:
        """Make the source if it is to be made, bring published files into the stores, check them.

        Raises:
            MissingDataError: one or both are not there; says how to get them.
        """
        check_or_make(self.source, self.target_domain.domain, self.make_source)
        for part in (self.labelled_domain, self.target_domain, self.beside_domain):
            if part is not None:
                part.prepare_data()

    def setup(self, stage: str | None = None) -> None:
        """Load the training clouds of both; for evaluation see `qs3.evaluation.metrics`."""
        labelled, target = self.labelled_domain, self.target_domain
        for part in (labelled, target, self.beside_domain):
            if part is not None:
                part.setup("fit")
        assert isinstance(labelled.train, Labelled)
        assert isinstance(target.train, Clouds)
        assert labelled.whole is not None
        assert labelled.validation is not None
        self.labelled, self.validation = labelled.train, labelled.validation
        self.all_labelled, self.target = labelled.whole, target.train

    def train_dataloader(self) -> Batches:
        """The batches of the current epoch (the trainer asks anew each epoch)."""
        epoch = self.trainer.current_epoch if self.trainer else 0
        warmup = self.phases.phase(epoch) == 0
        parts: dict[str, Clouds | Labelled] = {}
        if not warmup:
            assert self.pseudo is not None, "a round has begun without pseudo-labels"
            index, labels = self.pseudo
            parts["target"] = Labelled(self.target.at(index.numpy()), labels, "y_pseudo")
        if warmup or self.scheme.use_source:
            parts["source"] = replace(self.labelled, owner=f"y_{self.owner}")
        if warmup and self.uses_target:
            parts["target"] = self.target
        if warmup and self.beside_domain is not None:
            assert isinstance(self.beside_domain.train, Labelled)
            parts["beside"] = replace(self.beside_domain.train, owner="y_source")
        steps = self.phases.steps(epoch)
        start, _ = self.phases.span(self.phases.phase(epoch))
        return Batches(
            parts,
            self.batch_size if warmup else self.scheme.batch_size,
            seed=self.seed,
            epoch=epoch,
            rank=self.trainer.global_rank if self.trainer else 0,
            world=self.trainer.world_size if self.trainer else 1,
            piece=None if steps is None else Piece(start, *steps),
            pinned=self._pinned(),
        )

    def val_dataloader(self) -> Batches:
        """Validation clouds of the labelled domain, all of them in every process.

        In the order of their ids, which begin with the class; or, where the trainer takes the first
        batches alone, in one that knows no class: else a teacher would be chosen by the first ones.
        """
        part = self.validation
        limit = 1.0 if self.trainer is None else self.trainer.limit_val_batches
        if isinstance(limit, int) or limit != 1.0:  # 1 is one batch, 1.0 are all
            order = [derive(0, "validation order", name) for name in part.ids]
            part = part.at(np.argsort(np.array(order)))
        return self._in_order("source", replace(part, owner=f"y_{self.owner}"))

    def predict_dataloader(self) -> Batches:
        """The target's training clouds, in order and without labels."""
        return self._in_order("target", self.target)

    def on_after_batch_transfer(self, batch: dict[str, Any], dataloader_idx: int) -> dict[str, Any]:
        """Augment training batches, each domain with its own randomness."""
        if self.trainer is None or not self.trainer.training:
            return batch
        rank, result = self.trainer.global_rank, dict(batch)
        for name, part in batch.items():
            if isinstance(part, dict):
                chance = generator_of(batch, name, self.seed, rank, part["points"].device)
                moved = self.augment(part["points"], chance, self.scale)
                result[name] = {**part, "points": moved}
        return result

    def state_dict(self) -> dict[str, Any]:
        """The pseudo-labels in use."""
        return {} if self.pseudo is None else {"index": self.pseudo[0], "labels": self.pseudo[1]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore `state_dict`."""
        self.pseudo = (state_dict["index"], state_dict["labels"]) if state_dict else None

    def _in_order(self, name: str, part: Clouds | Labelled) -> Batches:
        size, pinned = self.eval_batch_size, self._pinned()
        return Batches({name: part}, size, seed=self.seed, epoch=0, shuffle=False, pinned=pinned)

    def _pinned(self) -> bool:
        return self.trainer is not None and self.trainer.strategy.root_device.type == "cuda"
