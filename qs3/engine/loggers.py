"""One row an epoch, for every logger; and the logger that is always there, `history.csv`.

Rows are sent before the epoch's checkpoint is written. If a kill comes in between, the epoch is
repeated and its row replaced, so the history of an interrupted run equals that of an
uninterrupted one. Each start of a run writes an offline log of wandb of its own, and a kill may
leave nothing in it, so each log begins with the rows of earlier starts, or of a shared warm-up.
"""

from __future__ import annotations

import csv
import io
from argparse import Namespace
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only

from qs3.datamodules.phases import Phases
from qs3.engine.classifier import Classifier
from qs3.errors import DataError
from qs3.utils.files import write_text


class EpochRows(Callback):
    """Sends epoch, phase, learning rate, loss and validation accuracy to the loggers.

    Lightning's own calls would come partly after the checkpoint and be lost by a kill, so
    `Classifier` logs to no logger itself.
    """

    def __init__(self, phases: Phases) -> None:
        self.phases = phases

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Send the rows of the epochs before this start to the offline logs, which lack them."""
        earlier = [
            (int(row.pop("epoch")), {key: float(value) for key, value in row.items() if value})
            for logger in trainer.loggers
            if isinstance(logger, CsvHistory)
            for row in logger.rows()
        ]
        for logger in trainer.loggers:
            if not getattr(logger, "_offline", False):
                continue
            for epoch, row in earlier:
                if epoch < trainer.current_epoch:
                    logger.log_metrics(row | {"phase": int(row["phase"])}, step=epoch)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Send the row of this epoch."""
        assert isinstance(pl_module, Classifier)
        epoch = trainer.current_epoch
        row = {"phase": self.phases.phase(epoch), "lr": pl_module.learning_rate()}
        row |= {key: float(value) for key, value in sorted(trainer.callback_metrics.items())}
        for logger in trainer.loggers:
            logger.log_metrics(row, step=epoch)


def wandb(**settings: Any) -> Logger:
    """Lightning's logger for Weights & Biases; see conf/logger/wandb.yaml."""
    from lightning.pytorch.loggers import WandbLogger

    logger = WandbLogger(**settings)
    # Lightning always passes it, and wandb 0.31 warns about it.
    logger._wandb_init.pop("anonymous", None)
    return logger


class CsvHistory(Logger):
    """`history.csv` in the run's folder: one row an epoch, rewritten atomically each time."""

    def __init__(self, folder: str | Path) -> None:
        super().__init__()
        self.path = Path(folder) / "history.csv"

    @property
    def name(self) -> str:
        """The logger's name."""
        return "csv"

    @property
    def version(self) -> str:
        """There is one file a run."""
        return ""

    @rank_zero_only
    def log_hyperparams(self, params: dict[str, Any] | Namespace, *args: Any, **kw: Any) -> None:
        """Hydra saves the config."""

    @rank_zero_only
    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        """Add the row of epoch `step`; rows from that epoch on, of a killed run, go."""
        assert step is not None
        rows: list[dict[str, Any]] = [row for row in self.rows() if int(row["epoch"]) < step]
        rows.append({"epoch": step, **metrics})
        columns = list(dict.fromkeys(key for row in rows for key in row))
        text = io.StringIO()
        writer = csv.DictWriter(text, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        write_text(self.path, text.getvalue())

    def rows(self) -> list[dict[str, str]]:
        """Those there are, as written.

        Raises:
            DataError: the file is damaged.
        """
        if not self.path.is_file():
            return []
        try:
            rows = list(csv.DictReader(io.StringIO(self.path.read_text("utf-8")), strict=True))
            for row in rows:
                int(row["epoch"])
        except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
            raise DataError(f"{self.path} is damaged ({error})") from error
        return rows
