"""One row an epoch, for every logger; and the logger that is always there, `history.csv`.

Rows are sent before the epoch's checkpoint is written. If a kill comes in between, the epoch is
repeated and its row replaced, so the history of an interrupted run equals that of an
uninterrupted one. Each start of a run writes an offline log of wandb of its own, and a kill may
leave nothing in it, so each log begins with the rows of earlier starts, or of a shared warm-up.
"""

from __future__ import annotations

import csv
import io
import logging
import sys
import time
from argparse import Namespace
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only
from rich.progress import Progress

from qs3.datamodules.phases import Phases
from qs3.engine.classifier import Classifier
from qs3.errors import DataError
from qs3.utils.files import write_text
from qs3.utils.progress import terminal_bar

log = logging.getLogger(__name__)


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


class EpochBar(Callback):
    """Shows phase, epoch and validation accuracy.

    Args:
        enabled: None shows the bar on a terminal only.
        seconds: without a terminal, log a line at least this often.
    """

    def __init__(self, enabled: bool | None = None, seconds: float = 60.0) -> None:
        self.enabled = sys.stderr.isatty() if enabled is None else enabled
        self.seconds = seconds
        self._progress: Progress | None = None
        self._handlers: list[tuple[logging.StreamHandler, Any]] = []
        self._said = time.monotonic()

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Show the bar, at the epoch where a resumed run goes on."""
        if not self.enabled or not trainer.is_global_zero:
            return
        self._progress = terminal_bar("epochs,", transient=True)
        self._progress.add_task("training", total=trainer.max_epochs)
        self._progress.start()
        # Log handlers kept the real stdout; through rich's, their lines appear above the bar.
        for handler in logging.getLogger().handlers:
            if type(handler) is logging.StreamHandler and handler.stream.isatty():
                self._handlers.append((handler, handler.setStream(sys.stdout)))

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Advance."""
        assert isinstance(pl_module, Classifier)
        epoch, phases = trainer.current_epoch, pl_module.phases
        # In every process: under DDP, reading the figures sums them over the processes.
        text = f"{_name(phases, epoch)}, {_figures(trainer)}"
        if not trainer.is_global_zero:
            return
        if self._progress is not None:
            self._progress.update(self._progress.task_ids[0], completed=epoch + 1, description=text)
        if phases.ends(epoch) or (
            self._progress is None and time.monotonic() - self._said > self.seconds
        ):
            self._said = time.monotonic()
            log.info("epoch %d of %d: %s", epoch + 1, trainer.max_epochs, text)

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Remove the bar, also after an error."""
        for handler, stream in self._handlers:
            handler.setStream(stream)
        self._handlers.clear()
        if self._progress is not None:
            self._progress.stop()
            self._progress = None

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        """Remove the bar."""
        self.teardown(trainer, pl_module, "fit")


def _name(phases: Phases, epoch: int) -> str:
    phase = phases.phase(epoch)
    return "warm-up" if phase == 0 else f"round {phase - 1} of {phases.rounds}"


def _figures(trainer: Trainer) -> str:
    metrics = {key: float(value) for key, value in trainer.callback_metrics.items()}
    parts = [f"loss {metrics['train/loss']:.3f}"] if "train/loss" in metrics else []
    parts += [f"{key} {value:.1%}" for key, value in metrics.items() if key.endswith("_val/acc")]
    return ", ".join(parts)
