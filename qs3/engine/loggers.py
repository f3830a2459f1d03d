"""One row an epoch: in `history.csv`, for every logger, and now and then as a line of the log.

Rows are written before the epoch's checkpoint. If a kill comes in between, the epoch is repeated
and its row replaced, so the history of an interrupted run equals that of an uninterrupted one. Each
start of a run writes an offline log of wandb of its own, and a kill may leave nothing in it, so
each log begins with the rows of earlier starts, or of a shared warm-up.
"""

import csv
import io
import logging
import time
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer

from qs3.datamodules.phases import Phases
from qs3.engine.classifier import Classifier
from qs3.utils.files import reading, write_text

log = logging.getLogger(__name__)

HISTORY = "history.csv"
_SECONDS = 60.0  # without a phase's end, a line in the log at least this often


class EpochRows(Callback):
    """Writes epoch, phase, learning rate, loss and validation accuracy.

    Lightning's own calls would come partly after the checkpoint and be lost by a kill, so
    `Classifier` logs to no logger itself.
    """

    def __init__(self, folder: Path, phases: Phases) -> None:
        self.file, self.phases = folder / HISTORY, phases
        self._logged = time.monotonic()

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Send the rows of the epochs before this start to the offline logs, which lack them."""
        for logger in trainer.loggers:
            if getattr(logger, "_offline", False):
                for row in self._rows(before=trainer.current_epoch):
                    found = {key: float(value) for key, value in row.items() if value}
                    epoch, phase = int(found.pop("epoch")), int(found["phase"])
                    logger.log_metrics(found | {"phase": phase}, step=epoch)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the row of this epoch; rows from it on, of a killed run, go."""
        assert isinstance(pl_module, Classifier)
        epoch, phase = trainer.current_epoch, self.phases.phase(trainer.current_epoch)
        # In every process: under DDP, reading the figures sums them over the processes.
        figures = {key: float(value) for key, value in sorted(trainer.callback_metrics.items())}
        row = {"phase": phase, "lr": pl_module.learning_rate()} | figures
        if not trainer.is_global_zero:
            return
        rows: list[dict[str, Any]] = [*self._rows(before=epoch), {"epoch": epoch} | row]
        columns = list(dict.fromkeys(key for row in rows for key in row))
        text = io.StringIO()
        writer = csv.DictWriter(text, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        write_text(self.file, text.getvalue())
        for logger in trainer.loggers:
            logger.log_metrics(row, step=epoch)
        if self.phases.ends(epoch) or time.monotonic() - self._logged > _SECONDS:
            self._logged = time.monotonic()
            rounds = self.phases.rounds
            where = f"seed {pl_module.seed}, epoch {epoch + 1} of {self.phases.total}"
            if rounds:
                where += f", round {phase - 1} of {rounds}" if phase else ", warm-up"
            shown = ", ".join(f"{key} {value:.3f}" for key, value in figures.items())
            log.info("%s: %s", where, shown)

    def _rows(self, before: int) -> list[dict[str, str]]:
        """Those of earlier epochs, as written."""
        if not self.file.is_file():
            return []
        with reading(self.file):
            rows = csv.DictReader(io.StringIO(self.file.read_text("utf-8")), strict=True)
            return [row for row in rows if int(row["epoch"]) < before]
