"""conf/datamodule: the data modules as parts of anybody's Hydra application."""

from __future__ import annotations

import inspect

from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf

from qs3.config.compose import composed
from qs3.config.location import CONF
from qs3.datamodules.augment import Augment
from qs3.datamodules.domain import DomainData
from tests.training.toy import write_domain


def test_the_file_names_every_setting():
    takes = inspect.signature(DomainData).parameters
    left_out = {"clouds_a_split", "clouds_a_class"}  # of debugging
    plain = OmegaConf.to_container(composed(None, "+datamodule=domain").datamodule)
    assert set(plain) == {"_target_", *takes} - left_out
    ours = {key: takes[key].default for key in plain if key not in ("_target_", "domain")}
    assert {key: plain[key] for key in ours} == ours


def test_in_an_application_of_one_s_own(tmp_path):
    """Whose search path names conf/, and whose config holds one with an augmentation."""
    write_domain(tmp_path / "data", "specklenet10", noise=0.05)
    (tmp_path / "mine.yaml").write_text(
        f"""
defaults:
  - datamodule: domain
  - _self_
hydra: {{searchpath: ["file://{CONF}"]}}
datamodule:
  points: 32
  data_dir: {tmp_path / "data"}
  augment: {{_target_: qs3.datamodules.augment.Augment, rotate_z: false}}
"""
    )
    with initialize_config_dir(str(tmp_path), version_base="1.3"):
        data = instantiate(compose("mine").datamodule)
    assert data.augment == Augment(rotate_z=False)
    data.setup("fit")
    assert next(iter(data.train_dataloader()))["points"].shape == (16, 32, 3)
