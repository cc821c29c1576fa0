"""Point clouds in the PCD format with the headers that programs write; binary ones by pypcd4 (extra `clouds`)."""

from __future__ import annotations

import io
import re
from typing import Any, Mapping, Sequence

import numpy as np

from cflow_torch.data.arrays.cloud_text import numbers_of, with_plain_nan
from cflow_torch.data.column_names import AXES, distinct_names
from cflow_torch.errors import import_optional, warn

LONGEST_HEADER = 65536  # bytes
_DATA = re.compile(rb"^[ \t]*DATA[ \t]+(\w+)[ \t]*\r?\n", re.MULTILINE | re.IGNORECASE)


def pcd_fields(content: bytes) -> dict[str, np.ndarray]:
    """Read the fields of a `.pcd` file: name -> (N,) array of the stated dtype.

    Organised clouds (HEIGHT above 1) are flattened row by row. Padding and fields of several values (COUNT above 1) are
    left out. VIEWPOINT is not applied, so points stay in their stored frame (see `pcd_viewpoint`). NaN points stay. A
    file that is damaged or not a `.pcd` file may raise any exception, which the caller reports.
    """
    header, end = _header(content)
    if header["DATA"] == ["ascii"]:
        return _text_fields(content[end:], header)
    text = "".join(f"{key} {' '.join(words)}\n" for key, words in header.items())
    cloud = pypcd4().PointCloud.from_fileobj(io.BytesIO(text.encode("utf-8") + content[end:]))
    table = np.atleast_1d(cloud.pc_data)
    _check_number(len(table), header)
    # pypcd4 splits fields of several values, and mixes these fields up in compressed files.
    names = [name for name, count in zip(header["FIELDS"], header["COUNT"]) if int(count) == 1 and name != "_"]
    # pypcd4 1.4 makes a two-dimensional table of a cloud without points.
    return {name: np.ascontiguousarray(table[name]).reshape(-1) for name in names}


def _check_number(count: int, header: Mapping[str, Sequence[str]]) -> None:
    width, height = int(header["WIDTH"][0]), int(header["HEIGHT"][0])
    if count != width * height:
        raise ValueError(f"it has {count} points, but its header states {width} x {height}")


def _text_fields(body: bytes, header: Mapping[str, Sequence[str]]) -> dict[str, np.ndarray]:
    """Read the fields of a text. Those that are characters, or numbers of another type, are left out, and we say so.

    PCL writes fields of one byte as characters, of which some are blanks or ends of lines. A row then has fewer words,
    and only the fields before the first such field are certain. It must be behind x, y, z: else a row of too few words
    is an error.
    """
    names = header["FIELDS"]
    ends = np.cumsum([int(count) for count in header["COUNT"]]).tolist()  # columns up to each field
    needed = [k for k, name in enumerate(names) if name.lower() in AXES] or list(range(len(names)))
    are_bytes = [size == "1" and name != "_" for size, name in zip(header["SIZE"], names)]
    num_certain = [*are_bytes, True].index(True)
    num_certain = num_certain if num_certain > max(needed) else len(names)
    lines = [line.split() for line in with_plain_nan(body).splitlines() if not line.lstrip().startswith(b"#")]
    rows = [words for words in lines if len(words) >= ends[num_certain - 1]]
    if num_certain == len(names) and len(rows) < sum(map(bool, lines)):
        raise ValueError(f"a line of it has fewer than {ends[-1]} numbers")
    _check_number(len(rows), header)
    are_short = [len(words) < ends[-1] for words in rows]
    if are_short[-1:] == [True] and sum(are_short) == 1:
        raise ValueError("its last line is not complete")
    num_certain = num_certain if any(are_short) else len(names)
    fields, characters = {}, []
    for k, name in enumerate(names):
        if name == "_" or int(header["COUNT"][k]) > 1:
            continue
        kind = np.dtype(f"{header['TYPE'][k].lower()}{header['SIZE'][k]}")
        try:
            numbers = None if k >= num_certain else numbers_of([words[ends[k] - 1] for words in rows], kind)
        except OverflowError:
            if k in needed:
                raise
            warn(f"the field {name} of .pcd files has numbers that are not {kind.name}, so we leave it out")
            continue
        except ValueError:
            if k in needed or kind.itemsize > 1:
                raise
            numbers = None
        if numbers is None:
            characters.append(name)
        else:
            fields[name] = numbers
    if characters:
        warn(f"the fields {', '.join(characters)} of .pcd files hold characters, or follow them, so we leave them out")
    return fields


def pcd_viewpoint(content: bytes) -> np.ndarray | None:
    """Read VIEWPOINT, (7,) float64 x, y, z and quaternion w, x, y, z, as stored; None if it is missing or not set.

    `content` is the start of a `.pcd` file, at least its header.
    """
    numbers = np.array(_header(content)[0]["VIEWPOINT"], np.float64)
    is_set = numbers.shape == (7,) and not np.array_equal(numbers, (0, 0, 0, 1, 0, 0, 0))
    return numbers if is_set else None


def pypcd4() -> Any:
    return import_optional("pypcd4", "PCD files need pypcd4 (extra clouds): pip install pypcd4")


def _header(content: bytes) -> tuple[dict[str, list[str]], int]:
    """Return the words of each line of the header, complete and in the order of version 0.7, and the size in bytes."""
    data = _DATA.search(content[:LONGEST_HEADER])
    if data is None:
        raise ValueError("it has no complete header")
    lines = content[: data.start()].decode("latin-1").splitlines()  # comments may have any encoding
    words = {line[0].upper(): line[1:] for line in map(str.split, lines) if line}
    names = words.get("FIELDS") or words["COLUMNS"]  # version 0.5
    types = {"SIZE": words["SIZE"], "TYPE": [kind.upper() for kind in words["TYPE"]]}
    columns = {"FIELDS": distinct_names(names, "_"), **types, "COUNT": words.get("COUNT") or ["1"] * len(names)}
    if {len(column) for column in columns.values()} != {len(names)}:
        raise ValueError(f"its header has {len(names)} fields, but another number of sizes, types or counts")
    has_values = [int(count) > 0 for count in columns["COUNT"]]
    columns = {key: [word for word, has in zip(column, has_values) if has] for key, column in columns.items()}
    width, height = words.get("WIDTH") or words["POINTS"], words.get("HEIGHT") or ["1"]
    if int(width[0]) * int(height[0]) == 0:  # PCL writes 0 if the size was not set
        width, height = words.get("POINTS") or width, ["1"]
    size = {"WIDTH": width, "HEIGHT": height}
    rest = {"VIEWPOINT": words.get("VIEWPOINT") or ["0", "0", "0", "1", "0", "0", "0"]}
    points = {"POINTS": [str(int(width[0]) * int(height[0]))], "DATA": [data[1].decode("ascii").lower()]}
    return {"VERSION": ["0.7"], **columns, **size, **rest, **points}, data.end()
