"""What a watch says of assignments by a mask, which run on the device without values."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext

import pytest
import torch
from torch import Tensor

from tests.device import Watch

ROWS, COLUMNS = 4, 3
Assignment = Callable[[Tensor, Tensor, Tensor], None]  # x [4, 3]; of its rows: which, and a mask


def _filled_in_place(x: Tensor, rows: Tensor, mask: Tensor) -> None:
    x[mask] = 0.0


def _filled_in_a_column(x: Tensor, rows: Tensor, mask: Tensor) -> None:
    x[mask, 1] = 2


def _filled_columns(x: Tensor, rows: Tensor, mask: Tensor) -> None:
    x[:, mask[:COLUMNS]] = 1.0


def _masked_fill(x: Tensor, rows: Tensor, mask: Tensor) -> None:
    x.masked_fill_(mask[:, None], 0.0)


def _where(x: Tensor, rows: Tensor, mask: Tensor) -> None:
    x.copy_(torch.where(mask[:, None], x.flip(0), x))


def _by_numbers(x: Tensor, rows: Tensor, mask: Tensor) -> None:
    x[rows] = x.flip(0)


def _rows(x: Tensor, rows: Tensor, mask: Tensor) -> None:
    x[mask] = x.flip(0)[:1]


def _places(x: Tensor, rows: Tensor, mask: Tensor) -> None:
    x[mask[:, None].expand(-1, COLUMNS)] = x.flip(0)[0, 0]  # a value that is on the device


def _a_zero_of_the_device(x: Tensor, rows: Tensor, mask: Tensor) -> None:
    x[mask] = torch.zeros((), device=x.device)


def _bytes(x: Tensor, rows: Tensor, mask: Tensor) -> None:
    x.index_put_((mask.byte(),), x.flip(0)[:1])


def _added(x: Tensor, rows: Tensor, mask: Tensor) -> None:
    x.index_put_((mask,), torch.scalar_tensor(1.0, device=x.device), accumulate=True)


def _beside_an_index(x: Tensor, rows: Tensor, mask: Tensor) -> None:
    x[mask, rows[:1]] = 1.0


FILLS = (_filled_in_place, _filled_in_a_column, _filled_columns)
GOES_ON = (*FILLS, _masked_fill, _where, _by_numbers)
WAITS = (_rows, _places, _a_zero_of_the_device, _bytes, _added, _beside_an_index)


def _arguments(device: str) -> tuple[Tensor, Tensor, Tensor]:
    x = torch.arange(float(ROWS * COLUMNS), device=device).view(ROWS, COLUMNS)
    rows = torch.arange(ROWS, device=device) % COLUMNS
    return x, rows, rows < COLUMNS - 1


def _watched(assign: Assignment, grad: bool = False) -> Watch:
    x, rows, mask = _arguments("meta")
    x.requires_grad_(grad)
    with Watch() as watch:
        y = x.clone()
        assign(y, rows, mask)
        if grad:
            y.sum().backward()
    return watch


@pytest.mark.parametrize("assign", WAITS)
def test_an_assignment_that_counts_a_mask_is_seen(assign: Assignment) -> None:
    assert [word for word in _watched(assign).carried if word.endswith(" by a mask")]


@pytest.mark.parametrize("grad", [False, True])
@pytest.mark.parametrize("assign", GOES_ON)
def test_what_does_not_is_not(assign: Assignment, grad: bool) -> None:
    watch = _watched(assign, grad)
    assert watch.carried == []
    assert sum(watch.counts.values()) > 1


@pytest.mark.parametrize("assign", FILLS)
def test_a_number_is_filled_in_without_counting(assign: Assignment) -> None:
    """With values, by what torch's profiler sees inside, and where its numbers stay: the CPU."""
    with torch.profiler.profile() as inside:
        assign(*_arguments("cpu"))
    seen = {event.key for event in inside.key_averages()}
    assert "aten::masked_fill_" in seen
    assert "aten::nonzero" not in seen


@pytest.mark.parametrize("assign", [_rows, _bytes, _added, _beside_an_index])
@pytest.mark.filterwarnings("ignore:indexing with dtype torch.uint8")
def test_others_ask_where_the_mask_is_true(assign: Assignment) -> None:
    with torch.profiler.profile() as inside:
        assign(*_arguments("cpu"))
    assert "aten::nonzero" in {event.key for event in inside.key_averages()}


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.filterwarnings("ignore::UserWarning")  # torch says that the mode is new
@pytest.mark.parametrize("assign", [*GOES_ON, *WAITS])
def test_a_gpu_waits_for_those(assign: Assignment) -> None:
    assign(*_arguments("cuda"))  # loads libraries, which waits
    given = _arguments("cuda")
    torch.cuda.set_sync_debug_mode("error")
    try:
        with pytest.raises(RuntimeError, match="sync") if assign in WAITS else nullcontext():
            assign(*given)
    finally:
        torch.cuda.set_sync_debug_mode("default")
