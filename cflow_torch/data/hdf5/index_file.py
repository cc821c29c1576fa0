"""OpenSceneFlow's index files (`index_total.pkl` and kin): pickles, read without running any code that they hold."""

from __future__ import annotations

import io
import pickle
from functools import lru_cache
from pathlib import Path
from typing import List, Sequence, Tuple

from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.names import is_stamp
from cflow_torch.data.paths import Place, as_path, read_bytes
from cflow_torch.data.pickles import load_plain
from cflow_torch.types import CFlowError

Entry = Tuple[str, int]
_MEND = "delete it: the index is then taken from the scenes themselves"


def read_index(path: Place) -> List[Entry]:
    """Entries (scene, time stamp) of an index file, in its order.

    Args:
        path: a pickle of a list of [scene, time stamp] or (scene, time stamp), both strings.

    Returns:
        (scene, time stamp as a number) of each entry.

    Raises:
        CFlowError: no such file, no pickle, a pickle with other contents or that names anything to run.
    """
    path = as_path(path)
    with file_errors(path, _MEND):
        return list(_entries(path, read_bytes(path)))


def write_index(path: Place, entries: Sequence[Entry]) -> None:
    """Write entries as OpenSceneFlow does: a pickled list of [scene, time stamp], both strings, atomically."""
    with atomic_file(path) as file:
        pickle.dump([[str(scene), str(stamp)] for scene, stamp in entries], file, protocol=4)


@lru_cache(maxsize=2)  # every scene of a folder asks for the same file
def _entries(path: Path, data: bytes) -> Sequence[Entry]:
    stored = load_plain(io.BytesIO(data))
    checked = []
    for entry in stored if isinstance(stored, list) else [None]:
        is_pair = isinstance(entry, (list, tuple)) and [type(part) for part in entry] == [str, str]
        if not is_pair or not is_stamp(entry[1]):
            raise CFlowError(f"{path} has an entry that is not [scene, time stamp], text and digits; {_MEND}")
        checked.append((entry[0], int(entry[1])))
    return tuple(checked)
