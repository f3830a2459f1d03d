"""CAD meshes to point clouds: `qs3-generate domain=specklenet10 meshes=PATH`."""

import hydra
from omegaconf import DictConfig

from qs3.config.hydra import cli_errors
from qs3.config.location import CONF
from qs3.utils.cli import hydra_command


@hydra_command
@hydra.main(version_base="1.3", config_path=str(CONF), config_name="generate")
def main(cfg: DictConfig) -> None:
    """Make the dataset that the config describes, or continue it."""
    from qs3.generation.command import generate

    cli_errors(generate, cfg)


if __name__ == "__main__":
    main()
