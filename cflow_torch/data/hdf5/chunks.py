"""Datasets in chunks, unpacked here: libhdf5 bounds no chunk and takes too short ones."""

from __future__ import annotations

import itertools
import math
import zlib
from typing import Any, List, NamedTuple, Optional, Tuple

import numpy as np

from cflow_torch.data.arrays.lzf import decompress
from cflow_torch.data.bounds import check_claim
from cflow_torch.types import CFlowError

_DEFLATE, _SHUFFLE, _LZF = 1, 2, 32000  # numbers of the filters in the format
_MEND = "write it anew, uncompressed or with gzip (compression='gzip' of h5py)"
MAX_CHUNKS = 100_000  # of one dataset; h5py makes chunks of 8 KiB and more


class Stored(NamedTuple):
    """An array in a file, checked but not read.

    Args:
        opened: h5py's low-level dataset.
        shape: of the array.
        dtype: one that NumPy has just like this.
        chunk: shape of its chunks, None = it is not in chunks.
        filters: that each chunk went through.
    """

    opened: Any
    shape: Tuple[int, ...]
    dtype: np.dtype
    chunk: Optional[Tuple[int, ...]]
    filters: List[int]


def filters_of(plan: Any, what: str) -> List[int]:
    """The filters that a dataset went through: shuffle or none, then gzip, LZF or none.

    Args:
        plan: h5py's property list of the dataset.
        what: for the message.

    Raises:
        CFlowError: there are others. They are refused because what they unpack to cannot be bounded, and because HDF5
            would load a library for those that it does not know.
    """
    filters = [plan.get_filter(number)[0] for number in range(plan.get_nfilters())]
    if filters not in [first + last for first in ([], [_SHUFFLE]) for last in ([], [_DEFLATE], [_LZF])]:
        raise CFlowError(
            f"{what} is packed with the filters {filters[:8]}, gzip and lzf are read (with or without shuffle); {_MEND}"
        )
    return filters


def read_chunks(stored: Stored, what: str) -> np.ndarray:
    """All values of an array in chunks, which has some.

    Raises:
        CFlowError: it claims too much, a chunk is missing, or unpacks to another size than it has.
    """
    dtype, shape, chunk = stored.dtype, stored.shape, stored.chunk or stored.shape
    size = math.prod(chunk) * dtype.itemsize
    counts = [-(-whole // part) for whole, part in zip(shape, chunk)]
    if math.prod(counts) > MAX_CHUNKS:
        raise CFlowError(f"{what} has {math.prod(counts)} chunks, up to {MAX_CHUNKS} are read; {_MEND}")
    check_claim(what, "its chunks", math.prod(counts) * size)
    values = np.empty(shape, dtype)
    for numbers in itertools.product(*map(range, counts)):
        corner = tuple(number * part for number, part in zip(numbers, chunk))
        part = np.frombuffer(_unpacked(stored, corner, size, what), dtype).reshape(chunk)
        place = tuple(slice(start, start + length) for start, length in zip(corner, chunk))
        there = values[place]
        there[...] = part[tuple(slice(0, length) for length in there.shape)]
    return values


def _unpacked(stored: Stored, corner: Any, size: int, what: str) -> Any:
    """The bytes of one chunk."""
    info = stored.opened.get_chunk_info_by_coord(corner)
    # Packing makes nothing larger, but for a few bytes in a thousand.
    if info.byte_offset is None or info.size > size + size // 100 + 1024:
        raise CFlowError(
            f"{what}: the chunk at {corner} is missing or claims {info.size} bytes of {size}; copy it again"
        )
    skipped, data = stored.opened.read_direct_chunk(corner)
    for number, kind in reversed(list(enumerate(stored.filters))):
        if skipped >> number & 1:
            continue
        if kind == _DEFLATE:
            unpacker = zlib.decompressobj()
            data = unpacker.decompress(data, size + 1)
            if not unpacker.eof:
                raise CFlowError(f"{what}: the chunk at {corner} does not end after {size} bytes; copy it again")
        elif kind == _LZF:
            data = _unpacked_lzf(data, size, f"{what}: the chunk at {corner}")
        elif len(data) == size:
            data = _unshuffled(data, stored.dtype.itemsize)
    if len(data) != size:
        raise CFlowError(f"{what}: the chunk at {corner} unpacks to {len(data)} bytes, expected {size}; copy it again")
    return data


def _unpacked_lzf(data: bytes, size: int, what: str) -> bytes:
    try:
        return decompress(data, size)
    except ValueError as error:  # a CFlowError too
        raise CFlowError(f"{what} cannot be unpacked ({error}); copy it again") from error


def _unshuffled(data: Any, itemsize: int) -> Any:
    """Shuffle puts the first bytes of all numbers first, then the second ones, ..."""
    planes = np.frombuffer(data, np.uint8).reshape(itemsize, -1)
    numbers = np.empty((planes.shape[1], itemsize), np.uint8)
    for place, plane in enumerate(planes):  # four times as fast as to copy the transpose
        numbers[:, place] = plane
    return numbers.data.cast("B")
