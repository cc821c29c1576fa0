"""What a scene may be made of: groups and arrays of plain numbers that lie in the file itself, checked before use.

HDF5 lets a file name data of other files (external and virtual datasets, links), claim any size, and hold types that
run through conversions of their own. A scene of OpenSceneFlow has none of that, so all of it is refused.
"""

from __future__ import annotations

from contextlib import contextmanager
from typing import Any, Iterator, List, Optional, Tuple

import numpy as np

from cflow_torch.data.bounds import check_claim
from cflow_torch.data.hdf5.chunks import filters_of, read_chunks
from cflow_torch.types import CFlowError

_MEND = "write the scene anew: groups with arrays of plain numbers in the file itself"
_LARGEST_NUMBER = 8  # bytes


@contextmanager
def hdf5_errors(what: str, mend: str = "copy the scene again") -> Iterator[None]:
    """Turns what h5py raises into the one error; `what` begins its message, `mend` ends it."""
    try:
        yield
    except (CFlowError, MemoryError):
        raise
    except Exception as error:  # a damaged file makes h5py raise nearly anything
        raise CFlowError(f"{what} ({type(error).__name__}: {error}); {mend}") from error


def names(group: Any, where: str) -> List[str]:
    """Names in a group, as stored.

    Raises:
        CFlowError: they cannot be read, or one is no text.
    """
    with hdf5_errors(f"{where} cannot be listed"):
        found = list(group)
    strange = [name for name in found if not isinstance(name, str)]
    if strange:
        raise CFlowError(f"{where} has the name {strange[0]!r}, which is no UTF-8 text: rename it")
    return found


def member(group: Any, name: str, where: str) -> Optional[Any]:
    """The group or dataset of a name; None where there is none. No link is ever followed.

    Raises:
        CFlowError: the name stands for something elsewhere, or cannot be opened.
    """
    import h5py

    if not name or "/" in name or name == ".":
        return None
    with hdf5_errors(f"{where}: cannot open {name}"):
        stored = name.encode()
        links = group.id.links  # `in` and `get` of h5py open what a link names, be it a file elsewhere
        if not links.exists(stored):
            return None
        if links.get_info(stored).type != h5py.h5l.TYPE_HARD:
            raise CFlowError(f"{where}: {name} is a link, which is not followed; {_MEND}")
        opened = h5py.h5o.open(group.id, stored)
        if isinstance(opened, h5py.h5g.GroupID):
            return h5py.Group(opened)
        return h5py.Dataset(opened) if isinstance(opened, h5py.h5d.DatasetID) else opened


def array(group: Any, name: str, where: str) -> Optional[Any]:
    """A dataset of plain numbers in the file itself; None where there is none. Nothing of it is read.

    Raises:
        CFlowError: it is something else.
    """
    import h5py

    found = member(group, name, where)
    if found is None:
        return None
    what = f"{where}: {name}"
    if not isinstance(found, h5py.Dataset):
        raise CFlowError(f"{what} is a {type(found).__name__}, expected an array; {_MEND}")
    with hdf5_errors(f"{what} cannot be opened"):
        plan = found.id.get_create_plist()
        if plan.get_layout() == h5py.h5d.VIRTUAL or plan.get_external_count():
            raise CFlowError(f"{what} lies in other files, which are not read; {_MEND}")
        check_numbers(found.id, what)
        filters_of(plan, what)
        if found.shape is None:
            raise CFlowError(f"{what} holds nothing at all; {_MEND}")
    return found


def check_numbers(opened: Any, what: str) -> None:
    """Refuse types other than bool, integers and floats just as NumPy has them.

    Args:
        opened: h5py's low-level dataset or attribute.
        what: for the message.

    Raises:
        CFlowError: as said.
    """
    import h5py

    kind = opened.get_type()
    if kind.get_class() in (h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.ENUM) and kind.get_size() <= _LARGEST_NUMBER:
        dtype = opened.dtype
        if dtype.kind in "biuf" and dtype.metadata is None and kind == h5py.h5t.py_create(dtype, logical=True):
            return
    raise CFlowError(f"{what} is no array of bool, integers or floats; {_MEND}")


def read(dataset: Any, what: str, becomes: Any = None) -> np.ndarray:
    """All values of what `array` gave.

    Args:
        dataset: from `array`.
        what: for the message.
        becomes: dtype that the caller turns it into, None = the stored one.

    Raises:
        CFlowError: it claims more than the file has, or than may be read at once, or cannot be read.
    """
    import h5py

    with hdf5_errors(f"{what} cannot be read"):
        shape: Tuple[int, ...] = dataset.shape
        count = 1
        for size in shape:
            count *= size
        here = dataset.dtype.itemsize
        check_claim(what, "its shape", count * max(here, np.dtype(becomes or dataset.dtype).itemsize))
        if count == 0:
            return np.empty(shape, dataset.dtype)
        if dataset.id.get_create_plist().get_layout() == h5py.h5d.CHUNKED:
            return read_chunks(dataset, what)
        if dataset.id.get_storage_size() < count * here:
            raise CFlowError(
                f"{what} claims {count * here} bytes, {dataset.id.get_storage_size()} are stored; copy the scene again"
            )
        return np.asarray(dataset[()])
