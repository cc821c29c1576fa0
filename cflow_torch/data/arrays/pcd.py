"""Point clouds in the PCD format (version 0.7): named fields, as text, binary, or binary compressed with LZF."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Dict, List, Mapping, Tuple

import numpy as np

from cflow_torch.data.arrays.lzf import compress, decompress
from cflow_torch.data.arrays.text_numbers import text_column
from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.bounds import check_claim
from cflow_torch.data.paths import Place, as_path, read_bytes
from cflow_torch.types import CFlowError

_TYPES: Dict[Tuple[str, int], np.dtype] = {
    ("F", 4): np.dtype("<f4"),
    ("F", 8): np.dtype("<f8"),
    **{("I", size): np.dtype(f"<i{size}") for size in (1, 2, 4, 8)},
    **{("U", size): np.dtype(f"<u{size}") for size in (1, 2, 4, 8)},
}
_KINDS = {kind: f"{letter} {size}" for (letter, size), kind in _TYPES.items()}
_DATA = ("ascii", "binary", "binary_compressed")
_LONGEST_HEADER = 65536  # bytes; a file without a DATA line before that is no PCD file
_PADDING = "_"  # the point cloud library names bytes that mean nothing so
_LARGEST = 2**32 - 1  # bytes of a compressed cloud: its sizes are uint32


@dataclass(frozen=True)
class _Header:
    """Fields (name, dtype, count), number of points, kind of data, and where the data begin in the file."""

    fields: Tuple[Tuple[str, np.dtype, int], ...]
    num_points: int
    data: str
    start: int

    @property
    def point_bytes(self) -> int:
        """Bytes of one point in binary data."""
        return sum(kind.itemsize * count for _, kind, count in self.fields)


def read_pcd(path: Place) -> Dict[str, np.ndarray]:
    """All fields of a cloud.

    Args:
        path: a `.pcd` file.

    Returns:
        Field name -> (N,) array, or (N, COUNT) where COUNT is above 1, in the file's order. The dtype is that of
        SIZE and TYPE, in the byte order of the machine.

    Convention:
        Organised clouds (HEIGHT above 1) become flat, row by row. Padding fields (`_`) are left out. VIEWPOINT is not
        applied: points stay in the frame that they are stored in. NaN points stay.

    Raises:
        CFlowError: no such file, no PCD file, a header that contradicts itself, or fewer or more data than it says.

    Source: "The PCD (Point Cloud Data) file format" of the Point Cloud Library, version 0.7.
    """
    try:
        content = read_bytes(as_path(path))
    except OSError as error:
        raise CFlowError(f"cannot read {path} ({error}); give a .pcd file") from error
    return pcd_fields(content, path)


def pcd_fields(content: bytes, path: Place) -> Dict[str, np.ndarray]:
    """As `read_pcd`, of what is in the file."""
    try:
        header = _read_header(content)
        check_claim("its header", "a point", header.point_bytes)
        check_claim("its header", "the cloud", header.num_points * header.point_bytes)
        body = content[header.start :]
        read = {"ascii": _read_ascii, "binary": _read_binary, "binary_compressed": _read_compressed}[header.data]
        arrays = read(header, body)
    except CFlowError as error:
        raise CFlowError(f"{path} cannot be read as PCD: {error}") from error
    return {
        name: values[:, 0] if count == 1 else values
        for (name, _, count), values in zip(header.fields, arrays)
        if name != _PADDING
    }


def write_pcd(path: Place, fields: Mapping[str, np.ndarray], data: str = "binary") -> None:
    """Write a cloud, atomically.

    Args:
        path: file name.
        fields: field name -> (N,) or (N, COUNT) array of float32, float64, integers or bool (stored as uint8).
        data: "binary", "binary_compressed" or "ascii" (floats with 9 or 17 digits, so nothing is lost).

    Raises:
        CFlowError: no fields, names with spaces, arrays of different lengths, other dtypes, unknown `data`.
    """
    if data not in _DATA:
        raise CFlowError(f"data={data!r}: PCD data are {', '.join(_DATA)}")
    columns = _columns(fields)
    num_points = len(next(iter(columns.values())))
    count = [values.shape[1] for values in columns.values()]
    letter, size = zip(*(_KINDS[values.dtype].split() for values in columns.values()))
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(columns)}",
        f"SIZE {' '.join(size)}",
        f"TYPE {' '.join(letter)}",
        f"COUNT {' '.join(map(str, count))}",
        f"WIDTH {num_points}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {num_points}",
        f"DATA {data}",
    ]
    write = {"ascii": _ascii, "binary": _binary, "binary_compressed": _compressed}[data]
    body = write(list(columns.values()))
    with atomic_file(path) as file:
        file.write("\n".join(lines).encode("ascii") + b"\n" + body)


def _read_header(content: bytes) -> _Header:
    match = re.search(rb"^DATA[ \t]+(\S+)[ \t]*\r?\n", content[:_LONGEST_HEADER], re.MULTILINE)
    if match is None:
        raise CFlowError("its header has no complete DATA line; it is truncated or of another format")
    lines = content[: match.end()].decode("ascii", "replace").splitlines()
    entries: Dict[str, List[str]] = {}
    for line in lines:
        words = line.split()
        if words and not words[0].startswith("#"):
            if words[0] in entries:
                raise CFlowError(f"the header has two lines {words[0]}")
            entries[words[0]] = words[1:]
    names = entries.get("FIELDS", entries.get("COLUMNS", []))
    data = match.group(1).decode("ascii", "replace")
    if not names or data not in _DATA:
        raise CFlowError(
            f"the header needs FIELDS and DATA {', '.join(_DATA)}; got {len(names)} fields, DATA {data[:80]}"
        )
    entries.setdefault("COUNT", ["1"] * len(names))
    for key in ("SIZE", "TYPE", "COUNT"):
        if len(entries.get(key, [])) != len(names):
            raise CFlowError(f"FIELDS names {len(names)} fields, {key} has {len(entries.get(key, []))} entries")
    if len(set(names) - {_PADDING}) != len([name for name in names if name != _PADDING]):
        raise CFlowError(f"FIELDS names a field twice: {' '.join(names)[:200]}")
    fields = []
    for name, letter, size, count in zip(names, entries["TYPE"], entries["SIZE"], entries["COUNT"]):
        kind = _TYPES.get((letter, _whole("SIZE", size)))
        if kind is None or _whole("COUNT", count) < 1:
            raise CFlowError(
                f"field {name} has TYPE {letter}, SIZE {size}, COUNT {count}; allowed are F of 4 or 8 bytes, I and U "
                "of 1, 2, 4 or 8 bytes, and counts from 1"
            )
        fields.append((name, kind, int(count)))
    return _Header(tuple(fields), _number_of_points(entries), data, match.end())


def _number_of_points(entries: Mapping[str, List[str]]) -> int:
    sizes = {key: _whole(key, *entries[key]) for key in ("POINTS", "WIDTH", "HEIGHT") if key in entries}
    if "WIDTH" in sizes:
        num_points = sizes["WIDTH"] * sizes.get("HEIGHT", 1)
        if sizes.get("POINTS", num_points) != num_points:
            raise CFlowError(f"POINTS is {sizes['POINTS']}, but WIDTH times HEIGHT is {num_points}")
        return num_points
    if "POINTS" not in sizes:
        raise CFlowError("the header has neither WIDTH nor POINTS")
    return sizes["POINTS"]


def _whole(key: str, *words: str) -> int:
    if len(words) != 1 or not words[0].isdigit() or len(words[0]) > 12:
        raise CFlowError(f"{key} must be a whole number, got {' '.join(words)[:80]!r}")
    return int(words[0])


def _read_ascii(header: _Header, body: bytes) -> List[np.ndarray]:
    words = body.split()
    per_point = sum(count for _, _, count in header.fields)
    if len(words) != header.num_points * per_point:
        raise CFlowError(
            f"{header.num_points} points of {per_point} values need {header.num_points * per_point} values, "
            f"found {len(words)}; it is truncated or damaged"
        )
    arrays, first = [], 0
    for name, kind, count in header.fields:
        try:
            columns = [text_column(words[k::per_point], kind) for k in range(first, first + count) if words]
        except ValueError as error:
            raise CFlowError(f"field {name}: {str(error)[:80]}") from error
        arrays.append(np.stack(columns, axis=1) if words else np.zeros((0, count), kind.newbyteorder("=")))
        first += count
    return arrays


def _read_binary(header: _Header, body: bytes) -> List[np.ndarray]:
    body = _exactly(body, header.num_points * header.point_bytes)
    packed = np.dtype([(f"f{i}", kind, (count,)) for i, (_, kind, count) in enumerate(header.fields)])
    table = np.frombuffer(body, packed)
    return [table[f"f{i}"].astype(kind.newbyteorder("=")) for i, (_, kind, _) in enumerate(header.fields)]


def _read_compressed(header: _Header, body: bytes) -> List[np.ndarray]:
    """One field after the other, each for all points."""
    if len(body) < 8:
        raise CFlowError("it ends before the sizes of the compressed data; it is truncated")
    compressed, plain = struct.unpack("<II", body[:8])
    needed = header.num_points * header.point_bytes
    if plain != needed:
        raise CFlowError(f"its {header.num_points} points need {needed} bytes, the compressed data hold {plain}")
    data = decompress(_exactly(body[8:], compressed), plain)
    arrays, at = [], 0
    for _, kind, count in header.fields:
        values = np.frombuffer(data, kind, header.num_points * count, at)
        at += values.nbytes
        arrays.append(values.reshape(header.num_points, count).astype(kind.newbyteorder("=")))
    return arrays


def _exactly(body: bytes, size: int) -> bytes:
    """The first `size` bytes; what follows may only be padding."""
    if len(body) < size:
        raise CFlowError(f"its data need {size} bytes, found {len(body)}; it is truncated")
    if body[size:].strip(b"\0\r\n"):
        raise CFlowError(f"its data need {size} bytes, found {len(body)}; the header does not fit the data")
    return body[:size]


def _columns(fields: Mapping[str, np.ndarray]) -> Dict[str, np.ndarray]:
    """Name -> (N, COUNT), little endian."""
    columns = {}
    for name, given in fields.items():
        values = np.asarray(given)
        values = values.astype(np.uint8) if values.dtype == bool else values
        kind = values.dtype.newbyteorder("<")
        if not name.isascii() or not name.isprintable() or len(name.split()) != 1 or name == _PADDING or "#" in name:
            raise CFlowError(f"{name!r} is no field name: give printable ASCII without spaces, not '_'")
        if kind not in _KINDS:
            raise CFlowError(f"field {name} has dtype {values.dtype}: PCD stores float32, float64 and integers")
        if values.ndim not in (1, 2) or (values.ndim == 2 and values.shape[1] < 1):
            raise CFlowError(f"field {name} has shape {values.shape}: give (N,) or (N, COUNT)")
        columns[name] = values.reshape(len(values), -1 if values.size else (*values.shape, 1)[1]).astype(kind)
    if len({len(values) for values in columns.values()}) != 1:
        raise CFlowError(f"fields must be of one length, got { {n: len(v) for n, v in columns.items()} }")
    return columns


def _ascii(columns: List[np.ndarray]) -> bytes:
    if not len(columns[0]):
        return b""
    words = []
    for values in columns:
        form = {"f4": "%.9g", "f8": "%.17g"}.get(values.dtype.str[1:], "%d")
        words += [[form % value for value in values[:, k].tolist()] for k in range(values.shape[1])]
    return "".join(" ".join(row) + "\n" for row in zip(*words)).encode("ascii")


def _binary(columns: List[np.ndarray]) -> bytes:
    packed = np.dtype([(f"f{i}", values.dtype, (values.shape[1],)) for i, values in enumerate(columns)])
    table = np.zeros(len(columns[0]), packed)
    for i, values in enumerate(columns):
        table[f"f{i}"] = values
    return table.tobytes()


def _compressed(columns: List[np.ndarray]) -> bytes:
    data = b"".join(np.ascontiguousarray(values).tobytes() for values in columns)
    if len(data) > _LARGEST * 32 // 33 - 1:
        raise CFlowError(f"the cloud has {len(data)} bytes; compressed clouds may have 4 GB: write data='binary'")
    stream = compress(data)
    return struct.pack("<II", len(stream), len(data)) + stream
