"""One domain for anybody's LightningModule: what its loaders give, and in which order."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch import LightningModule, Trainer
from torch import nn

from qs3.datamodules.augment import Augment
from qs3.datamodules.clouds import Clouds, Labelled
from qs3.datamodules.domain import DomainData
from qs3.errors import ConfigError
from qs3.geometry.sampling import unit_ball
from qs3.store.store import PointSet, open_pointset
from tests.composing import compose_domain
from tests.training.search import Truth, search
from tests.training.test_target_labels import TEST, TRAIN, truth_of, write_shuffled_target
from tests.training.toy import CLASSES, TinyNet, write_domain

# Lightning 2.6.6 asks torch 2.13 in an old way; not ours to fix.
pytestmark = pytest.mark.filterwarnings("ignore:.*LeafSpec.* is deprecated:FutureWarning")


class Mine(LightningModule):
    """Somebody's own: it knows Lightning, and the two keys of a batch."""

    def __init__(self) -> None:
        super().__init__()
        self.net, self.seen = TinyNet(3), []

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> torch.Tensor:
        self.seen.append((self.current_epoch, batch))
        loss = nn.functional.cross_entropy(self.net(batch["points"]), batch["labels"])
        self.log("loss", loss, on_epoch=True)
        return loss

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        self.judge("val", batch)

    def test_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        self.judge("test", batch)

    def judge(self, name: str, batch: dict[str, Any]) -> None:
        right = (self.net(batch["points"]).argmax(1) == batch["labels"]).float().mean()
        self.log(f"{name}/acc", right)

    def predict_step(self, batch: dict[str, Any], batch_idx: int) -> torch.Tensor:
        return self.net(batch["points"]).argmax(1)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(self.parameters(), 0.02)


def trainer_of(folder: Path, epochs: int = 2) -> Trainer:
    return Trainer(
        max_epochs=epochs, accelerator="cpu", logger=False, default_root_dir=folder,
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip


def made(data_dir: Path, **settings: Any) -> DomainData:
    """Ready for everything, without a trainer."""
    settings = {"points": 32, "batch_size": 8, **settings}
    data = DomainData(settings.pop("domain", "specklenet10"), data_dir=data_dir, **settings)
    data.prepare_data()
    data.setup()
    return data


def clouds_of(batches: Any) -> torch.Tensor:
    return torch.cat([batch["points"] for batch in batches])


def labels_of(batches: Any) -> list[int]:
    return torch.cat([batch["labels"] for batch in batches]).tolist()


# --- with a trainer ----------------------------------------------------------------------------


def test_five_lines_train_test_and_predict(data_dir, tmp_path):
    trainer = trainer_of(tmp_path)
    data = DomainData("specklenet10", points=32, batch_size=8, data_dir=data_dir)
    module = Mine()
    trainer.fit(module, data)
    assert trainer.callback_metrics["val/acc"] > 0.6
    (tested,) = trainer.test(module, data, verbose=False)
    predicted = torch.cat(trainer.predict(module, data))
    right = predicted == torch.tensor(labels_of(data.test_dataloader()))
    assert tested["test/acc"] == pytest.approx(right.float().mean().item())
    assert len(predicted) == 24

    parts = [[batch for epoch, batch in module.seen if epoch == e] for e in (0, 1)]
    assert [len(part) for part in parts] == [8, 8]  # of 58 clouds
    assert {tuple(batch) for part in parts for batch in part} == {("points", "labels")}
    assert sorted(labels_of(parts[0])) == sorted(data.train.labels.tolist())
    assert labels_of(parts[0]) != labels_of(parts[1])


def test_epochs_are_a_function_of_seed_and_number_with_and_without_a_trainer(data_dir, tmp_path):
    settings: dict[str, Any] = {"points": 32, "batch_size": 8, "data_dir": data_dir}

    def trained(**more: Any) -> list[torch.Tensor]:
        module = Mine()
        trainer_of(tmp_path).fit(module, DomainData("specklenet10", **settings, **more))
        return [clouds_of(b for epoch, b in module.seen if epoch == e) for e in (0, 1)]

    def by_hand(**more: Any) -> list[torch.Tensor]:
        data = DomainData("specklenet10", **settings, **more)
        data.setup("fit")
        return [clouds_of(data.train_dataloader()) for _ in range(2)]

    first, second = trained()
    assert not torch.equal(first, second)
    for others in (trained(), by_hand()):
        assert torch.equal(first, others[0])
        assert torch.equal(second, others[1])
    loader = made(data_dir).train_dataloader()  # one for all epochs is the same
    assert len(loader) == len(loader) == 8
    for epoch in (first, second):
        assert torch.equal(clouds_of(loader), epoch)
    assert not torch.equal(first, by_hand(seed=1)[0])
    turned, again = (trained(augment=Augment(jitter_sigma=0.0))[0] for _ in range(2))
    assert torch.equal(turned, again)
    assert torch.equal(turned[..., 2], first[..., 2])  # gravity stays
    assert ((turned - first).abs().amax(dim=(1, 2)) > 1e-3).float().mean() > 0.9


# --- what the loaders give ---------------------------------------------------------------------


def test_batches_are_the_clouds_of_the_store(data_dir):
    data = made(data_dir, points=64, fps_starts=1)
    store = open_pointset(data_dir / "specklenet10")
    assert data.classes == store.classes
    for part, split in ((data.whole, "train"), (data.test, "test")):
        assert part.ids == store.split(split).ids
    assert data.test.labels.tolist() == store.split("test").labels.tolist()
    by_id = dict(zip(store.ids, store.labels.tolist(), strict=True))
    for part in (data.train, data.validation):
        assert part.labels.tolist() == [by_id[id_] for id_ in part.ids]
    (batch,) = data.test_dataloader()
    assert batch["points"].dtype == torch.float32
    assert batch["labels"].dtype == torch.int64
    expected = np.stack([unit_ball(cloud) for cloud in store.split("test").points])
    np.testing.assert_array_equal(batch["points"].numpy(), expected)
    assert torch.equal(clouds_of(data.predict_dataloader()), clouds_of(data.test_dataloader()))


def test_heights_are_taken_from_the_domain_s_floor(data_dir):
    domain = compose_domain("kinectsim10", {"paths.data_dir": str(data_dir), "floor_m": "-0.5"})
    data = DomainData(domain, points=64, fps_starts=1, scale="above_floor")
    data.setup()
    (batch,) = data.test_dataloader()
    stored = open_pointset(data_dir / "kinectsim10").split("test").points.astype(np.float64)
    found = batch["points"].double().numpy()
    np.testing.assert_allclose(found[..., 2], stored[..., 2] + 0.5, atol=1e-5)
    np.testing.assert_allclose(found[..., :2].mean(axis=1), 0, atol=1e-5)
    with pytest.raises(ConfigError, match="floor_m"):
        DomainData("kinectsim10", scale="above_floor", data_dir=data_dir)


def test_without_labels_there_are_none_anywhere(tmp_path):
    """Classes in a random order, so that a search can tell; it finds them where they are asked."""
    write_shuffled_target(tmp_path, class_in_id=False)
    truth = truth_of(tmp_path)
    hidden = made(tmp_path, domain="kinectsim10", labels=False)
    assert isinstance(hidden.train, Clouds)
    assert hidden.train is hidden.whole
    assert isinstance(hidden.test, Clouds)
    assert hidden.validation is None
    assert hidden.val_dataloader() == []
    batches = [*hidden.train_dataloader(), *hidden.test_dataloader()]
    assert sum(len(batch["points"]) for batch in batches) == TRAIN + TEST
    assert not any("labels" in batch for batch in batches)
    assert search({"data": hidden, "batches": batches}, truth) == []
    shown = made(tmp_path, domain="kinectsim10")
    assert isinstance(shown.train, Labelled)
    found = {path.rpartition(": ")[2] for path in search({"data": shown}, truth)}
    assert {"train labels, lineage t", "train labels, lineage v", "test labels"} <= found
    assert "train labels" not in found  # they are divided
    dataset = open_pointset(tmp_path / "kinectsim10")
    assert isinstance(dataset, PointSet)
    assert search({"dataset": dataset}, Truth({}, kinds=(PointSet,))) == ["dataset: PointSet"]


def test_balanced_draws_each_class_alike(tmp_path):
    write_domain(tmp_path, "specklenet10", noise=0.05, train=40)
    data = made(tmp_path, sampler="balanced", clouds_a_split=None)
    few = data.train.at(np.flatnonzero((data.train.labels.numpy() > 0) | (np.arange(96) < 4)))
    data.train = few  # four clouds of the first class, all of the others
    counts = np.bincount(few.labels)
    assert counts[0] == 4
    drawn = [labels_of(data.train_dataloader()) for _ in range(20)]
    assert {len(epoch) for epoch in drawn} == {len(few.ids)}
    shares = np.bincount(np.concatenate(drawn)) / (20 * len(few.ids))
    np.testing.assert_allclose(shares, 1 / 3, atol=0.05)
    assert labels_of(data.val_dataloader()) == data.validation.labels.tolist()  # these are not
    plain = made(tmp_path)
    assert np.bincount(labels_of(plain.train_dataloader())).tolist() == [32, 32, 32]


def test_a_few_clouds_of_each_split_or_class(data_dir, tmp_path):
    few = made(data_dir, clouds_a_split=9, cache_dir=tmp_path)
    assert (len(few.whole.ids), len(few.test.ids)) == (9, 9)
    assert [sum(id_.startswith(cls) for id_ in few.whole.ids) for cls in CLASSES] == [3, 3, 3]
    cached, again = (made(data_dir, cache_dir=tmp_path / "c") for _ in range(2))
    plain = clouds_of(made(data_dir).train_dataloader())
    assert torch.equal(clouds_of(cached.train_dataloader()), plain)
    assert torch.equal(clouds_of(again.train_dataloader()), plain)
    assert not list(tmp_path.glob("*.npy"))  # what is cached are whole splits
    assert list((tmp_path / "c").glob("*.npy"))
    whole, first = made(data_dir), made(data_dir, clouds_a_class=5)
    for all_, some in ((whole.train, first.train), (whole.validation, first.validation)):
        of_class = [[i for i in all_.ids if i.startswith(cls)] for cls in CLASSES]
        assert some.ids == tuple(i for ids in of_class for i in ids[:5])
    assert set(first.whole.ids) == {*first.train.ids, *first.validation.ids}
    assert len(first.train.ids) == 15
    fewest = made(data_dir, clouds_a_class=1)  # of too few no rule could hold any out
    assert (len(fewest.train.ids), len(fewest.validation.ids)) == (3, 3)
    assert len(first.test.ids) == 24
