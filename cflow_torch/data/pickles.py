"""Read pickles of plain values without importing, calling or building anything that they name."""

from __future__ import annotations

import pickle
from typing import IO, Any, Tuple

import numpy as np

Name = Tuple[str, str]  # module, name in it
_NUMPY = (("multiarray", "_reconstruct"), ("multiarray", "scalar"), ("numeric", "_frombuffer"))
NUMPY_ARRAYS: frozenset[Name] = frozenset(
    [("numpy", "ndarray"), ("numpy", "dtype")]
    + [(f"numpy.{core}.{module}", name) for core in ("core", "_core") for module, name in _NUMPY]
)
"""Names in the pickle of a NumPy array."""
DATA_FRAMES: frozenset[Name] = NUMPY_ARRAYS | {
    ("builtins", "slice"),
    ("pandas._libs.internals", "_unpickle_block"),
    ("pandas.core.frame", "DataFrame"),
    ("pandas.core.indexes.base", "Index"),
    ("pandas.core.indexes.base", "_new_Index"),
    ("pandas.core.indexes.numeric", "Int64Index"),
    ("pandas.core.indexes.range", "RangeIndex"),
    ("pandas.core.internals.managers", "BlockManager"),
}
"""Names in the pickle of a data frame, as pandas 1 and 2 write it."""


class Placeholder:
    """Stands for an object that a pickle wants to build: it keeps what the object would be made of, and does nothing.

    Attributes:
        parts: arguments of the call.
        state: argument of `__setstate__`; None = none.
    """

    parts: tuple[Any, ...]
    state: Any = None

    def __new__(cls, *parts: Any) -> Placeholder:  # called however a pickle builds an object
        made = super().__new__(cls)
        made.parts = parts
        return made

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Unpickler(pickle.Unpickler):
    """Builds plain values (numbers, texts, lists, tuples and the like), and placeholders for allowed names."""

    def __init__(self, stream: IO[bytes], allowed: frozenset[Name]) -> None:
        super().__init__(stream, encoding="ascii")
        self._allowed = allowed

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in self._allowed:
            return Placeholder
        raise pickle.UnpicklingError(f"it names {module}.{name}, which is never executed")


def load_plain(stream: IO[bytes], allowed: frozenset[Name] = frozenset()) -> Any:
    """Load a pickle.

    Args:
        stream: positioned where the pickle begins.
        allowed: (module, name) pairs that a `Placeholder` replaces. Every other name is refused.

    Raises:
        Exception: whatever the unpickler raises for a damaged pickle, or for one that names something else.
    """
    return _Unpickler(stream, allowed).load()


def array_of(placeholder: Placeholder) -> np.ndarray:
    """Return the array that a placeholder stands for, of numbers, texts, truth values or objects.

    Raises:
        Exception: nearly any, if it stands for something else.
    """
    if placeholder.state is None:  # `_frombuffer`, of pickles of protocol 5
        data, dtype, shape, order = placeholder.parts
    else:
        _, shape, dtype, is_fortran, data = placeholder.state
        order = "F" if is_fortran else "C"
    kind = np.dtype(dtype.state[1] + dtype.parts[0])
    values = np.array(data + [None], object)[:-1] if kind.hasobject else np.frombuffer(data, kind)
    return values.reshape(shape, order=order)


def load_columns(stream: IO[bytes]) -> dict[str, np.ndarray]:
    """Load the columns of a data frame that pandas pickled, by name, without pandas.

    Raises:
        Exception: as `load_plain` and `array_of`.
    """
    frame = load_plain(stream, DATA_FRAMES).state
    manager = frame["_mgr"] if "_mgr" in frame else frame["_data"]
    if manager.state is None:
        blocks, axes = [block.parts[:2] for block in manager.parts[0]], manager.parts[1]
    else:  # pandas 1.2 and older
        layout = manager.state[3]["0.14.1"]
        blocks, axes = [(block["values"], block["mgr_locs"]) for block in layout["blocks"]], layout["axes"]
    names = array_of(axes[0].parts[1]["data"])
    columns: dict[str, np.ndarray] = {}
    for values, index in blocks:
        is_slice = index.state is None and len(index.parts) == 3
        chosen = slice(*index.parts) if is_slice else array_of(index)
        columns.update(zip(names[chosen].tolist(), array_of(values)))
    return columns
