"""What a method may want of a training batch beside its clouds: twins, and second draws.

A batch's part of a domain then holds further clouds [B, N, 3], row by row those of "points":

    "twin"   of the source: its twin, never cut; of the target: the cloud itself, not cut
    "again"  of the source: another draw of the same cloud

Scan, twin and second draw of a source cloud are turned, scaled, shifted and lifted alike: they show
one object in one place. Cuts, holes and jitter are each one's own. A target's twin is augmented on
its own, as nothing is known of it but that it is the same object.

Each twin is normalised by itself, not by its scan's centre and size. At test time a net sees parts
that fill the unit ball; a whole that stuck out of it would be of a kind of its own, and a teacher
of such clouds would know how much is missing and not what the object is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from qs3.datamodules.augment import Augment


@dataclass(frozen=True)
class Wants:
    """What a method wants beside clouds and labels; nothing by default, which costs nothing.

    Attributes:
        twin: of source clouds, one of `qs3.datamodules.beside.SOURCE_TWINS`.
        again: a second draw of source clouds.
        target_twin: target clouds that are not cut.
    """

    twin: str | None = None
    again: bool = False
    target_twin: bool = False


def augmented(
    augment: Augment,
    part: Mapping[str, Tensor],
    generator: Callable[[str], torch.Generator],
    scale: str,
    together: bool,
) -> dict[str, Tensor]:
    """A domain's part of a batch with its clouds augmented.

    Args:
        augment: of all clouds; a twin is neither cut nor emptied by it.
        part: "points", perhaps "twin" and "again", and labels.
        generator: of a use, on the clouds' device: "" for the clouds themselves.
        scale: see `qs3.datamodules.clouds`.
        together: whether all are moved alike; else each on its own.
    """
    result = dict(part)
    whole = dataclasses.replace(augment, crop=1.0, drop_regions=0)
    result["points"], moves = augment.with_moves(part["points"], generator(""), scale)
    for key, by in (("twin", whole), ("again", augment)):
        if key in part:
            shared = moves if together else None
            result[key], _ = by.with_moves(part[key], generator(key), scale, shared)
    return result
