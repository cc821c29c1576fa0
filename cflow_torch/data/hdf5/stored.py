"""Access to the contents of a scene's own file. HDF5 allows links to other files; scenes of OpenSceneFlow have none."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from cflow_torch.data.files import file_errors
from cflow_torch.data.paths import PathLike, source_for_random_access
from cflow_torch.types import CFlowError

_HINT = "write the scene again, as groups with arrays of plain numbers in the file itself"
scene_errors = partial(file_errors, hint="copy or write the scene again")


def import_h5py() -> Any:
    """Import h5py; a missing package is a `CFlowError`."""
    try:
        import h5py
    except ImportError:
        raise CFlowError("HDF5 scenes need h5py: pip install h5py") from None
    return h5py


def open_scene(file: Path) -> Any:
    """Open a scene for reading; a missing package or file, or a file that is not HDF5, is a `CFlowError`."""
    h5py = import_h5py()
    with scene_errors(file):
        return h5py.File(source_for_random_access(file), "r")


def member(group: Any, name: str, where: PathLike) -> Any | None:
    """Return a group or an array of numbers from a group of h5py; None if there is nothing of that name.

    Args:
        group: the group, or the file.
        name: in the group itself.
        where: begins the message.

    Raises:
        CFlowError: it is a link or lies in another file, which is never opened; it is not an array of plain numbers; or
            it cannot be opened.
    """
    h5py = import_h5py()
    if not name or "/" in name or name == ".":
        return None
    with scene_errors(f"{where}: {name}"):
        link = group.get(name, getlink=True)
        if link is None:
            return None
        # `group[name]` of a link could open a file elsewhere.
        found: Any = group[name] if isinstance(link, h5py.HardLink) else None
        is_array = isinstance(found, h5py.Dataset)
        if found is None or (is_array and (found.is_virtual or found.external)):
            raise CFlowError(f"{where}: {name} is a link or lies in other files, which are not read; {_HINT}")
        if is_array and (found.shape is None or found.dtype.kind not in "biuf"):
            raise CFlowError(f"{where}: {name} is not an array of bool, integers or floats; {_HINT}")
        return found
