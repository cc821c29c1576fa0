"""Whether a dataset is a virtual one, told from its header's bytes.

libhdf5 reads what a virtual dataset is made of as soon as it is opened, and some damaged lists of that make it loop for
ever (seen with 2.0.0). So it must be known before. What cannot be made out here is left to libhdf5.
"""

from __future__ import annotations

import os
from typing import Any, Iterator, NamedTuple, Optional, Tuple

_LAYOUT, _CONTINUATION = 0x08, 0x10  # types of messages
_VIRTUAL = 3
_HEAD, _MOST_BYTES, _MOST_BLOCKS = 64, 1 << 16, 64


class RawFile(NamedTuple):
    """A file's bytes beside libhdf5.

    Args:
        handle: of the operating system.
        start: bytes before the part that is HDF5.
    """

    handle: int
    start: int


def raw_file(file: Any) -> Optional[RawFile]:
    """The bytes of h5py's low-level file.

    Returns:
        None for files that are not on this machine, and on Windows, which cannot read beside libhdf5 without moving its
        place in the file: there virtual data are told only after they are opened.
    """
    import h5py

    if not hasattr(os, "pread") or file.get_access_plist().get_driver() != h5py.h5fd.SEC2:
        return None
    return RawFile(file.get_vfd_handle(), file.get_create_plist().get_userblock())


def is_virtual(raw: RawFile, address: int) -> bool:
    """Whether the header at an address says so.

    Convention: sizes of 8 bytes for addresses and lengths, as every scene has them.
    """
    handle, start = raw
    head = os.pread(handle, _HEAD, start + address)
    if len(head) < _HEAD // 4:
        return False
    if head[:4] == b"OHDR":
        fixed = 6 + (16 if head[5] & 0x20 else 0) + (4 if head[5] & 0x10 else 0)
        width = 1 << (head[5] & 3)
        blocks = [(address + fixed + width, int.from_bytes(head[fixed : fixed + width], "little"))]
        message_head = 6 if head[5] & 4 else 4
    else:
        blocks = [(address + 16, int.from_bytes(head[8:12], "little"))]
        message_head = 8
    for number, (at, size) in enumerate(blocks):  # grows on the way
        if number == _MOST_BLOCKS or start + at >= 1 << 63:
            break
        for kind, data in _messages(os.pread(handle, min(size, _MOST_BYTES), start + at), message_head):
            if kind == _LAYOUT and len(data) > 1 and data[0] > 3 and data[1] == _VIRTUAL:
                return True
            if kind == _CONTINUATION:
                blocks.append((int.from_bytes(data[:8], "little"), int.from_bytes(data[8:16], "little")))
    return False


def _messages(block: bytes, head: int) -> Iterator[Tuple[int, bytes]]:
    """Type and contents of each message; heads of 8 bytes are those of the first version."""
    at = 4 if block[:4] == b"OCHK" else 0
    while at + head <= len(block):
        kind = int.from_bytes(block[at : at + 2], "little") if head == 8 else block[at]
        size = int.from_bytes(block[at + 2 : at + 4] if head == 8 else block[at + 1 : at + 3], "little")
        yield kind, block[at + head : at + head + size]
        at += head + size
