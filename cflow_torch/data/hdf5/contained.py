"""What a scene may be made of: groups and arrays of plain numbers that lie in the file itself, checked before use.

HDF5 lets a file name data of other files (external and virtual datasets, links), claim any size, and hold types that
run through conversions of their own. A scene of OpenSceneFlow has none of that, so all of it is refused.
"""

from __future__ import annotations

import math
from contextlib import contextmanager
from typing import Any, Iterator, List, NamedTuple, Optional

import numpy as np

from cflow_torch.data.bounds import check_claim
from cflow_torch.data.hdf5.chunks import Stored, filters_of, read_chunks
from cflow_torch.data.hdf5.layout_message import RawFile, is_virtual, raw_file
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


def names(parent: Any, where: str) -> List[str]:
    """Names in a group, as stored.

    Raises:
        CFlowError: they cannot be read, or one is no text.
    """
    with hdf5_errors(f"{where} cannot be listed"):
        found = list(parent)
    strange = [name for name in found if not isinstance(name, str)]
    if strange:
        raise CFlowError(f"{where} has the name {strange[0]!r}, which is no UTF-8 text: rename it")
    return found


class Group(NamedTuple):
    """A group of a scene.

    Args:
        opened: h5py's group.
        raw: bytes of the file, None = not at hand.
    """

    opened: Any
    raw: Optional[RawFile]


def group(scene: Any, name: str, where: str) -> Optional[Group]:
    """The group of a name; None where there is none. No link is ever followed.

    Raises:
        CFlowError: the name stands for something else, or cannot be opened.
    """
    import h5py

    with hdf5_errors(f"{where} cannot be read as HDF5"):
        raw = raw_file(scene.id)
    opened = _opened(Group(scene, raw), name, where)
    if opened is None:
        return None
    if not isinstance(opened, h5py.h5g.GroupID):
        raise CFlowError(f"{where}: {name} is no group; {_MEND}")
    return Group(h5py.Group(opened), raw)


def array(parent: Group, name: str, where: str) -> Optional[Stored]:
    """An array of plain numbers in the file itself; None where there is none. Nothing of it is read.

    Raises:
        CFlowError: the name stands for something else, or cannot be opened.
    """
    import h5py

    opened = _opened(parent, name, where)
    if opened is None:
        return None
    what = f"{where}: {name}"
    if not isinstance(opened, h5py.h5d.DatasetID):
        raise CFlowError(f"{what} is no array; {_MEND}")
    with hdf5_errors(f"{what} cannot be opened"):
        plan = opened.get_create_plist()
        layout = plan.get_layout()
        if layout == h5py.h5d.VIRTUAL or plan.get_external_count():
            raise CFlowError(f"{what} lies in other files, which are not read; {_MEND}")
        check_numbers(opened, what)
        filters = filters_of(plan, what)
        shape = opened.shape
        if shape is None:
            raise CFlowError(f"{what} holds nothing at all; {_MEND}")
        return Stored(opened, shape, opened.dtype, plan.get_chunk() if layout == h5py.h5d.CHUNKED else None, filters)


def _opened(parent: Group, name: str, where: str) -> Optional[Any]:
    import h5py

    if not name or "/" in name or name == ".":
        return None
    with hdf5_errors(f"{where}: cannot open {name}"):
        stored = name.encode()
        links = parent.opened.id.links  # `in` and `get` of h5py open what a link names, be it a file elsewhere
        if not links.exists(stored):
            return None
        link = links.get_info(stored)
        if link.type != h5py.h5l.TYPE_HARD:
            raise CFlowError(f"{where}: {name} is a link, which is not followed; {_MEND}")
        if parent.raw is not None and is_virtual(parent.raw, link.u):
            raise CFlowError(f"{where}: {name} lies in other files, which are not read; {_MEND}")
        return h5py.h5o.open(parent.opened.id, stored)


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


def read(stored: Stored, what: str, becomes: Any = None) -> np.ndarray:
    """All values of an array.

    Args:
        stored: from `array`.
        what: for the message.
        becomes: dtype that the caller turns it into, None = the stored one.

    Raises:
        CFlowError: it claims more than the file has, or than may be read at once, or cannot be read.
    """
    import h5py

    with hdf5_errors(f"{what} cannot be read"):
        count, here = math.prod(stored.shape), stored.dtype.itemsize
        check_claim(what, "its shape", count * max(here, np.dtype(becomes or stored.dtype).itemsize))
        if count and stored.chunk is not None:
            return read_chunks(stored, what)
        there = stored.opened.get_storage_size() if count else 0
        if there < count * here:
            raise CFlowError(f"{what} claims {count * here} bytes, {there} are stored; copy the scene again")
        values = np.empty(stored.shape, stored.dtype)
        if count:
            stored.opened.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
        return values
