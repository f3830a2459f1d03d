"""Train a classifier: `python train.py experiment=qs3_s2d seed=0,1,2 -m`; see conf/experiment."""

import hydra
from omegaconf import DictConfig

from qs3.config.hydra import speak_plainly


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
def main(cfg: DictConfig) -> float | None:
    """Run, continue or skip the run that the config describes; returns what a search asks for."""
    from qs3.training.command import objective_of, train

    return speak_plainly(lambda cfg: objective_of(cfg, train(cfg)), cfg)


if __name__ == "__main__":
    main()
