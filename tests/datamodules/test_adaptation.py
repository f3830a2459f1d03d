"""Source and target together: what the data module of a run gives, and where its batches lie."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Trainer

from qs3.datamodules.adaptation import AdaptationData
from qs3.datamodules.augment import Augment
from qs3.datamodules.clouds import Clouds
from qs3.datamodules.phases import Phases, SelfTrainingConfig
from qs3.datasets.domain import Domain
from qs3.errors import ConfigError
from tests.datamodules.test_domain import made

# Lightning 2.6.6 asks torch 2.13 in an old way; not ours to fix.
pytestmark = pytest.mark.filterwarnings("ignore:.*LeafSpec.* is deprecated:FutureWarning")


def adaptation(data_dir: Path, **settings: Any) -> AdaptationData:
    domains = (Domain(name, "X", name, data_dir / name) for name in ("specklenet10", "kinectsim10"))
    data = AdaptationData(
        *domains, phases=Phases(2), scheme=SelfTrainingConfig(), augment=Augment(), batch_size=8,
        seed=0, points=32, **settings,
    )  # fmt: skip
    data.prepare_data()
    data.setup("fit")
    return data


def test_metres_are_asked_for_of_domains_that_have_them(data_dir):
    with pytest.raises(ConfigError, match="unit"):
        adaptation(data_dir, scale="metres")


def test_the_targets_training_clouds_are_what_the_adaptation_predicts(data_dir):
    data = adaptation(data_dir)
    target = made(data_dir, domain="kinectsim10", labels=False)
    assert data.target.ids == target.train.ids
    batches = list(data.predict_dataloader())
    assert {tuple(batch["target"]) for batch in batches} == {("points",)}
    found = torch.cat([batch["target"]["points"] for batch in batches])
    assert torch.equal(found, data.target.points)
    assert torch.equal(found, target.train.points)


def test_the_adaptation_has_the_source_s_labels_and_no_test_clouds(data_dir):
    data = adaptation(data_dir)
    source = made(data_dir)
    for ours, theirs in ((data.labelled, source.train), (data.validation, source.validation)):
        assert ours.ids == theirs.ids
        assert torch.equal(ours.labels, theirs.labels)
    assert torch.equal(data.all_labelled.points, source.whole.points)
    assert data.labelled_domain.test is data.target_domain.test is None
    assert isinstance(data.target_domain.whole, Clouds)
    bound = adaptation(data_dir, owner="target_train")
    assert bound.labelled_domain.domain.name == "kinectsim10"
    assert isinstance(bound.target_domain.train, Clouds)


def test_few_labelled_target_clouds_and_the_source_beside_them(data_dir):
    data = adaptation(data_dir, owner="target_train", beside_source=True, clouds_a_class=2)
    source = made(data_dir)
    assert len(data.labelled) == 2 * len(data.target_domain.classes)
    assert set(data.labelled.ids) <= set(data.target.ids)
    batches = list(data.train_dataloader())
    assert sum(len(batch["source"]["y_target_train"]) for batch in batches) == len(data.labelled)
    assert data.beside_domain.train.ids == source.train.ids
    for batch in batches:
        assert set(batch["beside"]) == {"points", "y_source"}
        assert len(batch["beside"]["points"]) == len(batch["source"]["points"])


@pytest.mark.filterwarnings("ignore:.*:UserWarning")  # Lightning's on trainers without a loader
@pytest.mark.parametrize("limit", [1, 0.5])
def test_a_part_of_the_validation_clouds_is_of_all_classes(data_dir, limit):
    """They are sorted by class: a teacher was chosen by its accuracy on the first ones alone."""
    data = adaptation(data_dir, eval_batch_size=4)
    given: list[torch.Tensor] = []
    for settings in ({}, {"limit_val_batches": limit}):
        data.trainer = Trainer(accelerator="cpu", devices=1, logger=False, **settings)
        batches = [batch["source"] for batch in data.val_dataloader()]
        given.append(torch.cat([batch["y_source"] for batch in batches]))
        points = torch.cat([batch["points"] for batch in batches])
        order = [data.validation.clouds.points.tolist().index(cloud) for cloud in points.tolist()]
        assert data.validation.labels[order].tolist() == given[-1].tolist()
        assert sorted(order) == list(range(len(data.validation.ids)))
    assert given[0].equal(data.validation.labels)
    assert set(given[0][:4].tolist()) == {0}
    assert len(set(given[1][:4].tolist())) > 1
