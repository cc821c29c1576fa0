"""Columns of numbers that are written as text inside cloud files."""

from __future__ import annotations

from typing import Sequence

import numpy as np

_LONGEST_WHOLE = 40  # characters; 64 bits need 20. Python takes quadratic time for whole numbers of any length


def text_column(words: Sequence[bytes], kind: np.dtype) -> np.ndarray:
    """Numbers of a column.

    Args:
        words: the N numbers as text.
        kind: float, or integer; then the text must be a whole number that fits.

    Returns:
        (N,) of that type, in the byte order of the machine.

    Raises:
        ValueError: a word is no such number.
    """
    kind = kind.newbyteorder("=")
    if kind.kind == "f":
        with np.errstate(over="ignore"):  # as in a binary file, what is too large is infinite
            return np.fromiter(map(float, words), np.float64, len(words)).astype(kind)
    if words and max(map(len, words)) > _LONGEST_WHOLE:
        raise ValueError(f"a whole number has up to {_LONGEST_WHOLE} digits")
    values, limits = [int(word) for word in words], np.iinfo(kind)
    if values and not (limits.min <= min(values) and max(values) <= limits.max):
        raise ValueError(f"a number lies outside {limits.min} ... {limits.max}")
    return np.array(values, dtype=kind)
