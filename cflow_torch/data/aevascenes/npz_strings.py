"""Arrays out of npz files, strings included, without ever running what a pickle asks for."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any, Optional

import numpy as np

from cflow_torch.data.aevascenes.pickled_strings import unpickle_strings
from cflow_torch.data.npy_file import open_member, read_array, read_header
from cflow_torch.data.paths import whole
from cflow_torch.types import CFlowError

_MISSING = "{} is missing; copy it from the data set"


def npz_contents(file: Path) -> Any:
    """`whole` of an archive of the data set."""
    try:
        return whole(file)
    except FileNotFoundError:
        raise CFlowError(_MISSING.format(file)) from None


def read_npz_member(file: Path, key: str, strings: bool = False, contents: Any = None) -> Optional[np.ndarray]:
    """One array of an npz file.

    Args:
        file: the archive.
        key: name of the array.
        strings: the array holds text, maybe as pickled Python strings (dtype object).
        contents: `npz_contents(file)`, where that was called already.

    Returns:
        The array; text as a NumPy string array of its stored shape. None where the archive has no such array.

    Raises:
        CFlowError: no such file, no npz, damaged, or an object array that holds anything but strings.
    """
    name = f"{key}.npy"
    try:
        with zipfile.ZipFile(npz_contents(file) if contents is None else contents) as archive:
            if name not in archive.namelist():
                return None
            size = archive.getinfo(name).file_size
            with open_member(archive, name, file) as member:
                header = read_header(member)
                if header.dtype.hasobject and strings:
                    return unpickle_strings(member, size, header.shape, file, key)
                member.seek(0)
                array = read_array(member, size, file, key)
    except CFlowError:
        raise
    except FileNotFoundError:
        raise CFlowError(_MISSING.format(file)) from None
    except Exception as error:  # a damaged file makes zipfile, NumPy and pickle raise nearly anything
        raise CFlowError(
            f"cannot read {key} of {file}: {str(error) or type(error).__name__}; it is damaged or no file of the data "
            "set, copy it again"
        ) from error
    if strings and array.dtype.kind != "U":
        raise CFlowError(f"{file}: {key} must hold strings, got {array.dtype}")
    return array
