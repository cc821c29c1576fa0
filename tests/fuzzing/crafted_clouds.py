"""Files of points that are well formed outside and hostile inside."""

from __future__ import annotations

import io
import random
import struct
import zipfile
from typing import Callable, List, Optional, Sequence, Tuple

import numpy as np
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from fuzzing.mutation import WIDE

SIZES = (0, 1, 2, 3, 4, 5, 100, 65536, 2**31 - 1, 2**31, 2**32, 10**12, 2**63 - 1, 2**63, 2**64, 10**30)
_COUNTS = ("0", "1", "3", "4", "-1", "1.5", "1e3", "x", "", "007", "1000000000000", "4294967296", "9" * 50, "9" * 5000)
_WORDS = (
    *("0", "1", "-1", "0.5", "nan", "inf", "-inf", "1e400", "1e-400", "1_0", "0x10", "x", "256", "-129", "1.5"),
    *("9" * 25, "9" * 400, "9" * 5000, "1" + "0" * 300, "0e999999999", "1e-999999999", "1e308", "１", "٣", "\0", "#"),
    *("1700000000.123456789", "9223372036.854775807", "9223372036.854775808", "-9223372037", "1e30"),
)
_DESCRS = (
    *("'<f4'", "'<f8'", "'>f4'", "'<f2'", "'|b1'", "'<i8'", "'|u1'", "'<c16'", "'|O'", "'|V0'", "'<U0'", "'|S4'"),
    *("'<U1000000000'", "'<M8[ns]'", "'<m8'", "'f4,f4,f4'", "'(1000000,)f4'", "'<f16'", "'<g'", "''", "1", "None"),
    *("[('x', '<f4'), ('y', '<f4'), ('z', '<f4')]", "[('x', '<f4'), ('y', '<M8[s]'), ('z', '<U3')]"),
    *("[('x', '|O'), ('y', '<f4'), ('z', '<f4')]", "[('x', '<f4', (2,)), ('y', '<f4', (2,)), ('z', '<f4', (2,))]"),
    *("[('x', '<f4', (10000000000,))]", "[('x', [('x', '<f4')]), ('y', '<f4'), ('z', '<f4')]", "[]", "[()]", "{}"),
    *("[('', '|V4'), ('x', '<f4')]", "[('x', '<f4'), ('x', '<f4')]", "[('x', '<c8'), ('y', '<i4'), ('z', '|b1')]"),
    *("[" * 300, "(" * 90 + ")" * 90, "-" * 3000 + "1", "[('a', " * 60 + "'<f4'" + ")]" * 60, "b'<f4'", "'\\N{BELL}'"),
)


def made(build: Callable[[random.Random], bytes]) -> SearchStrategy[bytes]:
    """Files from one number each: quick, and the same on every machine."""
    return st.integers(0, (1 << 64) - 1).map(lambda number: build(random.Random(number)))


def _body(chance: random.Random, sizes: Sequence[int] = (0, 1, 8, 16, 48, 64, 96, 192, 1000)) -> bytes:
    size = chance.choice(sizes)
    kind = chance.randrange(4)
    if kind == 0:
        return bytes(size)
    if kind == 1:
        values = (0.0, 1.0, -1.5, float("nan"), float("inf"), 3e38, 1e-45)
        return b"".join(struct.pack("<f", chance.choice(values)) for _ in range(size // 4))
    return (b"\xff" * size) if kind == 2 else bytes(chance.getrandbits(8) for _ in range(size))


BODY = made(_body)


def _text(chance: random.Random, most: int) -> bytes:
    words = (chance.choice(_WORDS) if chance.random() < 0.2 else "1" for _ in range(chance.randrange(most)))
    return chance.choice((" ", "\n", ",", "\t")).join(words).encode()


def crafted_pcd(wanted: Sequence[str] = ("x", "y", "z")) -> SearchStrategy[bytes]:
    """Headers that claim much, contradict themselves or their data.

    Args:
        wanted: fields that the reader asks for.
    """

    def build(chance: random.Random) -> bytes:
        names = [chance.choice(("x", "y", "z", "_", "t")) for _ in range(chance.choice((1, 3, 4, 30)))]
        names = list(wanted) if chance.random() < 0.8 else names
        count = len(names) + (chance.random() < 0.05)
        letters = [chance.choice("FFFIUX") if chance.random() < 0.1 else "F" for _ in range(count)]
        size = [chance.choice(("1", "2", "4", "8", "16", *_COUNTS)) if chance.random() < 0.05 else "4" for _ in letters]
        number = [chance.choice(_COUNTS) if chance.random() < 0.05 else "1" for _ in letters]
        points = chance.choice(_COUNTS) if chance.random() < 0.3 else "4"
        data = chance.choice(("ascii", "binary", "binary_compressed"))
        lines = {"FIELDS": names, "SIZE": size, "TYPE": letters, "COUNT": number, "WIDTH": [points], "POINTS": [points]}
        lines["HEIGHT"] = [chance.choice(_COUNTS) if chance.random() < 0.1 else "1"]
        head = "".join(f"{key} {' '.join(words)}\n" for key, words in lines.items() if chance.random() < 0.98)
        plain = 16 * len(names)
        if data == "ascii":
            body = _text(chance, 25) if chance.random() < 0.5 else b"1 " * (plain // 4)
        elif data == "binary":
            body = _body(chance, (plain, plain, 0, 48, 1000))
        else:
            stream = bytes(chance.choice((0, 31, 32, 255, chance.getrandbits(8))) for _ in range(chance.randrange(60)))
            stream = b"\0\0" + b"\x20\0" * (plain // 3) if chance.random() < 0.5 else stream
            size_of = chance.choice((plain, plain, 0, 2**32 - 1, chance.choice(WIDE) % 2**32))
            body = struct.pack("<II", chance.choice((len(stream), len(stream), 2**32 - 1)), size_of) + stream
        return head.encode() + f"DATA {data}\n".encode() + body

    return made(build)


def crafted_ply() -> SearchStrategy[bytes]:
    """Headers that claim much, contradict themselves or their data."""

    def build(chance: random.Random) -> bytes:
        kind = chance.choice(("ascii", "binary_little_endian", "binary_big_endian"))
        types = ("float", "double", "int8", "uint64", "list uchar int", "list", "uint", "short")
        names = list("xyz") if chance.random() < 0.8 else [chance.choice("xyzw") for _ in range(5)]
        lines = [f"property {chance.choice(types) if chance.random() < 0.1 else 'float'} {name}" for name in names]
        count = chance.choice(_COUNTS) if chance.random() < 0.4 else "4"
        element = chance.choice(("vertex", "vertex", "vertex", "vertex", "face"))
        head = ["ply", f"format {kind} 1.0", f"element {element} {count}", *lines, "end_header", ""]
        if chance.random() < 0.1:
            chance.shuffle(head)
        body = _body(chance) if kind != "ascii" else _text(chance, 25) if chance.random() < 0.5 else b"1 2 3\n" * 4
        return "\n".join(head).encode() + body

    return made(build)


def npy_of(array: Optional[np.ndarray], chance: Optional[random.Random] = None, shape: Sequence[int] = ()) -> bytes:
    """A .npy file.

    Args:
        array: what is in it; None = hostile headers of that shape or another, by chance.
    """
    if array is not None or chance is None:
        file = io.BytesIO()
        np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)
        return file.getvalue()
    sizes = list(shape)
    if chance.random() < 0.3:
        sizes = [chance.choice(SIZES) * chance.choice((1, 1, 1, -1)) for _ in range(chance.choice((0, 1, 2, 3, 40)))]
    elif chance.random() < 0.3:
        sizes[chance.randrange(len(sizes))] = chance.choice(SIZES)
    odd = ("()", "3", "(True, 3)", "(3.0, 3)", "None")
    text_shape = str(tuple(sizes)) if chance.random() < 0.95 else chance.choice(odd)
    descr = chance.choice(_DESCRS) if chance.random() < 0.6 else "'<f4'"
    order = chance.choice(("False", "True", "1", "None")) if chance.random() < 0.2 else "False"
    text = f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {text_shape}, }}\n".encode()
    length = len(text) if chance.random() < 0.95 else chance.choice((0, 5, 65535))
    long = chance.random() < 0.2
    head = b"\x93NUMPY" + (b"\2\0" + struct.pack("<I", length) if long else b"\1\0" + struct.pack("<H", length))
    count = int(np.prod(shape))
    return head + text + bytes(chance.choice((0, 12, 4 * count, 8 * count, 12 * count, 12 * count)))


def crafted_npy(shape: Tuple[int, ...] = (4, 3)) -> SearchStrategy[bytes]:
    """Headers of any dtype and shape.

    Args:
        shape: that the reader wants, so that some come through.
    """
    return made(lambda chance: npy_of(None, chance, shape))


def zipped(chance: Optional[random.Random], members: Sequence[Tuple[str, bytes]]) -> bytes:
    """An archive, by chance with sizes, checksums or methods that are not true."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", chance.choice((0, 8)) if chance else zipfile.ZIP_STORED) as archive:
        for name, content in members:
            archive.writestr(zipfile.ZipInfo(name), content, archive.compression)
    data = bytearray(file.getvalue())
    if chance and chance.random() < 0.3:
        entry = data.find(b"PK\1\2") + chance.choice((8, 10, 16, 20, 24, 42))  # flags, method, CRC, sizes, place
        data[entry : entry + 4] = struct.pack("<I", chance.choice(WIDE) % 2**32)
    return bytes(data)


def crafted_npz() -> SearchStrategy[bytes]:
    """Archives of hostile arrays, and hostile archives."""

    def build(chance: random.Random) -> bytes:
        names: List[str] = chance.choice(
            (["points"], ["points"], ["x", "y", "z"], ["a", "b"], ["a"], ["x"] * 3, ["../../a"], [])
        )
        shape = (4,) if names[:1] == ["x"] else (4, 3)
        return zipped(chance, [(f"{name}.npy", npy_of(None, chance, shape)) for name in names])

    return made(build)


def crafted_text() -> SearchStrategy[bytes]:
    """Rows of 1, 8, 12, 13 or 16 numbers, some hostile."""

    def build(chance: random.Random) -> bytes:
        columns = chance.choice((1, 8, 12, 13, 16))
        identity = {8: "{t} 1 2 3 0 0 0 1", 12: "1 0 0 {t} 0 1 0 0 0 0 1 0", 13: "Tr: 1 0 0 {t} 0 1 0 0 0 0 1 0"}
        rows = []
        for number in range(chance.choice((1, 3, 3, 3, 20))):
            words = identity.get(columns, "{t}" if columns == 1 else "1 0 0 {t} 0 1 0 0 0 0 1 0 0 0 0 1").split()
            words = [word.format(t=f"{1700000000 + number}.5") for word in words]
            if chance.random() < 0.3:
                words[chance.randrange(len(words))] = chance.choice(_WORDS)
            rows.append(" ".join(words))
        return chance.choice(("\n", "\r\n", "\r", "\x0b")).join(rows).encode()

    return made(build)
