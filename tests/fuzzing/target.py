"""One reader to be fuzzed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Callable, Optional, Sequence

from hypothesis.strategies import SearchStrategy

from fuzzing.mutation import damaged


@dataclass(frozen=True)
class Target:
    """A reader, whole files for it, and how hostile ones are made.

    Args:
        name: in tables and on the command line.
        file: name, in a folder, of the file that the hostile bytes become.
        seeds: () -> whole small files (at most some kilobytes each), each of which `read` must take.
        read: (folder) -> reads all that the reader can give of `folder/file`, as a user would.
        prepare: (folder) -> writes what must lie around the file; called once in an empty folder.
        crafted: bytes of files that are well formed outside and hostile inside (hostile shapes, counts, types, values).
        tokens: pieces that are copied into files (key words of the format).
        needs: module without which it is skipped.
    """

    name: str
    file: str
    seeds: Callable[[], Sequence[bytes]]
    read: Callable[[Path], object]
    prepare: Callable[[Path], None] = lambda folder: None
    crafted: Optional[SearchStrategy[bytes]] = None
    tokens: Sequence[bytes] = ()
    needs: str = ""

    def cases(self) -> SearchStrategy[bytes]:
        """Hostile files: half of them damaged whole ones, half crafted."""
        broken = damaged(tuple(self.seeds()), tuple(self.tokens))
        return broken if self.crafted is None else broken | self.crafted
