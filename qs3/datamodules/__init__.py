"""LightningDataModules: clouds of one or two domains, sampled, batched and augmented."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from qs3.datamodules.adaptation import AdaptationData
    from qs3.datamodules.domain import DomainData

__all__ = ["AdaptationData", "DomainData"]


def __getattr__(name: str) -> Any:
    """The data modules: they import torch, which the phases do without."""
    if name in __all__:
        place = "adaptation" if name == "AdaptationData" else "domain"
        return getattr(import_module(f"qs3.datamodules.{place}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
