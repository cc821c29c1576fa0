"""Arrow files make no Python objects: pyarrow before 14.0.1 unpickles what a column says its type is."""

from __future__ import annotations

import re
from typing import Any

import pyarrow as pa

_PICKLED = "arrow.py_extension_type"  # CVE-2023-47248


class _Stored(pa.ExtensionType):  # type: ignore[misc]
    """Stands for such a type: what is stored, and nothing else."""

    def __init__(self, storage: pa.DataType) -> None:
        super().__init__(storage, _PICKLED)

    def __arrow_ext_serialize__(self) -> bytes:
        return b""

    @classmethod
    def __arrow_ext_deserialize__(cls, storage: pa.DataType, serialized: bytes) -> Any:
        return cls(storage)


def refuse_pickled_types() -> None:
    """From now on nothing is unpickled that a file of Arrow (feather, parquet) names as the type of a column.

    Convention: for the whole process, which needs no such types; newer versions of pyarrow do so by themselves.
    """
    version = tuple(int(number) for number in re.findall(r"\d+", pa.__version__)[:3])
    if version < (14, 0, 1):
        pa.unregister_extension_type(_PICKLED)
        pa.register_extension_type(_Stored(pa.null()))
