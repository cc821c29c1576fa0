"""OpenSceneFlow's index files (`index_total.pkl` and kin): pickles, read without running any code that they hold."""

from __future__ import annotations

import io
import pickle
import pickletools
from functools import lru_cache
from typing import Any, List, Sequence, Tuple

from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.paths import Place, as_path, read_bytes
from cflow_torch.types import CFlowError

Entry = Tuple[str, int]
# Only what pickle needs for lists and tuples of strings. None of these looks up a name, calls or builds anything.
_HARMLESS = {
    *("PROTO", "FRAME", "STOP", "MARK", "POP", "POP_MARK"),
    *("EMPTY_LIST", "LIST", "APPEND", "APPENDS"),
    *("EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3"),
    *("UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "STRING", "BINSTRING", "SHORT_BINSTRING"),
    *("MEMOIZE", "PUT", "BINPUT", "LONG_BINPUT", "GET", "BINGET", "LONG_BINGET"),
}
MAX_BYTES = 1 << 25  # the largest public one has 93,547 entries, 6 MB
MAX_INSTRUCTIONS = 4_000_000  # of a pickle; an entry takes five to nine
_PUTS = {"PUT", "BINPUT", "LONG_BINPUT"}


class _NoNames(pickle.Unpickler):
    """The second lock: no class, no function, no object from outside."""

    def find_class(self, module: str, name: str) -> Any:
        raise pickle.UnpicklingError(f"it asks for {module}.{name}")

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError("it asks for a persistent object")


def read_index(path: Place) -> List[Entry]:
    """Entries (scene, time stamp) of an index file, in its order.

    Args:
        path: a pickle of a list of [scene, time stamp] or (scene, time stamp), both strings.

    Returns:
        (scene, time stamp as a number) of each entry.

    Convention:
        Before anything is loaded, every instruction of the pickle is looked at; one that does more than make lists,
        tuples and strings is refused, so a file cannot run code.

    Raises:
        CFlowError: no such file, no pickle, a pickle with other contents.
    """
    try:
        data = read_bytes(as_path(path), MAX_BYTES)
    except OSError as error:
        raise CFlowError(f"cannot read {path} ({error}); give an index file (.pkl)") from error
    return list(_entries(str(path), data))


def write_index(path: Place, entries: Sequence[Entry]) -> None:
    """Write entries as OpenSceneFlow does: a pickled list of [scene, time stamp], both strings, atomically."""
    with atomic_file(path) as file:
        pickle.dump([[str(scene), str(stamp)] for scene, stamp in entries], file, protocol=4)


@lru_cache(maxsize=2)  # every scene of a folder asks for the same file
def _entries(path: str, data: bytes) -> Tuple[Entry, ...]:
    mend = "delete it: the index is then taken from the scenes themselves"
    try:
        _refuse_code(data)
        entries = _NoNames(io.BytesIO(data), encoding="ascii").load()
    except CFlowError as error:
        raise CFlowError(f"{path} is not read: {error}; {mend}") from error
    except Exception as error:  # a damaged pickle makes the unpickler raise nearly anything
        raise CFlowError(f"{path} is no index file ({error}); {mend}") from error
    if not isinstance(entries, list):
        raise CFlowError(f"{path} holds {type(entries).__name__}, expected a list of [scene, time stamp]; {mend}")
    checked = []
    for entry in entries:
        if not isinstance(entry, (list, tuple)) or len(entry) != 2 or not all(isinstance(x, str) for x in entry):
            raise CFlowError(f"{path} has an entry that is not [scene, time stamp], both text; {mend}")
        scene, stamp = entry
        if not (stamp.isascii() and stamp.isdigit() and len(stamp) < 20):
            raise CFlowError(f"{path} has the time stamp {stamp[:30]!r}, expected digits; {mend}")
        checked.append((scene, int(stamp)))
    return tuple(checked)


def _refuse_code(data: bytes) -> None:
    for number, (opcode, argument, _) in enumerate(pickletools.genops(data)):
        if number >= MAX_INSTRUCTIONS:
            raise CFlowError(f"it has more than {MAX_INSTRUCTIONS} instructions")
        if opcode.name not in _HARMLESS:
            raise CFlowError(f"it has the instruction {opcode.name}; an index is made of lists, tuples and text only")
        # The unpickler makes room for the number it is told: a tiny file could ask for all memory.
        if opcode.name in _PUTS and isinstance(argument, int) and not 0 <= argument <= len(data):
            raise CFlowError(f"it numbers its parts up to {argument}, more than it can have")
