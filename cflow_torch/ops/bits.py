"""Bits of bytes: packed, counted, taken apart."""

from __future__ import annotations

import torch
from torch import Tensor


def pack_bits(flags: Tensor) -> Tensor:
    """(P,) uint8 whose bit c is `flags[:, c]`. Args: flags: (P, n) bool, n at most 8."""
    packed = torch.zeros(len(flags), dtype=torch.uint8, device=flags.device)
    for bit, values in enumerate(flags.unbind(1)):
        packed |= values.to(torch.uint8) << bit
    return packed


def popcount(packed: Tensor) -> Tensor:
    """(P,) int64, number of set bits. Args: packed: (P,) uint8."""
    table = torch.tensor([bin(value).count("1") for value in range(256)], device=packed.device)
    return table.index_select(0, packed.int())


def unpack_bits(packed: Tensor, num_bits: int) -> Tensor:
    """(N, n, ...) float32 zeros and ones, bit c of each byte. Args: packed: (N, ...) uint8; num_bits: n."""
    return torch.stack([(packed >> bit) & 1 for bit in range(num_bits)], 1).float()
