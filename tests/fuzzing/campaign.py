"""A long run over one reader: a watched process, restarted after whatever ends it."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Dict, List

from fuzzing.ledger import Ledger
from fuzzing.target import Target

TESTS = Path(__file__).resolve().parents[2]
HANGS = 20.0  # seconds of the processor for one small file; a machine may be busy with something else
STANDS_STILL = 300.0  # seconds of the clock
MOST_ENDS = 200  # crashes and hangs after which a campaign is given up


@dataclass(frozen=True)
class Report:
    """What came of a campaign: cases begun; those read, refused, ended by another exception; ends of the process."""

    target: str
    engine: str
    cases: int
    result: int
    refused: int
    wrong: int
    crashes: int
    hangs: int
    most_bytes: int
    seconds: float
    findings: List[str]


def run(target: Target, engine: str, cases: int, seed: int, folder: Path) -> Report:
    """Feed `cases` hostile files to a reader in a process of its own.

    Args:
        target: the reader.
        engine: "hypothesis" (damaged and crafted files) or "atheris" (guided by the branches that the reader takes).
        cases: how many.
        seed: of the choices.
        folder: gets `counts`, `findings/` (one file of each fault, and where it was) and `report.json`; emptied first.
    """
    shutil.rmtree(folder, ignore_errors=True)
    ledger = Ledger(folder)
    ends: Dict[str, int] = {"crashes": 0, "hangs": 0}
    began = time.monotonic()

    def said() -> str:
        return (folder / "stderr").read_text(errors="replace")[-4000:]

    while (done := ledger.counts()["cases"]) < cases and sum(ends.values()) < MOST_ENDS:
        with tempfile.TemporaryDirectory(prefix="fuzz-", dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as work:
            now = seed + 1000 * sum(ends.values())
            how = _watch(ledger, [target.name, engine, str(cases - done), str(now), str(folder), work])
            if how:
                ends["hangs" if how == "hang" else "crashes"] += 1
                last = Path(work) / target.file
                ledger.finding(how, last.read_bytes() if last.exists() else b"", said())
            elif ledger.counts()["cases"] == done:
                raise RuntimeError(f"{target.name}: no case was run: {said()}")
    findings = sorted(file.stem for file in (folder / "findings").glob("*.txt"))
    counts = ledger.counts()
    report = Report(target.name, engine, **counts, **ends, seconds=time.monotonic() - began, findings=findings)
    (folder / "report.json").write_text(json.dumps(asdict(report), indent=2))
    return report


def _watch(ledger: Ledger, arguments: List[str]) -> str:
    """Run the process; "" if it ended well, "hang" if one file took too long, else how it died."""
    paths = os.pathsep.join([str(TESTS), str(TESTS.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "PYTHONFAULTHANDLER": "1"}
    with open(ledger.folder / "stderr", "w") as stderr:
        child = subprocess.Popen(
            [sys.executable, "-m", "fuzzing.child", *arguments], env=environment, stderr=stderr, stdout=stderr
        )
        begun = done = ledger.counts()["cases"]
        since, used = time.monotonic(), 0.0
        while child.poll() is None:
            time.sleep(0.2)
            now = ledger.counts()["cases"]
            if now != done:
                done, since, used = now, time.monotonic(), _seconds_of(child.pid)
            elif now != begun and _seconds_of(child.pid) - used > HANGS or time.monotonic() - since > STANDS_STILL:
                child.send_signal(signal.SIGABRT)  # faulthandler prints where it was
                child.wait(10)
                return "hang"
    return "" if child.returncode == 0 else f"crash{child.returncode}"


def _seconds_of(process: int) -> float:
    """Time that a process has used of the processor, in seconds."""
    fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
