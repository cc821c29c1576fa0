"""One setting: its default, meaning and bounds, and the check of a value."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import field
from numbers import Integral, Real
from typing import Any, Mapping

from cflow_torch.errors import CFlowError

# Whole numbers stay below this, because they are compared with tensors of int64 and of float64.
LIMIT = 2**53
# Names of types in error messages.
_NAMES = {int: "a whole number", float: "a number", bool: "True or False", tuple: "a list of numbers"}


def setting(default: Any, help: str, *, kind: type | None = None, **limits: Any) -> Any:
    """Make a field of a `Config`: its default, its `help` (meaning and unit), and the `limits` of `bounds`.

    If `kind` is None, the value has the type of the default.
    """
    return field(default=default, metadata={"help": help, **bounds(kind or type(default), **limits)})


def bounds(
    kind: type,
    *,
    optional: bool = False,
    low: float = -math.inf,
    above: float = -math.inf,
    high: float = math.inf,
    choices: tuple[Any, ...] = (),
) -> dict[str, Any]:
    """Describe the allowed values of a setting.

    `kind` is int, float, bool, str, tuple (of floats) or object (any of the choices). If `optional`, the value None is
    allowed. `low` and `high` are the smallest and the largest allowed value. `above` is a lower bound that is not
    allowed itself. `choices` are all allowed values, or empty if they cannot be listed.
    """
    return {"kind": kind, "optional": optional, "low": low, "above": above, "high": high, "choices": choices}


def describe(limits: Mapping[str, Any]) -> str:
    """The allowed values in words: "a number of at least 1 and of at most 2, or None"."""
    low = limits["low"]
    above = limits["above"]
    high = limits["high"]
    if limits["choices"]:
        return f"one of {', '.join(map(repr, limits['choices']))}"
    text = _NAMES[limits["kind"]]
    text += f" of at least {low:g}" if low > -math.inf else ""
    text += f" above {above:g}" if above > -math.inf else ""
    text += f"{' and' if max(low, above) > -math.inf else ''} of at most {high:g}" if high < math.inf else ""
    return text + (", or None" if limits["optional"] else "")


def checked(name: str, value: Any, limits: Mapping[str, Any]) -> Any:
    """Return a value as int, float, bool, str, tuple or None. A value that is not allowed raises a `CFlowError`."""
    kind = limits["kind"]
    if value is None and limits["optional"]:
        return None
    with suppress(TypeError, ValueError, OverflowError):
        if kind is tuple:
            return tuple(float(v) for v in value)
        is_allowed = isinstance(value, {int: Integral, float: Real}.get(kind, kind))
        if kind in (int, float):
            is_in_bounds = limits["low"] <= value <= limits["high"] and value > limits["above"]
            is_small = isinstance(value, float) or abs(value) < LIMIT
            is_allowed &= is_in_bounds and is_small and not isinstance(value, bool)
        if limits["choices"]:
            is_allowed &= value in limits["choices"]
        if is_allowed:
            return value if kind is object else kind(value)
    raise CFlowError(f"{name}={value!r}: give {describe(limits)}")
