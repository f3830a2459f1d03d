"""Train a classifier: `qs3-train experiment=qs3_s2d seed=0,1,2 -m`; see conf/experiment."""

from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from qs3.config.hydra import cli_errors, in_multirun
from qs3.config.location import CONF
from qs3.runs.folder import removed_if_unbegun
from qs3.utils.commands import hydra_command


@hydra_command
@hydra.main(version_base="1.3", config_path=str(CONF), config_name="train")
def main(cfg: DictConfig) -> float | None:
    """Run, continue or skip the run that the config describes; returns what a search asks for."""
    from qs3.training.command import objective_of, train

    def run(cfg: DictConfig) -> float | None:
        if in_multirun():  # the summary of a sweep names the folders of what failed
            return objective_of(cfg, train(cfg))
        with removed_if_unbegun(Path(HydraConfig.get().runtime.output_dir)):
            return objective_of(cfg, train(cfg))

    return cli_errors(run, cfg)


if __name__ == "__main__":
    main()
