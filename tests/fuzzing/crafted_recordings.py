"""Waymo frames and AevaScenes archives, small ones to start from and hostile ones."""

from __future__ import annotations

import io
import pickle
import random
import struct
import zlib
from typing import Any, List, Optional, Sequence, Tuple

import numpy as np
from hypothesis.strategies import SearchStrategy

from fuzzing.crafted_clouds import SIZES, made, npy_of, zipped
from fuzzing.mutation import WIDE

_IDENTITY = tuple(np.eye(4).ravel().tolist())
_ODD = (float("nan"), float("inf"), -1.0, 1e308, 0.0, -1e-300)


def varint(value: int) -> bytes:
    """A number as protobuf writes it."""
    out = b""
    while value > 127:
        out, value = out + bytes([value & 0x7F | 0x80]), value >> 7
    return out + bytes([value])


def field(number: int, value: Any) -> bytes:
    """One protobuf field: an integer as varint, a float as double, bytes with their length."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    if isinstance(value, float):
        return varint(number << 3 | 1) + struct.pack("<d", value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def numbers(values: Sequence[float]) -> bytes:
    """A message of repeated doubles in its first field."""
    return b"".join(field(1, float(value)) for value in values)


def image(values: np.ndarray, shape: Optional[Sequence[int]] = None) -> bytes:
    """A range image."""
    sizes = b"".join(field(1, int(size)) for size in (values.shape if shape is None else shape))
    return zlib.compress(field(1, values.astype("<f4").tobytes()) + field(2, sizes), 1)


_IMAGES = (image(np.zeros((64, 600, 4))), zlib.compress(b"\x08" * 999), zlib.compress(bytes(1 << 14)))


class Frames:
    """Two frames of two lasers with images of 2 x 3 pixels, one box; hostile where chance has it.

    Args:
        chance: None = nothing is hostile.
    """

    def __init__(self, chance: Optional[random.Random] = None) -> None:
        self._chance = chance

    def build(self) -> bytes:
        """The file."""
        records = [self._frame(time) for time in (1_500_000_000_000_000, 1_500_000_000_100_000)]
        return b"".join(
            struct.pack("<Q", self._or(len(record), WIDE)) + bytes(4) + record + bytes(4) for record in records
        )

    def _or(self, value: Any, others: Sequence[Any], odds: float = 0.02) -> Any:
        return value if self._chance is None or self._chance.random() > odds else self._chance.choice(others)

    def _frame(self, time: int) -> bytes:
        lasers = b"".join(field(3, self._mount(laser)) for laser in (1, 2))
        frame = field(1, field(1, b"context") + lasers) + field(2, self._or(time, (*WIDE, b"", 1.5, 1 << 600)))
        frame += field(3, numbers(self._or(_IDENTITY, ((1.0,) * 16, (1.0,), (_ODD[0],) * 16))))
        for laser in (1, 2):
            parts = field(2, self._image(4)) + (field(4, self._image(6, 0.0)) if laser == 1 else b"")
            parts += self._or(field(5, self._image(4, 1.0)), (b"",), 0.3)
            frame += field(5, field(1, self._or(laser, (*WIDE, b"x"))) + field(2, parts))
        for track in self._or((b"a", b"b"), ((b"a", b"a"), ())):
            box = b"".join(field(n, self._or(1.0, _ODD)) for n in range(1, 8))
            kind = self._or(1, (*WIDE, 0, 2, 3, 4, b""))
            frame += field(6, field(1, box) + field(3, kind) + field(4, self._or(track, (*WIDE, b"\xff", 10**12))))
        return frame + self._or(b"", (field(7, b"x" * 5), b"\x0b", b"\xff" * 30, bytes(40)), 0.1)

    def _mount(self, laser: int) -> bytes:
        beams = field(2, -0.2) + field(2, 0.1) if laser == 1 else b""
        extrinsic = numbers(self._or(_IDENTITY, ((1.0,) * 16, (0.0,) * 3)))
        low = field(3, self._or(-0.1, (*_ODD, 7, b"xx"))) + field(4, 0.1)
        return field(1, laser) + self._or(beams, (b"", beams * 2)) + low + field(5, extrinsic)

    def _image(self, channels: int, value: float = 5.0) -> bytes:
        values = np.full((2, 3, channels), value)
        if self._chance is None:
            return image(values)
        values[0, 0, :] = self._or(value, (*_ODD, 2e9, 1e30), 0.2)
        shape: List[int] = list(self._or(values.shape, ((0, 10**12, 4), (10**12, 0, 4), (2, 3), (6, 4), (1 << 64, 1))))
        shape[0] = self._or(shape[0], SIZES)
        packed = image(values, shape)
        return self._or(packed, (b"", packed[:-3], *_IMAGES))


def crafted_frames() -> SearchStrategy[bytes]:
    """Well-formed records of frames with hostile numbers, shapes and images."""
    return made(lambda chance: Frames(chance).build())


def object_npy(pickled: bytes, shape: Tuple[int, ...] = (4, 1)) -> bytes:
    """A .npy of dtype object with any pickle in it."""
    header = io.BytesIO()
    values = {"descr": "|O", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(header, values)
    return header.getvalue() + pickled


def names_npz(names: bytes, chance: Optional[random.Random] = None, **arrays: bytes) -> bytes:
    """An AevaScenes cloud of four points.

    Args:
        names: content of the member semantic_labels.npy.
        chance: of damage to the archive; None = none.
        arrays: content of members to replace.
    """
    table = np.arange(12, dtype=np.float32).reshape(4, 3)
    members = {"xyz": npy_of(table), "velocity": npy_of(table[:, :1]), "semantic_labels": names, **arrays}
    return zipped(chance, [(f"{name}.npy", content) for name, content in members.items()])


NAMES = np.array([["car"], ["road"], ["car"], ["sidewalk"]], dtype=object)
_SMALL = (
    b"N",
    b"\x88",
    b"\x89",
    b"]",
    b"(",
    b"t",
    b"\x85",
    b"\x86",
    b"\x87",
    b"R",
    b"b",
    b"a",
    b"e",
    b"\x94",
    b".",
    b"0",
)
_LARGE = (
    *(
        b"h\x00",
        b"h\x05",
        b"q\x00",
        b"K\x05",
        b"J\xff\xff\xff\xff",
        b"j\x00\x00\x00\x00",
        b"r\xff\xff\xff\x7f",
        b"r\0\0\1\0",
    ),
    *(b"\x8c\x03car", b"X\x03\0\0\0car", b"X\xff\xff\xff\xff", b"\x8d" + b"\xff" * 8, b"\x8e" + b"\xff" * 8),
    *(
        b"\x95" + b"\xff" * 8,
        b"\x8b\xff\xff\xff\x7f",
        b"\x96" + b"\xff" * 8,
        b"}",
        b"s",
        b"u",
        b"d",
        b"2",
        b"1",
        b"\x8f",
    ),
    *(
        b"cos\nsystem\n",
        b"cnumpy\ndtype\n",
        b"cnumpy\nndarray\n",
        b"cnumpy.core.multiarray\nscalar\n",
        b"\x93",
        b"\x81",
    ),
    *(
        b"cnumpy._core.multiarray\n_reconstruct\n",
        b"I" + b"9" * 50 + b"\n",
        b"p999999999\n",
        b"P1\n",
        b"Q",
        b"\x82\x01",
    ),
    *(b"C\x04a\0\0\0", b"B\xff\xff\xff\x7f", b"ios\nsystem\n", b"\x97", b"\x80\x05", b"\x80\xff", b"l", b")", b"o"),
)


def _pickle(chance: random.Random) -> bytes:
    whole = pickle.dumps(NAMES, protocol=chance.choice((3, 4, 5)))
    pieces = [chance.choice(_SMALL if chance.random() < 0.5 else _LARGE) for _ in range(chance.choice((1, 2, 10, 40)))]
    at = chance.randrange(len(whole))
    kind = chance.randrange(3)
    if kind == 0:
        return b"".join(pieces) + b"."
    return whole[:at] + b"".join(pieces) + (whole[at:] if kind == 1 else b".")


def crafted_names() -> SearchStrategy[bytes]:
    """Archives with hostile pickles, hostile arrays, hostile entries."""

    def build(chance: random.Random) -> bytes:
        names = object_npy(_pickle(chance), (4, 1) if chance.random() < 0.9 else (chance.choice(SIZES), 1))
        other = {} if chance.random() < 0.7 else {chance.choice(("xyz", "velocity")): npy_of(None, chance, (4, 3))}
        return names_npz(names, chance if chance.random() < 0.2 else None, **other)

    return made(build)
