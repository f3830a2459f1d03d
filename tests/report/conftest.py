"""What several tests of the report share."""

import shutil

import pytest
from omegaconf import OmegaConf

from tests.training.toy import toy_config


@pytest.fixture
def run(finished, toy_data, tmp_path):
    """A copy of the finished toy run (two rounds) with the files that the command line adds."""
    folder = tmp_path / "exp" / "seed0-0123abcd"
    shutil.copytree(finished, folder)
    (folder / ".hydra").mkdir(exist_ok=True)
    cfg = toy_config(tmp_path, f"paths.data_dir={toy_data}")
    OmegaConf.save(cfg, folder / ".hydra" / "config.yaml")
    words = ["experiment=quickstart", "hydra.job.name='a b'"]
    OmegaConf.save(OmegaConf.create(words), folder / ".hydra" / "overrides.yaml")
    return folder
