"""Named words for what is done with index tensors: select, look up, count, renumber, divide."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor


def flat_nonzero(mask: Tensor) -> Tensor:
    """Flat indices of the set elements, ascending: `mask.flatten().nonzero()[:, 0]`.

    Args:
        mask: (...) bool.

    Returns:
        (K,) int64.

    Cost: one pass and, on a GPU, one synchronisation. On the CPU NumPy finds them about five times faster than torch
    does in a sparse mask of half a million pixels.
    """
    if mask.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.flatten().nonzero()[:, 0]


def gather(index: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
    """The elements of several tensors at the same indices.

    Args:
        index: (K,) int64.
        tensors: (N, ...) each.

    Returns:
        (K, ...) each.
    """
    return tuple(values.index_select(0, index) for values in tensors)


def lookup(table: Tensor, index: Tensor, missing: float = 0) -> Tensor:
    """Entries of a table, with a default for the index behind its end.

    Args:
        table: (N, ...).
        index: (K,) int64, 0 ... N; N stands for "none".
        missing: what N gives.

    Returns:
        (K, ...), dtype of the table.
    """
    padding = (0, 0) * (table.dim() - 1) + (0, 1)
    return F.pad(table, padding, value=missing).index_select(0, index)


def scatter_count(index: Tensor, size: int, weights: Tensor | None = None) -> Tensor:
    """How often each index occurs, or the sum of its weights.

    Args:
        index: (N,) int64, 0 ... size - 1.
        size: S.
        weights: (N,) or (R, N) numbers; None = 1 each.

    Returns:
        (S,) int64, or (S,) or (R, S) in the dtype of the weights.

    Cost: one pass, without a synchronisation (`torch.bincount` has one).
    """
    if weights is None or weights.dim() == 1:
        weights = torch.ones_like(index) if weights is None else weights
        return weights.new_zeros(size).index_add_(0, index, weights)
    num_rows = len(weights)
    row = torch.arange(num_rows, device=index.device) * size
    # On the CPU sums along a second dimension are many times slower than sums of one dimension.
    return scatter_count((index + row[:, None]).view(-1), num_rows * size, weights.flatten()).view(num_rows, size)


def renumber(index: Tensor, size: int) -> Tensor:
    """Position of each number in a list.

    Args:
        index: (K,) int64, different numbers below S.
        size: S.

    Returns:
        (S + 1,) int64; K for numbers that are not in the list, and for S, which stands for "none".
    """
    number = torch.full((size + 1,), index.numel(), dtype=torch.int64, device=index.device)
    return number.scatter_(0, index, torch.arange(index.numel(), device=index.device))


def index_in_group(group: Tensor) -> Tensor:
    """(N,) int64, index of each element among the elements of its group, from groups (N,) in ascending order."""
    return torch.arange(group.numel(), device=group.device) - torch.searchsorted(group, group)


def lazy_zeros(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """(size,) zeros, of which only a small part will be written or read.

    Cost: on the CPU that of the pages that are touched. NumPy asks the system for zeroed pages, and for large ones:
    several times faster than `torch.zeros` for tens of megabytes.
    """
    if device.type == "cpu":
        return torch.from_numpy(np.zeros(size, torch.empty(0, dtype=dtype).numpy().dtype))
    return torch.zeros(size, dtype=dtype, device=device)


def lazy_empty(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """(size,) of anything, of which only a small part will be written. Cost: as for `lazy_zeros`."""
    if device.type == "cpu":
        return torch.from_numpy(np.empty(size, torch.empty(0, dtype=dtype).numpy().dtype))
    return torch.empty(size, dtype=dtype, device=device)


def take_columns(table: Tensor, index: Tensor) -> Tensor:
    """`table[:, index]`, (R, K), of (R, C) values; on the CPU three times as fast as `index_select`."""
    return table.gather(1, index.expand(len(table), -1))


def largest_of_rows(values: Tensor) -> Tensor:
    """Where the largest value of each row stands: `values.argmax(1)`, (R,) int64, of (R, C) numbers.

    Cost: one pass. On the CPU NumPy finds them four times faster than torch.
    """
    if values.device.type == "cpu":
        return torch.from_numpy(values.numpy().argmax(1))
    return values.argmax(1)


def occupied(image: Tensor) -> Tensor:
    """Flat indices of the elements that are not 0, ascending.

    Args:
        image: (N,) uint8, mostly 0.

    Returns:
        (K,) int64.

    Cost: one pass over the image, eight elements at a time; on a GPU, two synchronisations.
    """
    num_words, device = image.numel() // 8, image.device
    word = flat_nonzero(image[: 8 * num_words].view(torch.int64).bool())
    index = (8 * word[:, None] + torch.arange(8, device=device)).flatten()
    index = torch.cat((index, torch.arange(8 * num_words, image.numel(), device=device)))
    return index.index_select(0, flat_nonzero(image.index_select(0, index).bool()))


def floor_divide(index: Tensor, divisor: int) -> Tensor:
    """Floor division of indices by a positive number: `index // divisor`.

    Args:
        index: (...) int64.
        divisor: at least 1.

    Returns:
        (...) int64.

    Cost: one pass. On the CPU NumPy divides by one number four times faster than torch: it multiplies and shifts.
    """
    if index.device.type == "cpu":
        return torch.from_numpy(np.asarray(index.numpy() // divisor))  # asarray: of no dimension it would be a number
    return torch.div(index, divisor, rounding_mode="floor")


def split_index(index: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """Quotient and remainder of a division by a positive number: (row, col) of a pixel in raster order.

    Args:
        index: (...) int64.
        width: at least 1.

    Returns:
        row, col: (...) int64.
    """
    row = floor_divide(index, width)
    return row, torch.sub(index, row, alpha=width)
