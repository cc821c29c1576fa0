"""Operations on index tensors: select, look up, renumber, divide."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor


@lru_cache(maxsize=1024)
def constant(values: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """A small tensor from nested tuples of numbers. It is uploaded to the device once; never write to it."""
    return torch.tensor(values, dtype=dtype, device=device)


def index_dtype(size: int, device: torch.device) -> torch.dtype:
    """Return the dtype of indices below a size: int32 if they fit, but int64 on a GPU, where conversions cost more."""
    return torch.int32 if device.type == "cpu" and size <= torch.iinfo(torch.int32).max else torch.int64


def flat_nonzero(mask: Tensor) -> Tensor:
    """Flat indices of the True elements of (...) bools, (K,) int64, ascending: `mask.flatten().nonzero()[:, 0]`.

    Cost: one pass and, on a GPU, one synchronisation. On the CPU we call NumPy, which is about five times as fast as
    torch for a sparse mask of half a million pixels.
    """
    if mask.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.flatten().nonzero()[:, 0]


def nonzero_pairs(mask: Tensor) -> tuple[Tensor, Tensor]:
    """Row and column of each True element of an (R, C) mask, (K,) int64 each, row by row. Cost: as `flat_nonzero`."""
    if mask.device.type == "cpu":
        return split_index(flat_nonzero(mask), max(mask.shape[1], 1))
    row, col = mask.nonzero().unbind(1)
    return row, col


def gather(index: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
    """Select the same elements of several tensors: (K, ...) of (N, ...) each, by (K,) int64 indices."""
    return tuple(values.index_select(0, index) for values in tensors)


def renumber(index: Tensor, size: int) -> Tensor:
    """Invert a list of K distinct indices, (K,) int64, below the size S.

    Returns:
        (S + 1,) int64, position of each number in the list; K for numbers that are not in it, and for S ("none").
    """
    position = torch.full((size + 1,), index.numel(), dtype=torch.int64, device=index.device)
    return position.scatter_(0, index, torch.arange(index.numel(), device=index.device))


def unique_pairs(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the U distinct pairs of two (N,) int64 in lexicographic order; the numbers must be at least -1.

    Returns:
        The first and the second number of each pair, (U,) each; the pair of each input, (N,); the count of each pair.
    """
    width = 2 + int(second.amax()) if len(second) else 1
    key, index, count = torch.unique(first * width + second + 1, return_inverse=True, return_counts=True)
    own = floor_divide(key, width)
    return own, key - own * width - 1, index, count


def searchsorted(values: Tensor, wanted: Tensor) -> Tensor:
    """`torch.searchsorted`; on the CPU NumPy is twice as fast if most of the wanted values are in order."""
    if values.device.type == "cpu":
        return torch.from_numpy(np.searchsorted(values.numpy(), wanted.numpy()))
    return torch.searchsorted(values, wanted)


def argsort_small(values: Tensor) -> Tensor:
    """Stable `argsort` of (N,) int64 below 2^15. On the CPU, NumPy sorts such numbers by their bytes."""
    if values.device.type == "cpu":
        return torch.from_numpy(values.short().numpy().argsort(kind="stable"))
    return values.sort(stable=True).indices


def index_in_group(group: Tensor) -> Tensor:
    """(N,) int64, index of each element among the elements of its group, from groups (N,) in ascending order."""
    return torch.arange(group.numel(), device=group.device) - torch.searchsorted(group, group)


def concat_ranges(start: Tensor, count: Tensor) -> Tensor:
    """Concatenate R ranges: start[0], start[0] + 1, ... (count[0] of them), start[1], start[1] + 1, ...; all int64."""
    offset = torch.repeat_interleave(start + count - count.cumsum(0), count)
    return offset.add_(torch.arange(offset.numel(), device=offset.device))


def lazy_zeros(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """(size,) zeros, for callers that write or read only a small part.

    Cost: on the CPU, the pages that are used. NumPy gets zeroed pages from the system, which for tens of megabytes is
    several times as fast as `torch.zeros`.
    """
    if device.type == "cpu":
        return torch.from_numpy(np.zeros(size, torch.empty(0, dtype=dtype, device="cpu").numpy().dtype))
    return torch.zeros(size, dtype=dtype, device=device)


def lazy_empty(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """(size,) undefined values, for callers that write only a small part. Cost: as for `lazy_zeros`."""
    if device.type == "cpu":
        return torch.from_numpy(np.empty(size, torch.empty(0, dtype=dtype, device="cpu").numpy().dtype))
    return torch.empty(size, dtype=dtype, device=device)


def mark(flags: Tensor, index: Tensor) -> Tensor:
    """Set (N,) bools at the indices, (K,) int64, in place, and return them.

    Cost: one pass. `scatter_` of a tensor is two to three times as fast on the CPU as that of a number or as
    `index_fill_`.
    """
    return flags.scatter_(0, index, constant((True,), torch.bool, flags.device).expand_as(index))


def draw(index: Tensor, size: int) -> Tensor:
    """(size,) bool, True at the indices, (N,) int64."""
    return mark(torch.zeros(size, dtype=torch.bool, device=index.device), index)


def take_columns(table: Tensor, index: Tensor) -> Tensor:
    """`table[:, index]`, (R, K), of an (R, C) table; on the CPU three times as fast as `index_select`."""
    return table.gather(1, index.expand(len(table), -1))


def exceeds(values: Tensor, bound: Tensor) -> Tensor:
    """`values > bound`, bool, of numbers that broadcast; on the CPU NumPy is four times as fast as torch."""
    if values.device.type == "cpu":
        return torch.from_numpy(np.greater(values.numpy(), bound.numpy()))
    return values > bound


def largest_of_rows(values: Tensor) -> Tensor:
    """`values.argmax(1)`, (R,) int64, of (R, C) numbers; on the CPU NumPy is four times as fast as torch."""
    if values.device.type == "cpu":
        return torch.from_numpy(values.numpy().argmax(1))
    return values.argmax(1)


def floor_divide(index: Tensor, divisor: int) -> Tensor:
    """`index // divisor`, (...) int64, of (...) int64 and a number of at least 1.

    Cost: one pass. On the CPU we use NumPy. It multiplies and shifts to divide: four times as fast as torch.
    """
    if index.device.type == "cpu":
        return torch.from_numpy(np.asarray(index.numpy() // divisor))  # asarray, because 0-d arrays become numbers
    return torch.div(index, divisor, rounding_mode="floor")


def divide(values: Tensor, number: float) -> Tensor:
    """`values / number`, (...) floats, with the same bits on every device.

    The divisor is a tensor, because a GPU multiplies by the reciprocal of a plain number, which rounds differently.
    """
    return values / constant((number,), values.dtype, values.device)


def split_index(index: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """Quotient and remainder, (...) int64 each: (row, col) of a pixel in raster order."""
    row = floor_divide(index, width)
    return row, torch.sub(index, row, alpha=width)
