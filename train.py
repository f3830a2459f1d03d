"""Train a classifier: `python train.py experiment=qs3_s2d seed=0,1,2 -m`; see conf/experiment."""

import hydra
from omegaconf import DictConfig

from qs3.hydra_glue import speak_plainly


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
def main(cfg: DictConfig) -> None:
    """Run, continue or skip the run that the config describes."""
    from qs3.run import train

    speak_plainly(train, cfg)


if __name__ == "__main__":
    main()
