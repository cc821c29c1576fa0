"""Point clouds in the PLY format: the properties of the element `vertex`, as text or binary."""

from __future__ import annotations

import re
from typing import Dict, List, Mapping, Tuple

import numpy as np

from cflow_torch.data.arrays.text_numbers import text_column
from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.bounds import check_claim
from cflow_torch.data.paths import Place, as_path, read_bytes
from cflow_torch.types import CFlowError

_CODES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_TYPES: Dict[str, str] = {
    **dict(zip(("char", "uchar", "short", "ushort", "int", "uint", "float", "double"), _CODES)),
    **dict(zip(("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"), _CODES)),
}
_NAMES = {code: name for name, code in list(_TYPES.items())[: len(_CODES)]}  # the names of the original format
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 65536


def read_ply(path: Place) -> Dict[str, np.ndarray]:
    """All properties of the vertices.

    Args:
        path: a `.ply` file whose first element is `vertex`; further elements, such as faces, are not read.

    Returns:
        Property name -> (N,) array of the type that the header states, in the byte order of the machine.

    Raises:
        CFlowError: no such file, no PLY file, a header that cannot be followed, or fewer data than it says.

    Source: G. Turk, "The PLY Polygon File Format".
    """
    try:
        content = read_bytes(as_path(path))
    except OSError as error:
        raise CFlowError(f"cannot read {path} ({error}); give a .ply file") from error
    try:
        return _read(content)
    except CFlowError as error:
        raise CFlowError(f"{path} cannot be read as PLY: {error}") from error


def write_ply(path: Place, fields: Mapping[str, np.ndarray], data: str = "binary_little_endian") -> None:
    """Write vertices, atomically.

    Args:
        path: file name.
        fields: property name -> (N,) float32, float64, bool or integers of up to 32 bits.
        data: "binary_little_endian", "binary_big_endian" or "ascii" (floats with 9 or 17 digits).

    Raises:
        CFlowError: no fields, names with spaces, arrays of different lengths, other dtypes, unknown `data`.
    """
    if data not in _ORDERS:
        raise CFlowError(f"data={data!r}: PLY data are {', '.join(_ORDERS)}")
    columns = {}
    for name, given in fields.items():
        values = np.asarray(given)
        values = values.astype(np.uint8) if values.dtype == bool else values
        if values.dtype.str[1:] not in _NAMES or values.ndim != 1:
            raise CFlowError(
                f"property {name} has dtype {values.dtype} and shape {values.shape}: PLY stores (N,) float32, float64 "
                "and integers of up to 32 bits"
            )
        if re.fullmatch(r"[!-~]+", name) is None:
            raise CFlowError(f"{name!r} is no property name: give printable ASCII without spaces")
        columns[name] = values
    if len({len(values) for values in columns.values()}) != 1:
        raise CFlowError(f"properties must be of one length, got { {n: len(v) for n, v in columns.items()} }")
    num_points = len(next(iter(columns.values())))
    properties = "".join(f"property {_NAMES[values.dtype.str[1:]]} {name}\n" for name, values in columns.items())
    header = f"ply\nformat {data} 1.0\nelement vertex {num_points}\n{properties}end_header\n"
    if data == "ascii":
        forms = {"f4": "%.9g", "f8": "%.17g"}
        words = [[forms.get(v.dtype.str[1:], "%d") % x for x in v.tolist()] for v in columns.values()]
        body = "".join(" ".join(row) + "\n" for row in zip(*words)).encode("ascii")
    else:
        order = _ORDERS[data]
        table = np.zeros(num_points, [(name, order + values.dtype.str[1:]) for name, values in columns.items()])
        for name, values in columns.items():
            table[name] = values
        body = table.tobytes()
    with atomic_file(path) as file:
        file.write(header.encode("ascii") + body)


def _read(content: bytes) -> Dict[str, np.ndarray]:
    end = re.search(rb"^end_header[ \t]*\r?\n", content[:_LONGEST_HEADER], re.MULTILINE)
    if not content.startswith(b"ply") or end is None:
        raise CFlowError("it does not begin with 'ply' and a header that ends; it is truncated or of another format")
    lines = [line.split() for line in content[: end.start()].decode("ascii", "replace").splitlines()[1:]]
    lines = [words for words in lines if words and words[0] not in ("comment", "obj_info")]
    if not lines or lines[0][0] != "format" or len(lines[0]) != 3 or lines[0][1] not in _ORDERS:
        raise CFlowError(
            f"its format must be one of {', '.join(_ORDERS)}, got {' '.join(lines[0] if lines else [])[:80]!r}"
        )
    kind = lines[0][1]
    num_points, properties = _vertices(lines[1:])
    body = content[end.end() :]
    if kind == "ascii":
        return _read_ascii(body, num_points, properties)
    table_type = np.dtype([(name, _ORDERS[kind] + code) for name, code in properties])
    needed = num_points * table_type.itemsize
    check_claim("its header", "the cloud", needed)
    if len(body) < needed:
        raise CFlowError(f"{num_points} vertices need {needed} bytes, found {len(body)}; it is truncated")
    table = np.frombuffer(body, table_type, num_points)
    return {name: table[name].astype(code) for name, code in properties}


def _vertices(lines: List[List[str]]) -> Tuple[int, List[Tuple[str, str]]]:
    """Number of vertices and (name, type code) of their properties."""
    first = " ".join(lines[0]) if lines else ""
    if re.fullmatch(r"element vertex [0-9]{1,12}", first) is None:
        raise CFlowError(f"its first element must be 'vertex' with the number of points, got {first[:80]!r}")
    properties = []
    for words in lines[1:]:
        if words[0] == "element":
            break
        if words[0] != "property" or len(words) != 3 or words[1] not in _TYPES:
            raise CFlowError(
                f"vertices may have scalar properties of types {', '.join(_TYPES)}; got {' '.join(words)[:80]!r}"
            )
        properties.append((words[2], _TYPES[words[1]]))
    names = [name for name, _ in properties]
    if not names or len(set(names)) < len(names):
        raise CFlowError(f"vertices need properties of different names, got {' '.join(names)[:200]!r}")
    return int(lines[0][2]), properties


def _read_ascii(body: bytes, num_points: int, properties: List[Tuple[str, str]]) -> Dict[str, np.ndarray]:
    needed = num_points * len(properties)
    words = body.split(None, needed)[:needed] if needed <= len(body) else []
    if len(words) < needed:
        raise CFlowError(f"{num_points} vertices need {needed} numbers, there are fewer; it is truncated")
    fields = {}
    for column, (name, code) in enumerate(properties):
        try:
            fields[name] = text_column(words[column :: len(properties)], np.dtype(code))
        except ValueError as error:
            raise CFlowError(f"property {name}: {str(error)[:80]}") from error
    return fields
