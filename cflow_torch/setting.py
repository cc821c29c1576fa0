"""One setting: its default, meaning and bounds, and the check of a value."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import field, fields
from numbers import Integral, Real
from typing import Any, ClassVar, Mapping, Sequence, TypeVar

from cflow_torch.errors import CFlowError, near

# Whole numbers stay below this, because they are compared with tensors of int64 and of float64.
LIMIT = 2**53
AUTO = "auto"  # a value that we choose
Kind = TypeVar("Kind", bound="Settings")
# Names of types in error messages.
_NAMES = {int: "a whole number", float: "a number", bool: "True or False", tuple: "a list of numbers", str: "text"}


class Settings:
    """Base of frozen dataclasses whose fields are made by `setting`. A value that is not allowed is a `CFlowError`."""

    PREFIX: ClassVar[str] = ""  # of the names in messages, such as "engine."
    NAMED_BY: ClassVar[str] = ""  # the setting that names a class of `kinds`; "" = this class is the only one

    @classmethod
    def kinds(cls) -> Mapping[str, type[Settings]]:
        """Return the classes that a value of the setting `NAMED_BY` chooses."""
        return {}

    @classmethod
    def of(cls: type[Kind], values: Mapping[str, Any]) -> Kind:
        """Make settings from a dictionary. Missing ones get their defaults."""
        kind: Any = cls
        if not isinstance(values, Mapping):
            raise CFlowError(f"{cls.PREFIX.rstrip('.')}={values!r}: give its settings, {cls.PREFIX}NAME=VALUE")
        if cls.NAMED_BY:
            name: Any = values.get(cls.NAMED_BY)
            if name not in cls.kinds():
                known = ", ".join(map(repr, cls.kinds()))
                raise CFlowError(f"{cls.PREFIX}{cls.NAMED_BY}={name!r}: give one of {known}")
            kind = cls.kinds()[name]
        kind.check_names(list(values))
        return kind(**values)  # type: ignore[no-any-return]

    @classmethod
    def check_names(cls, names: Sequence[str]) -> None:
        """Raise a `CFlowError` that lists all settings, if one of the names is not a setting."""
        known = [f.name for f in fields(cls)]  # type: ignore[arg-type]
        unknown = [f"{cls.PREFIX}{name}{near(name, known)}" for name in sorted(names) if name not in known]
        if unknown:
            raise CFlowError(f"unknown setting {', '.join(unknown)}: the fields are {', '.join(known)}")

    def check(self) -> None:
        """Raise a `CFlowError` if values that are allowed one by one do not fit together."""

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]
            if "kind" in f.metadata:
                value = checked(f"{self.PREFIX}{f.name}", getattr(self, f.name), f.metadata)
                object.__setattr__(self, f.name, value)
        self.check()


def free_settings(kind: type[Settings]) -> list[str]:
    """Return the settings on whose values no result depends."""
    return [f.name for f in fields(kind) if f.metadata.get("free")]  # type: ignore[arg-type]


def setting(default: Any, help: str, *, kind: type | None = None, **limits: Any) -> Any:
    """Make a field of `Settings`: its default, its `help` (meaning and unit), and the `limits` of `bounds`.

    If `kind` is None, the value has the type of the default. If the default is None, None is allowed.
    """
    limits.setdefault("optional", default is None)
    return field(default=default, metadata={"help": help, **bounds(kind or type(default), **limits)})


def bounds(
    kind: type,
    *,
    optional: bool = False,
    low: float = -math.inf,
    above: float = -math.inf,
    high: float = math.inf,
    choices: tuple[Any, ...] = (),
    word: str | None = None,
    several: bool = False,
    free: bool = False,
) -> dict[str, Any]:
    """Describe the allowed values of a setting.

    `kind` is int, float, bool, str, tuple (of floats), object (any of the choices, or anything) or a class of
    `Settings`, whose values may be given as a dictionary. If `optional`, the value None is allowed. `low` and `high`
    are the smallest and the largest allowed value. `above` is a lower bound that is not allowed itself. `choices` are
    all allowed values, or empty if they cannot be listed. `word` is one more allowed value, such as "auto". If
    `several`, the value is a list of such values. If `free`, no result depends on the value.
    """
    return {
        "kind": kind,
        "optional": optional,
        "low": low,
        "above": above,
        "high": high,
        "choices": choices,
        "word": word,
        "several": several,
        "free": free,
    }


def describe_limits(limits: Mapping[str, Any]) -> str:
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
    text += f", or {limits['word']}" if limits["word"] else ""
    return text + (", or None (in YAML null)" if limits["optional"] else "")


def checked(name: str, value: Any, limits: Mapping[str, Any]) -> Any:
    """Return a value as int, float, bool, str, tuple, `Settings` or None. One that is not allowed is a `CFlowError`."""
    kind = limits["kind"]
    if limits["several"] and isinstance(value, (list, tuple)):
        return tuple(checked(name, one, {**limits, "several": False}) for one in value)
    if value is None and limits["optional"] or limits["word"] and value == limits["word"]:
        return value
    if issubclass(kind, Settings):
        return value if isinstance(value, kind) else kind.of(value)
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
    meaning = f": {limits['help']}" if kind is tuple else ""
    raise CFlowError(f"{name}={value!r}: give {describe_limits(limits)}{meaning}")
