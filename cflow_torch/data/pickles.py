"""Read pickles of plain values without importing, calling or building anything that they name."""

from __future__ import annotations

import pickle
from typing import IO, Any

import numpy as np

# (module, name) pairs in pickles of NumPy arrays, and of data frames as pandas 1 and 2 write them.
_ALLOWED = {
    ("builtins", "slice"),
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    *((f"numpy.{core}.multiarray", name) for core in ("core", "_core") for name in ("_reconstruct", "scalar")),
    *((f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")),
    ("pandas._libs.internals", "_unpickle_block"),
    ("pandas.core.frame", "DataFrame"),
    ("pandas.core.indexes.base", "Index"),
    ("pandas.core.indexes.base", "_new_Index"),
    ("pandas.core.indexes.numeric", "Int64Index"),
    ("pandas.core.indexes.range", "RangeIndex"),
    ("pandas.core.internals.managers", "BlockManager"),
}


class Placeholder:
    """Stands for an object that a pickle wants to build: it keeps the `arguments` of the call and the `state`."""

    arguments: tuple[Any, ...]
    state: Any = None

    def __new__(cls, *arguments: Any) -> Placeholder:  # called however a pickle builds an object
        made = super().__new__(cls)
        made.arguments = arguments
        return made

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _ALLOWED:
            return Placeholder
        raise pickle.UnpicklingError(f"it names {module}.{name}, which is never executed")


def load_array(stream: IO[bytes]) -> np.ndarray:
    """Load a pickled array of numbers, texts or truth values. Any other pickle may raise any exception."""
    return _array(_Unpickler(stream).load())


def load_columns(stream: IO[bytes]) -> dict[str, np.ndarray]:
    """Load the columns of a data frame that pandas pickled, by name, without pandas. Errors as in `load_array`."""
    frame = _Unpickler(stream).load().state
    manager = frame["_mgr"] if "_mgr" in frame else frame["_data"]
    if manager.state is None:
        blocks, axes = [block.arguments[:2] for block in manager.arguments[0]], manager.arguments[1]
    else:  # pandas 1.2 and older
        layout = manager.state[3]["0.14.1"]
        blocks, axes = [(block["values"], block["mgr_locs"]) for block in layout["blocks"]], layout["axes"]
    names = _array(axes[0].arguments[1]["data"])
    columns: dict[str, np.ndarray] = {}
    for values, index in blocks:
        is_slice = index.state is None and len(index.arguments) == 3
        chosen = slice(*index.arguments) if is_slice else _array(index)
        columns.update(zip(names[chosen].tolist(), _array(values)))
    return columns


def _array(stored: Placeholder) -> np.ndarray:
    if stored.state is None:  # made by `_frombuffer`, in pickles of protocol 5
        data, dtype, shape, order = stored.arguments
    else:
        _, shape, dtype, is_fortran, data = stored.state
        order = "F" if is_fortran else "C"
    kind = np.dtype(dtype.state[1] + dtype.arguments[0])
    if not kind.hasobject:
        return np.frombuffer(data, kind).reshape(shape, order=order)
    # In arrays of objects, a placeholder is a string scalar of NumPy.
    texts = [v.arguments[1].decode("utf-32-le").rstrip("\0") if isinstance(v, Placeholder) else v for v in data]
    return np.array([*texts, None], object)[:-1].reshape(shape, order=order)
