"""One progress bar over all epochs of a run; without a terminal, one log line a phase."""

from __future__ import annotations

import logging
import sys
import time
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from rich.progress import Progress

from qs3.datamodules.phases import Phases
from qs3.engine.classifier import Classifier
from qs3.utils.progress import terminal_bar

log = logging.getLogger(__name__)


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
