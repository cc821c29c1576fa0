"""Whole files, damaged."""

from __future__ import annotations

import random
import re
import struct
from typing import Callable, Sequence

from hypothesis import strategies as st

NUMBERS = (0, 1, 2, 7, 127, 128, 255, 256, 32767, 32768, 65535, 1 << 24, (1 << 31) - 1, 1 << 31, (1 << 32) - 1, 10**12)
WIDE = NUMBERS + ((1 << 63) - 1, 1 << 63, (1 << 64) - 1)
WRITTEN = (
    *(b"0", b"-0", b"1", b"-1", b"2", b"3", b"1.5", b"1e9", b"1e400", b"-1e400", b"nan", b"NaN", b"inf", b"-Infinity"),
    *(b"4294967296", b"1000000000000", b"9223372036854775808", b"9" * 400, b"", b"\xc2\xb2"),
    *(b"null", b"[]", b"{}", b'"x"', b"true"),
)
_DIGITS = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


@st.composite
def damaged(draw: Callable[..., object], seeds: Sequence[bytes], tokens: Sequence[bytes] = ()) -> bytes:
    """One of the seeds with one to eight wounds, all from one number: quick, and the same on every machine."""
    chance = random.Random(draw(st.integers(0, (1 << 64) - 1)))
    data = bytearray(chance.choice(seeds))
    for _ in range(chance.choice((1, 1, 1, 2, 3, 8))):
        chance.choice(_WOUNDS)(data, chance, seeds, tokens)
    return bytes(data)


def _flip(data: bytearray, chance: random.Random, seeds: Sequence[bytes], tokens: Sequence[bytes]) -> None:
    if data:
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)


def _overwrite(data: bytearray, chance: random.Random, seeds: Sequence[bytes], tokens: Sequence[bytes]) -> None:
    if data:
        data[chance.randrange(len(data))] = chance.randrange(256)


def _number(data: bytearray, chance: random.Random, seeds: Sequence[bytes], tokens: Sequence[bytes]) -> None:
    size = chance.choice("BHIQ")
    value = chance.choice(WIDE) % (1 << 8 * struct.calcsize("<" + size))
    packed = struct.pack(chance.choice("<>") + size, value)
    at = chance.randrange(len(data) + 1)
    data[at : at + len(packed)] = packed


def _written_number(data: bytearray, chance: random.Random, seeds: Sequence[bytes], tokens: Sequence[bytes]) -> None:
    found = list(_DIGITS.finditer(data[: 1 << 14]))
    if found:
        digits = chance.choice(found)
        data[digits.start() : digits.end()] = chance.choice(WRITTEN)


def _truncate(data: bytearray, chance: random.Random, seeds: Sequence[bytes], tokens: Sequence[bytes]) -> None:
    del data[chance.randrange(len(data) + 1) :]


def _remove(data: bytearray, chance: random.Random, seeds: Sequence[bytes], tokens: Sequence[bytes]) -> None:
    at = chance.randrange(len(data) + 1)
    del data[at : at + chance.choice((1, 2, 4, 8, 64))]


def _repeat(data: bytearray, chance: random.Random, seeds: Sequence[bytes], tokens: Sequence[bytes]) -> None:
    at = chance.randrange(len(data) + 1)
    data[at:at] = data[at : at + chance.choice((1, 4, 16, 256))] * chance.choice((1, 2, 50))


def _insert(data: bytearray, chance: random.Random, seeds: Sequence[bytes], tokens: Sequence[bytes]) -> None:
    at = chance.randrange(len(data) + 1)
    piece = chance.choice(tokens) if tokens else bytes(chance.randrange(256) for _ in range(chance.choice((1, 4, 32))))
    data[at:at] = piece


def _token(data: bytearray, chance: random.Random, seeds: Sequence[bytes], tokens: Sequence[bytes]) -> None:
    there = [token for token in tokens if token and token in data]
    if there:
        old = chance.choice(there)
        at = data.find(old)
        data[at : at + len(old)] = chance.choice(tokens)


def _splice(data: bytearray, chance: random.Random, seeds: Sequence[bytes], tokens: Sequence[bytes]) -> None:
    other = chance.choice(seeds)
    data[chance.randrange(len(data) + 1) :] = other[chance.randrange(len(other) + 1) :]


_WOUNDS = (
    *(_flip, _overwrite, _number, _number, _written_number, _written_number),
    *(_truncate, _remove, _repeat, _insert, _token, _splice),
)
