"""Search all objects within reach of some roots for labels, in whatever form they are kept."""

from __future__ import annotations

import gc
import logging
import types
import weakref
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch

_WINDOW_FROM = 40  # labels; shorter runs of them turn up in other numbers by chance
_STRANGERS = ("_pytest", "pytest", "pluggy", "numba")  # a kernel holds types, and no arrays
_NOT_ENTERED = (types.ModuleType, type, logging.Logger, logging.Handler, types.BuiltinMethodType)


class Truth:
    """Labels that must not be found.

    Args:
        wanted: by name, [n] int64 each; not sorted, so that nothing equals them by chance.
        kinds: types that hold labels: an instance within reach counts as found.
    """

    def __init__(self, wanted: Mapping[str, np.ndarray], kinds: tuple[type, ...] = ()) -> None:
        self.wanted = {name: np.asarray(y) for name, y in wanted.items()}
        self.groups = {name: _groups(y) for name, y in self.wanted.items()}
        self.kinds = kinds

    def within(self, thing: Any) -> str | None:
        """Which labels `thing` is, or holds directly, if any."""
        if isinstance(thing, self.kinds):
            return type(thing).__name__
        if isinstance(thing, torch.Tensor):
            return self._in_array(_whole(thing)) or self._in_array(thing.detach().cpu().numpy())
        if isinstance(thing, np.ndarray):
            return self._in_array(thing)
        if isinstance(thing, dict):
            return self._in_list(list(thing.values()))
        if isinstance(thing, list | tuple):
            return self._in_list(thing)
        return None

    def _in_list(self, values: Sequence[Any]) -> str | None:
        if any(len(values) == len(y) for y in self.wanted.values()):
            if all(isinstance(v, str) for v in values):  # names, or paths that begin with one
                return self._same_groups(
                    np.unique([v.split("/")[0] for v in values], return_inverse=True)[1]
                )
            if all(isinstance(v, int | float | np.number) for v in values):
                return self._same_groups(np.array(values))
            if all(isinstance(v, torch.Tensor) and v.numel() == 1 for v in values):
                return self._same_groups(np.array([v.item() for v in values]))
        return None

    def _in_array(self, array: np.ndarray) -> str | None:
        if array.dtype == object or array.ndim == 0:
            return None
        if array.ndim > 1 and len(array) < 10_000 and array[0].size <= 100:  # e.g. one-hot
            rows = np.unique(array.reshape(len(array), -1), axis=0, return_inverse=True)[1]
            if name := self._same_groups(rows.reshape(-1)):
                return name
        flat = array.reshape(-1)
        if name := self._same_groups(flat):
            return name
        if not np.issubdtype(flat.dtype, np.integer):
            return None
        for name, y in self.wanted.items():  # as part of something longer
            if len(y) >= _WINDOW_FROM and len(flat) > len(y):
                windows = np.lib.stride_tricks.sliding_window_view(flat, len(y))
                starts = np.flatnonzero((windows[:, :8] == y[:8]).all(axis=1))
                if any((windows[i] == y).all() for i in starts):
                    return name
        return None

    def _same_groups(self, values: np.ndarray) -> str | None:
        """The same clouds have the same value: the labels, whatever the classes are called."""
        for name, groups in self.groups.items():
            if len(values) == len(groups) and np.array_equal(_groups(values), groups):
                return name
        return None


def search(roots: Mapping[str, Any], truth: Truth) -> list[str]:
    """Where labels lie within reach of `roots`, as "path: which labels"."""
    found: list[str] = []
    seen: set[int] = set()
    kept: list[Any] = []  # so that no id is used twice while searching
    queue = deque(roots.items())
    while queue:
        path, thing = queue.popleft()
        if id(thing) in seen or _outside(thing):
            continue
        seen.add(id(thing))
        kept.append(thing)
        if name := truth.within(thing):
            found.append(f"{path}: {name}")
        queue.extend((f"{path}{step}", part) for step, part in _parts(thing))
    return found


def _parts(thing: Any) -> Iterator[tuple[str, Any]]:
    """What an object holds: attributes, items, closures, locals of generators, arrays' bases."""
    if isinstance(thing, dict):
        for key, value in list(thing.items()):
            yield f"[{key!r}]", value
            yield f".key({key!r})", key
        return
    if isinstance(thing, list | tuple | set | frozenset | deque):
        for i, value in enumerate(list(thing)):
            yield f"[{i}]", value
        return
    if isinstance(thing, types.FunctionType):  # not their module's globals
        yield ".closure", [cell.cell_contents for cell in thing.__closure__ or () if _full(cell)]
        yield ".defaults", [thing.__defaults__, thing.__kwdefaults__, thing.__dict__]
        return
    if isinstance(thing, weakref.ReferenceType):
        yield ".ref", thing()
        return
    if isinstance(thing, types.GeneratorType):
        yield ".frame", thing.gi_frame
        return
    if isinstance(thing, types.FrameType):  # not the frames that called it
        yield ".locals", dict(thing.f_locals)
        return
    if isinstance(thing, np.ndarray):
        yield ".base", thing.base
        if thing.dtype == object:
            yield ".items", thing.tolist()
    if isinstance(thing, torch.Tensor):
        yield ".base", thing._base
        yield ".grad", thing.grad
    attributes = getattr(thing, "__dict__", {})
    if isinstance(attributes, dict):
        for key, value in list(attributes.items()):
            yield f".{key}", value
    for slot in (s for c in type(thing).__mro__ for s in c.__dict__.get("__slots__", ())):
        if isinstance(slot, str) and hasattr(thing, slot):
            yield f".{slot}", getattr(thing, slot)
    if isinstance(thing, torch.Tensor | np.ndarray):
        return
    for i, part in enumerate(gc.get_referents(thing)):  # what is written in C, iterators, ...
        if part is not attributes:
            yield f".<{type(thing).__name__} {i}>", part


def _outside(thing: Any) -> bool:
    return (
        thing is None
        or isinstance(thing, (*_NOT_ENTERED, str, bytes, int, float))
        or type(thing).__module__.partition(".")[0] in _STRANGERS
    )


def _full(cell: types.CellType) -> bool:
    try:
        cell.cell_contents  # noqa: B018
    except ValueError:
        return False
    return True


def _whole(tensor: torch.Tensor) -> np.ndarray:
    """All of the memory that a tensor is a view of."""
    if tensor.layout != torch.strided or tensor.device.type != "cpu":
        return np.empty(0)
    whole = torch.empty(0, dtype=tensor.dtype).set_(tensor.untyped_storage())
    return whole.numpy()


def _groups(values: np.ndarray) -> np.ndarray:
    """Each value as the position at which it first occurs."""
    _, first, inverse = np.unique(values, return_index=True, return_inverse=True)
    return first[inverse.reshape(-1)]
