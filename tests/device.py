"""What a step would ask of an accelerator, counted where there is none.

Tensors of torch's `meta` device have shapes but no values, so whatever asks for a value fails:
`.item()`, `.cpu()`, `if tensor:`, indexing by a mask, `nonzero`. On a GPU all of these wait for it.
And everything takes the paths that a GPU takes. Operations are those that reach a device's
dispatcher: a call is a kernel or a few.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from qs3 import kernels as fast
from qs3.geometry import ball_query, neighbours
from qs3.kernels import edgeconv
from qs3.models import dgcnn


class Autocast(torch.autocast):
    """`meta` has none: the CPU's stands in."""

    def __init__(self, device_type: str, **settings: Any) -> None:
        super().__init__("cpu" if device_type == "meta" else device_type, **settings)


class Constants(TorchFunctionMode):
    """Notes tensors made of Python numbers: on a GPU they come from the CPU's memory."""

    def __init__(self, carried: list[str]) -> None:
        super().__init__()
        self.carried = carried

    def __torch_function__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if func in (torch.tensor, torch.as_tensor) and not isinstance(args[0], Tensor):
            self.carried.append(func.__name__)
        return func(*args, **(kwargs or {}))


class Watch(TorchDispatchMode):
    """Counts operations, and notes those that carry values from one device to another.

    What was drawn from a generator may be carried: a generator is on the device of the batch, so
    only here, where `meta` has none, do its numbers have to travel.

    Attributes:
        counts: how often each operation was called, on whatever device.
        kernels: calls on `meta` that would start a kernel.
        carried: operations that have tensors of two devices, and tensors made of numbers.
    """

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()
        self.kernels: Counter[str] = Counter()
        self.carried: list[str] = []
        self._drawn: list[Tensor] = []  # kept, so that no other tensor gets their place
        self._constants = Constants(self.carried)
        self._autocast = patch.object(torch, "autocast", Autocast)

    def __enter__(self) -> Watch:
        self._autocast.start()
        self._constants.__enter__()
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._constants.__exit__(*error)
        self._autocast.stop()

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        given = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
        made = [x for x in tree_leaves(result) if isinstance(x, Tensor)]
        self.counts[str(func)] += 1
        if not _starts_nothing(func) and any(x.is_meta for x in (*given, *made)):
            self.kernels[str(func)] += 1
        drawn = all(any(x is d for d in self._drawn) for x in given)
        if drawn and (given or "generator" in (kwargs or {})):
            self._drawn += [x for x in made if x.device.type == "cpu"]
        elif len({x.device for x in (*given, *made)}) > 1:
            self.carried.append(str(func))
        return result


def _name(func: Any) -> str:
    return str(func._schema.name.split("::")[1])


def _starts_nothing(func: Any) -> bool:
    """Views of what is given, and memory whose values are not set."""
    name = _name(func)
    if "empty" in name or name in ("detach", "_unsafe_view", "lift_fresh", "is_same_size"):
        return True
    returned = [r.alias_info for r in func._schema.returns]
    return bool(returned) and all(a is not None and not a.is_write for a in returned)


@contextmanager
def as_on_gpu() -> Iterator[None]:
    """As `as_on_device`, by the operations that Triton's kernels stand for."""
    with (
        as_on_device(),
        patch.object(edgeconv, "takes_triton", lambda x: True),
        patch.object(neighbours, "takes_triton", lambda x: True),
        patch.object(dgcnn, "takes_triton", lambda x: True),
    ):
        yield


@contextmanager
def as_on_device() -> Iterator[None]:
    """Inside, nets and neighbours go an accelerator's way on the CPU, with values to look at."""
    with (
        patch.object(fast, "on_cpu", lambda x: False),
        patch.object(neighbours, "takes_numpy", lambda x: False),
        patch.object(ball_query, "takes_numpy", lambda x: False),
    ):
        yield
