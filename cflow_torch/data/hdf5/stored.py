"""What lies in the scene's own file. HDF5 lets a file name data of other files; a scene of OpenSceneFlow never does."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from cflow_torch.data.files import file_errors
from cflow_torch.data.paths import PathLike, source_for_random_access
from cflow_torch.types import CFlowError

_HINT = "write the scene anew: groups with arrays of plain numbers in the file itself"
scene_errors = partial(file_errors, hint="copy or write the scene again")


def import_h5py() -> Any:
    """The package h5py.

    Raises:
        CFlowError: it is missing.
    """
    try:
        import h5py
    except ImportError:
        raise CFlowError("HDF5 scenes need h5py: pip install h5py") from None
    return h5py


def open_scene(file: Path) -> Any:
    """A scene, open for reading.

    Raises:
        CFlowError: h5py is missing; no such file, or no HDF5.
    """
    h5py = import_h5py()
    with scene_errors(file):
        return h5py.File(source_for_random_access(file), "r")


def member(group: Any, name: str, where: PathLike) -> Any | None:
    """What a group of h5py holds under a name, a group or an array of numbers; None where it holds nothing.

    Args:
        group: the group, or the file.
        name: in the group itself.
        where: begins the message.

    Raises:
        CFlowError: it is a link or lies in another file, none of which is ever opened; it is no array of plain
            numbers; or it cannot be opened.
    """
    h5py = import_h5py()
    if not name or "/" in name or name == ".":
        return None
    with scene_errors(f"{where}: {name}"):
        link = group.get(name, getlink=True)
        if link is None:
            return None
        is_own = isinstance(link, h5py.HardLink)  # else `group[name]` opens what it names, be it a file elsewhere
        found: Any = group[name] if is_own else None
        is_array = isinstance(found, h5py.Dataset)
        if not is_own or (is_array and (found.is_virtual or found.external)):
            raise CFlowError(f"{where}: {name} is a link or lies in other files, which are not read; {_HINT}")
        if is_array and (found.shape is None or found.dtype.kind not in "biuf"):
            raise CFlowError(f"{where}: {name} is no array of bool, integers or floats; {_HINT}")
        return found
