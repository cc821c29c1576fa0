"""What a fuzzed process has done so far, kept where it outlives the process: a mapped file, a folder of findings."""

from __future__ import annotations

import hashlib
import mmap
import struct
import traceback
from pathlib import Path
from typing import Dict

COUNTS = ("cases", "result", "refused", "wrong", "most_bytes")
_FORMAT = f"<{len(COUNTS)}q"


class Ledger:
    """Counts of one campaign, shared by the process that is fuzzed and the one that watches it.

    Args:
        folder: of the campaign; made if it is missing, continued if it is there.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "findings").mkdir(parents=True, exist_ok=True)
        file = folder / "counts"
        if not file.exists():
            file.write_bytes(bytes(struct.calcsize(_FORMAT)))
        with open(file, "r+b") as opened:
            self._map = mmap.mmap(opened.fileno(), 0)

    def counts(self) -> Dict[str, int]:
        """Cases begun, results, refusals, other exceptions, largest growth of the process in bytes."""
        return dict(zip(COUNTS, struct.unpack(_FORMAT, self._map[:])))

    def add(self, name: str) -> None:
        """One more of them."""
        at = 8 * COUNTS.index(name)
        self._map[at : at + 8] = struct.pack("<q", struct.unpack("<q", self._map[at : at + 8])[0] + 1)

    def grown(self, num_bytes: int) -> None:
        """The process has grown by this much."""
        if num_bytes > self.counts()["most_bytes"]:
            at = 8 * COUNTS.index("most_bytes")
            self._map[at : at + 8] = struct.pack("<q", num_bytes)

    def finding(self, kind: str, data: bytes, text: str) -> None:
        """Keep a file that showed a fault, one of each place in the code."""
        name = f"{kind}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"
        if not (self.folder / "findings" / f"{name}.txt").exists():
            (self.folder / "findings" / f"{name}.bin").write_bytes(data)
            (self.folder / "findings" / f"{name}.txt").write_text(text, encoding="utf-8")

    def exception(self, error: BaseException, data: bytes) -> None:
        """Count and keep what was neither result nor refusal."""
        self.add("wrong")
        frames = traceback.extract_tb(error.__traceback__)
        places = "\n".join(f"{frame.filename}:{frame.lineno} {frame.name}" for frame in frames)
        self.finding(type(error).__name__, data, f"{type(error).__name__}\n{places}\n")
