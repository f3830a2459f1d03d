"""Train a classifier: `qs3-train experiment=qs3_s2d seed=0,1,2 -m`; see conf/experiment."""

import hydra
from omegaconf import DictConfig

from qs3.config.hydra import cli_errors
from qs3.config.location import CONF
from qs3.utils.commands import hydra_command


@hydra_command
@hydra.main(version_base="1.3", config_path=str(CONF), config_name="train")
def main(cfg: DictConfig) -> float | None:
    """Run, continue or skip the run that the config describes; returns what a search asks for."""
    from qs3.training.command import objective_of, train

    return cli_errors(lambda cfg: objective_of(cfg, train(cfg)), cfg)


if __name__ == "__main__":
    main()
