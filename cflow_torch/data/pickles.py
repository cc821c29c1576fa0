"""Pickles of plain values, read without importing, calling or building anything that they name."""

from __future__ import annotations

import pickle
from typing import IO, Any, Collection, Tuple

Name = Tuple[str, str]  # module, name in it
_ARRAYS = ("numpy.core.multiarray", "numpy._core.multiarray")
NUMPY_ARRAYS: Collection[Name] = frozenset(
    [("numpy", "ndarray"), ("numpy", "dtype")]
    + [(module, name) for module in _ARRAYS for name in ("_reconstruct", "scalar")]
)
"""What the pickle of a NumPy array of strings names."""


class StandIn:
    """Stands for an object that a pickle wants to build: keeps what it would be made of, and does nothing.

    Attributes:
        parts: arguments of the call.
        state: what its `__setstate__` would get; None = nothing.
    """

    def __init__(self, *parts: Any) -> None:
        self.parts = parts
        self.state: Any = None

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Unpickler(pickle.Unpickler):
    """Makes plain values (numbers, texts, lists, tuples and the like), and stand-ins for names that are allowed."""

    def __init__(self, stream: IO[bytes], allowed: Collection[Name]) -> None:
        super().__init__(stream, encoding="ascii")
        self._allowed = allowed

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in self._allowed:
            return StandIn
        raise pickle.UnpicklingError(f"it asks for {module}.{name}, which is never run")


def load_plain(stream: IO[bytes], allowed: Collection[Name] = ()) -> Any:
    """What a pickle holds.

    Args:
        stream: stands where the pickle begins.
        allowed: (module, name) pairs that a `StandIn` takes the place of. Every other name is refused.

    Raises:
        Exception: whatever the unpickler raises for a damaged pickle, or one that names something else.
    """
    return _Unpickler(stream, allowed).load()
