"""One step of a user's own method on random clouds: what is wrong is said before any run begins."""

from __future__ import annotations

import sys
import traceback
from typing import Any

import torch
from torch import nn

from qs3.errors import ConfigError, Qs3Error
from qs3.methods.base import Method, total_loss

_CLOUDS = 4


def try_step(method: Method, net: nn.Module, file: str, classes: int, points: int) -> None:
    """Prepare a method of `file`, and take its loss and the gradient of four random clouds.

    A method that prepares each epoch is only prepared: its loss may need what that leaves. Nothing
    is drawn from torch's global generator.

    Args:
        method: of `qs3.methods.own`.
        net: [B, N, 3] to logits [B, C], new; it is changed.
        file: as the user named it.
        classes: C.
        points: N.

    Raises:
        ConfigError: it fails, or its loss is not scalars by name; says where in the file.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        batch = random_batch(method, classes, points)
        try:
            method.prepare(net)
            if type(method).start_epoch is Method.start_epoch:
                net.train()
                terms = method.loss(net, batch, torch.Generator().manual_seed(0))
                total_loss(method, terms).backward()
        except Exception as error:  # whatever the user's code does
            kind = "" if isinstance(error, Qs3Error) else f"{type(error).__name__}: "
            raise ConfigError(
                f"method.file={file}{_line_of(error, method)}: {kind}{error}"
                f"{_held(error, batch, method)}"
            ) from error


def random_batch(method: Method, classes: int, points: int) -> dict[str, Any]:
    """A batch of what the method asks for, of clouds in the unit ball; see `qs3.methods.base`."""

    def clouds() -> torch.Tensor:
        drawn = torch.randn(_CLOUDS, points, 3)
        return drawn / drawn.norm(dim=2).amax(dim=1)[:, None, None]

    labels = torch.arange(_CLOUDS) % classes
    source = {"points": clouds(), f"y_{method.labels}": labels}
    wants = method.wants
    source |= {
        key: clouds() for key, wanted in (("twin", wants.twin), ("again", wants.again)) if wanted
    }
    batch: dict[str, Any] = {"index": 0, "epoch": 0, "progress": 0.5, "source": source}
    if method.uses_target:
        target = {"points": clouds()}
        batch["target"] = target | ({"twin": clouds()} if wants.target_twin else {})
    return batch


def _line_of(error: Exception, method: Method) -> str:
    """The last line of the file that the error came through, if it did."""
    path = sys.modules[type(method).__module__].__file__
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == path]
    return f", line {lines[-1]}" if lines else ""


def _held(error: Exception, batch: dict[str, Any], method: Method) -> str:
    """What a batch has, of a key that it has not."""
    if not isinstance(error, KeyError):
        return ""
    parts = {key: part for key, part in batch.items() if isinstance(part, dict)}
    has = ", ".join(f'["{key}"] with {", ".join(part)}' for key, part in parts.items())
    more = "" if method.uses_target else '; ["target"] is there with `uses_target = True`'
    return f"; a batch has {has}{more}"
