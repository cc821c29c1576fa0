"""Pickles for the reader of index files: whole ones of every protocol, and hostile ones."""

from __future__ import annotations

import pickle
import random
import struct
from typing import List

_ENTRIES = [["scene-a", "315966265259836000"], ["scene-a", "315966265360032000"], ["b", "1"]]
# Instructions that an index has, with whole arguments, and those that run, build or claim something.
_CALM = (
    b"]",
    b")",
    b"(",
    b"l",
    b"t",
    b"a",
    b"e",
    b"\x85",
    b"\x86",
    b"\x87",
    b"\x94",
    b"q\0",
    b"h\0",
    b"h\1",
    b"0",
    b"1",
)
_TEXT = (b"\x8c\x01a", b"\x8c\x011", b"X\1\0\0\0b", b"S'c'\n", b"Vd\n", b"U\x01e", b"T\1\0\0\0f", b"\x8c\x02\xff\xfe")
_HOSTILE = (
    *(b"cos\nmkdir\n", b"ios\nmkdir\n", b"R", b"b", b"o", b"\x81", b"\x92", b"\x93", b"\x82\1", b"P0\n", b"Q", b"\x97"),
    *(
        b"2",
        b"}",
        b"u",
        b"s",
        b"\x8f",
        b"\x90",
        b"\x91",
        b"I1\n",
        b"L" + b"9" * 5000 + b"L\n",
        b"N",
        b"\x88",
        b"F1e999\n",
    ),
    *(b"\x8b" + struct.pack("<i", size) for size in (-1, (1 << 31) - 1)),
    *(b"\x95" + struct.pack("<Q", size) for size in (0, 1 << 31, 1 << 62, (1 << 64) - 1)),
    *(code + struct.pack("<Q", size) for code in (b"\x8d", b"\x8e", b"\x96") for size in (1 << 32, (1 << 64) - 1)),
    *(b"r" + struct.pack("<I", place) for place in (1 << 20, (1 << 32) - 1)),
    *(
        b"p1000000000000\n",
        b"p-1\n",
        b"g-1\n",
        b"j\xff\xff\xff\xff",
        b"h\xff",
        b"X\xff\xff\xff\xff",
        b"T\xff\xff\xff\x7f",
    ),
)


def whole_pickles() -> List[bytes]:
    """The same entries in every protocol, as lists and as tuples."""
    return [pickle.dumps(kind, protocol=k) for k in range(5) for kind in (_ENTRIES, [tuple(e) for e in _ENTRIES])]


def hostile_pickle(number: int) -> bytes:
    """A run of instructions: calm, with hostile ones between, with bombs of references, or nested."""
    chance = random.Random(number)
    kind = chance.randrange(4)
    if kind == 0:  # each tuple holds the one before twice
        return b"\x80\x02\x8c\x01aq\0" + b"".join(b"h%ch%c\x86q%c" % (k, k, k + 1) for k in range(100)) + b"."
    if kind == 1:
        depth = chance.choice((10, 1000, 20000))
        return b"\x80\x02" + b"]" * depth + b"a" * (depth - chance.randrange(3)) + b"."
    pool = _CALM + _TEXT if kind == 2 else _CALM + _TEXT + _HOSTILE
    body = b"".join(chance.choice(pool) for _ in range(chance.choice((3, 10, 40))))
    return (
        chance.choice((b"", b"\x80\x02", b"\x80\x04", b"\x80\xff"))
        + b"]("
        + body
        + chance.choice((b"e.", b".", b"a.", b""))
    )
