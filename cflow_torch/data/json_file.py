"""JSON documents: the one door, which bounds what they may cost and tells what is wrong with them."""

from __future__ import annotations

import json
import re
import reprlib
import sys
from collections import Counter
from pathlib import Path
from typing import Any, Callable, Dict, List, Optional, Tuple

from cflow_torch.data.paths import read_bytes
from cflow_torch.types import CFlowError

MAX_JSON_BYTES = 64 << 20  # of a document; the largest that belongs to a log has about 10 MB
MAX_DEPTH = 64  # lists and objects in each other; none of the formats has more than ten
_MAX_DIGITS = 4300  # of a whole number, as Python itself has it since 3.8.14: the time grows with their square
_DIGITS = re.compile(rf"[0-9]{{{_MAX_DIGITS + 1}}}")
_LONE_SURROGATE = re.compile(
    r"(?<!\\)(?:\\\\)*\\u[dD](?:[89abAB][0-9a-fA-F]{2}(?!\\u[dD][c-fC-F])|"
    r"(?<!\\u[dD][89abAB][0-9a-fA-F]{2}\\u[dD])[c-fC-F])"
)
_SHORT = reprlib.Repr()
_SHORT.maxlist, _SHORT.maxstring, _SHORT.maxother = 12, 80, 80


def read_json(file: Path) -> Any:
    """What is in a JSON file.

    Convention: UTF-8, with or without a byte order mark. NaN and Infinity are numbers, as Python writes them: whoever
        needs finite ones checks, since 1e999 is infinite too. An object must not have a key twice.

    Cost: memory of at most 50 times the file, which has at most `MAX_JSON_BYTES`.

    Raises:
        CFlowError: too large, not UTF-8, no JSON, deeper than `MAX_DEPTH`, a doubled key, half of a surrogate pair, a
            whole number of more than 4300 digits.
        OSError: as `read_bytes`.
    """
    value = parse_json(read_bytes(file, MAX_JSON_BYTES), file)
    _check_depth(value, file)
    return value


def parse_json(data: bytes, file: Any, use: Optional[Callable[[Dict[str, Any]], Any]] = None) -> Any:
    """What a text says; `read_json` for parts of larger files.

    Args:
        data: the text.
        file: where it is from, for the message.
        use: called with each object, inner ones first; what it returns takes the object's place. Of a doubled key it
            gets the last value.

    Raises:
        CFlowError: as `read_json`; the depth is that of Python's stack.
    """
    try:
        text = data.decode("utf-8-sig")
        if not hasattr(sys, "set_int_max_str_digits") and _DIGITS.search(text):
            raise ValueError(f"a whole number has more than {_MAX_DIGITS} digits")
        if "\\u" in text and _LONE_SURROGATE.search(text):
            raise ValueError("half of a surrogate pair, which is no character")
        return json.loads(text, object_hook=use) if use else json.loads(text, object_pairs_hook=_unique)
    except CFlowError:
        raise
    except (ValueError, RecursionError, MemoryError) as error:
        raise CFlowError(
            f"cannot read {file} as JSON: {str(error)[:200]}; it may be truncated, copy it again"
        ) from error


def shown(value: Any) -> str:
    """A value for a message: short, however large or deep it is."""
    return _SHORT.repr(value)[:200]


def is_number(value: Any) -> bool:
    """Whether a value is a finite number that a float64 can hold; true and false are none."""
    return type(value) in (int, float) and -1e308 <= value <= 1e308


def is_whole(value: Any, most: int = (1 << 63) - 1) -> bool:
    """Whether a value is a whole number from -most to most, by default one that an int64 can hold."""
    return type(value) is int and abs(value) <= most


def _unique(pairs: List[Tuple[str, Any]]) -> Dict[str, Any]:
    if not pairs:
        return {}  # dict([]) takes four times as much in Python 3.8
    found = dict(pairs)
    if len(found) != len(pairs):
        twice = Counter(key for key, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"the key {twice[:40]!r} stands twice in one object")
    return found


def _check_depth(value: Any, file: Any) -> None:
    level, depth = [value], 0
    while level:
        if depth > MAX_DEPTH:
            raise CFlowError(f"{file} has lists or objects nested more than {MAX_DEPTH} deep; is it the right file?")
        inner = (node.values() if type(node) is dict else node for node in level if type(node) in (dict, list))
        level = [child for node in inner for child in node if type(child) in (dict, list)]
        depth += 1
