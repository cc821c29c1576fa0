"""Arrays of strings that NumPy pickled, without ever running what a pickle asks for."""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import re
from typing import IO, Any, Tuple

import numpy as np

from cflow_torch.data.bounds import check_claim

# Instructions of a pickle that NumPy needs for an array of strings, and how many bytes of argument each has.
_ARGUMENTS = {
    **dict.fromkeys(b"N\x88\x89]ae(t\x85\x86\x87Rb\x93\x94", 0),  # values, lists, tuples; stand-ins called and filled
    **dict(zip(b"KMJ\x80\x95qhj", (1, 2, 4, 1, 8, 1, 1, 4))),  # numbers, version, frame; remember, and recall
}
_COUNTED = dict(zip(b"XB\x8cC", (4, 4, 1, 1)))  # strings and bytes: as many bytes tell how long they are
_STOP, _GLOBAL, _CALL = b".cR"
# Nearly all of a pickle: strings of up to 48 bytes, that they are remembered, and that they come again. A number to
# remember by is below 2^22: the unpickler makes room for as many at once.
_TEXTS = [(re.escape(bytes([size])), size) for size in range(1, 49)]
_RUN = re.compile(
    rb"(?:h.|q.|r..[\0-\x3f]\0|\x94|"  # alternatives that begin with one byte each: quick to leave
    + b"X(?:%s)|" % b"|".join(b"%s\0\0\0.{%d}" % text for text in _TEXTS)
    + b"\x8c(?:%s)|" % b"|".join(b"%s.{%d}" % text for text in _TEXTS)
    + rb"j.{4}|e|\(|\x95.{8}){1,1000}",
    re.DOTALL,
)
_LONGEST_SCALAR = 256  # bytes, 64 characters; the same bytes can be asked for again and again
_MOST_STEPS = 1 << 18  # instructions outside of runs: a quarter of a second
# Bytes of memory that a byte of a run may take at most, any other instruction, and one that makes a scalar.
_RUN_COST, _STEP_COST, _CALL_COST = 16, 80, 400


class _Type:
    """Stands for NumPy's dtype in a pickle: keeps its name, does nothing."""

    __slots__ = ("name",)

    def __init__(self, name: str = "", *_: Any) -> None:
        self.name = name

    def __setstate__(self, _: Any) -> None:
        """The rest of a dtype does not matter here."""


class _Array:
    """Stands for an ndarray in a pickle: keeps its shape and list of elements."""

    __slots__ = ("elements", "is_fortran", "shape")

    def __setstate__(self, state: Any) -> None:
        _, self.shape, _, self.is_fortran, self.elements = state


def _array(*_: Any) -> _Array:
    return _Array()


def _string(kind: Any, data: Any) -> str:
    """A NumPy string scalar."""
    named = isinstance(kind, _Type) and isinstance(kind.name, str) and kind.name.startswith("U")
    if not named or not isinstance(data, bytes) or len(data) > _LONGEST_SCALAR:
        raise pickle.UnpicklingError("a scalar that is no string, or a long one")
    return data.decode("utf-32-le").rstrip("\0")


class _StringUnpickler(pickle.Unpickler):
    """Makes strings, numbers, tuples and lists; what NumPy needs around them is replaced by harmless stand-ins."""

    def find_class(self, module: str, name: str) -> Any:
        if module in ("numpy.core.multiarray", "numpy._core.multiarray"):
            if name == "_reconstruct":
                return _array
            if name == "scalar":
                return _string
        if module == "numpy" and name in ("ndarray", "dtype"):
            return _Type
        raise pickle.UnpicklingError(f"it asks for {module}.{name}")

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError("it asks for a persistent object")


def unpickle_strings(stream: IO[bytes], size: int, shape: Tuple[int, ...], file: Any, what: str) -> np.ndarray:
    """Strings of a pickled array.

    Args:
        stream: where the pickle begins.
        size: bytes that are in it, at most.
        shape: that the array must have.
        file, what: for the messages.

    Returns:
        A NumPy string array of that shape.

    Convention:
        Before anything is loaded, every instruction of the pickle is looked at: those that NumPy does not use for
        arrays of strings are refused, and so is what would take too much memory (see `check_claim`).

    Raises:
        CFlowError: it would take too much memory.
        Exception: whatever the unpickler raises for a damaged pickle, and for one that holds anything but strings.

    Cost: 0.1 microseconds a string for looking, 0.2 for loading.
    """
    check_claim(file, what, _RUN_COST * size)
    data = stream.read()
    check_claim(file, what, _RUN_COST * len(data) + _cost_of_steps(data))
    loaded = _StringUnpickler(io.BytesIO(data)).load()
    if not isinstance(loaded, _Array) or loaded.shape != shape or not isinstance(loaded.elements, list):
        raise pickle.UnpicklingError("it holds no array of strings")
    elements, count = loaded.elements, math.prod(shape)
    if set(map(type, elements)) - {str} or len(elements) != count:
        strangers = sum(type(element) is not str for element in elements)
        raise pickle.UnpicklingError(f"it holds {len(elements)} elements, {strangers} are no strings")
    number = {text: i for i, text in enumerate(dict.fromkeys(elements))}
    check_claim(file, what, 4 * (count + len(number)) * max(map(len, number), default=0))
    table = np.array(list(number), dtype=str)
    rows = np.fromiter(map(number.__getitem__, elements), np.int64, count)
    return table[rows].reshape(shape, order="F" if loaded.is_fortran else "C")


def _cost_of_steps(data: bytes) -> int:
    """Bytes of memory that instructions outside of runs take, at most; refuses those that arrays of strings lack."""
    at = cost = 0
    for _ in range(_MOST_STEPS):
        run = _RUN.match(data, at)
        if run is not None:
            at = run.end()
        if at >= len(data):
            raise pickle.UnpicklingError("it ends early")
        code = data[at]
        cost += _CALL_COST if code == _CALL else _STEP_COST
        at += 1
        if code in _ARGUMENTS:
            at += _ARGUMENTS[code]
        elif code in _COUNTED:
            size = _COUNTED[code]
            at += size + int.from_bytes(data[at : at + size], "little")
        elif code == _GLOBAL:
            at = data.index(b"\n", data.index(b"\n", at) + 1) + 1
        elif code == _STOP:
            return cost
        else:
            name = {known.code: known.name for known in pickletools.opcodes}.get(chr(code), code)
            raise pickle.UnpicklingError(f"it has the instruction {name}, which an array of strings does not need")
    raise pickle.UnpicklingError(f"it has more than {_MOST_STEPS} instructions besides strings")
