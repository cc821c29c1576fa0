"""JSON that is well formed outside and hostile inside, and texts that only look like JSON."""

from __future__ import annotations

import json
import random
from typing import Any, Callable, List, Sequence, Tuple

from hypothesis import strategies as st

NAMES = (
    *('"../../etc/passwd"', '"/etc/passwd"', '"C:\\\\x"', '"a\\\\..\\\\b"', '"CON"', '"aux.txt"', '"."', '".."'),
    *('"a/../../b"', '"a\\u0000b"', '"a\\nb"', '"\\ud800"', '"x."', '"' + "n" * 300 + '"', '"\U0001f600"', '""'),
)
VALUES = (
    *("null", "true", "false", "0", "-1", "1.5", "1e400", "-1e400", "NaN", "Infinity", "-Infinity", "1e308", "-1e308"),
    *("1e-320", "9223372036854775807", "9223372036854775808", "-9223372036854775809", "9" * 400, "9" * 5000),
    *("[]", "{}", "[[]]", "[null]", '{"a":1,"a":2}', "[1,2,3,4]", "[1e999,0,0,1]", '"1"', '"nan"', "[" * 3000),
    *("[" * 90 + "]" * 90, '{"a":' * 90 + "1" + "}" * 90, "[" + "0," * 3000 + "0]", "[" + "[]," * 3000 + "{}]"),
)
ENCODINGS = ("utf-8",) * 12 + ("utf-8-sig", "utf-16", "utf-32-le", "latin-1")
_MARK = "@hostile@"


@st.composite
def hostile_json(draw: Callable[..., object], seeds: Tuple[bytes, ...], begin: int = 0) -> bytes:
    """One of the seeds with one to four values, keys or rows that do not belong, all from one number.

    Args:
        draw: given by hypothesis.
        seeds: JSON texts.
        begin: lines before the JSON that stay as they are.
    """
    chance = random.Random(draw(st.integers(0, (1 << 64) - 1)))
    *head, text = chance.choice(seeds).split(b"\n", begin)
    value, fragments = json.loads(text), []  # type: Any, List[str]
    for _ in range(chance.choice((1, 1, 1, 2, 4))):
        value = _wounded(value, chance, fragments)
    text = json.dumps(value)
    for number, fragment in enumerate(fragments):
        text = text.replace(f'"{_MARK}{number}@"', fragment)
    encoded = text.encode(chance.choice(ENCODINGS), errors="replace")
    return b"\n".join([*head, encoded])


def _wounded(value: Any, chance: random.Random, fragments: List[str]) -> Any:
    def mark() -> str:
        fragments.append(chance.choice(chance.choice((NAMES, VALUES))))
        return f"{_MARK}{len(fragments) - 1}@"

    path = _places(value, chance)
    if not path:
        return mark()
    node, key = path[chance.randrange(len(path))]
    how = chance.randrange(8)
    if how < 5:
        node[key] = mark()
    elif how == 5:
        del node[key]
    elif how == 6 and isinstance(node, dict):
        node[chance.choice(("", "token", "x", "../x", str(key) + "x"))] = node.pop(key)
    elif isinstance(node, list):
        node.insert(chance.randrange(len(node) + 1), node[key])
    return value


def _places(value: Any, chance: random.Random) -> Sequence[Tuple[Any, Any]]:
    """(container, key) from the root down to a leaf."""
    found = []
    while isinstance(value, (dict, list)) and value:
        key = chance.choice(list(value)) if isinstance(value, dict) else chance.randrange(len(value))
        found.append((value, key))
        value = value[key]
    return found
