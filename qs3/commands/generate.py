"""CAD meshes to point clouds: `qs3-generate domain=specklenet10 meshes=PATH`."""

import hydra
from omegaconf import DictConfig

from qs3.config.hydra import cli_errors
from qs3.config.location import CONF
from qs3.utils.commands import hydra_command


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="generate")
def _composed(cfg: DictConfig) -> None:
    from qs3.generation.command import generate

    cli_errors(generate, cfg)


@hydra_command
def main() -> None:
    """Make the dataset that the command line describes, or continue it."""
    _composed()


if __name__ == "__main__":
    main()
