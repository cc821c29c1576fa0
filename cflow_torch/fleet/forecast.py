"""What a run would do: frames, outputs, time, memory, disk. Writes nothing into its output."""

from __future__ import annotations

import shutil
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import List, Optional, Sequence, Tuple

import torch

from cflow_torch.data.catalog import open_log
from cflow_torch.data.flow_file import write_flow
from cflow_torch.data.log import Log, RecentSweeps, window
from cflow_torch.data.paths import as_path, is_remote
from cflow_torch.estimate import make_model
from cflow_torch.fleet.job import Job, Unit
from cflow_torch.fleet.machine import Layout
from cflow_torch.fleet.manifest import complete_frames, frame_file
from cflow_torch.fleet.work import describe, source_name

_GB = 1e9


@dataclass
class Forecast:
    """What a run would do.

    Args:
        logs: of each log: name, frames, complete ones, time stamps of the first and the last frame ("" without any).
        failures: logs that cannot be opened and why.
        workers: at once.
        ms: of one frame by stage, one worker alone, measured on a few frames; empty if nothing is to be done.
        memory: bytes of one worker, measured after these frames; None where the system does not tell.
        frame_bytes: size of one flow file.
        free_bytes: room where the output goes; None on an object store.
    """

    logs: List[Tuple[str, int, int, str]] = field(default_factory=list)
    failures: List[Tuple[str, str]] = field(default_factory=list)
    workers: int = 1
    ms: List[Tuple[str, float]] = field(default_factory=list)
    memory: Optional[int] = None
    frame_bytes: int = 0
    free_bytes: Optional[int] = None

    @property
    def todo(self) -> int:
        """Frames to compute."""
        return sum(total - complete for _, total, complete, _ in self.logs)

    @property
    def seconds(self) -> float:
        """Of the run: all stages of all frames, shared by the workers; overlap makes it shorter."""
        return self.todo * sum(ms for _, ms in self.ms) / 1e3 / self.workers


def make_forecast(job: Job, units: Sequence[Unit], layout: Layout) -> Forecast:
    """Open every log, count, and try a few frames.

    Cost: opens all logs; computes two batches.
    """
    found = Forecast(workers=len(layout.devices))
    tried = False
    for unit in units:
        try:
            log = open_log(job.reader, unit.source, **{**job.settings, "check": False})
            stamps = [int(log.timestamps[i]) for i in unit.frames(len(log.timestamps) - 1)]
            complete = set() if job.redo else complete_frames(as_path(job.output) / log.log_id)
            todo = {stamp for stamp in stamps if stamp not in complete}
            span = f"{stamps[0]} ... {stamps[-1]}" if stamps else ""
            found.logs.append((log.log_id, len(stamps), len(stamps) - len(todo), span))
            if todo and not tried:
                tried = True
                _try(job, log, [i for i, stamp in enumerate(log.timestamps) if stamp in todo], layout, found)
        except Exception as error:
            found.failures.append((source_name(unit.source), describe(error)))
    output = as_path(job.output)
    if not is_remote(output):
        with suppress(OSError):
            found.free_bytes = shutil.disk_usage(_existing(output)).free
    return found


def format_forecast(found: Forecast, job: Job) -> str:
    """As text, a line per log."""
    width = max([len(name) for name, *_ in found.logs] + [3])
    lines = [f"{'log':{width}}  frames  complete  to do  time stamps"]
    for name, total, complete, span in found.logs:
        lines.append(f"{name:{width}}  {total:6}  {complete:8}  {total - complete:5}  {span}")
    lines += [f"cannot be opened: {name}: {message}" for name, message in found.failures]
    total = sum(total for _, total, *_ in found.logs)
    lines.append(f"{len(found.logs)} logs, {total} frames, {total - found.todo} complete, {found.todo} to do")
    lines.append(f"outputs: {frame_file(as_path(job.output) / '<log>', 0).parent}/<time stamp>.feather")
    if found.ms:
        stages = ", ".join(f"{name} {ms:.1f}" for name, ms in found.ms)
        lines.append(f"one frame on one worker, ms (tried on {job.batch} at once): {stages}")
        lines.append(f"time: about {_duration(found.seconds)} with {found.workers} workers, less where stages overlap")
        room = "" if found.free_bytes is None else f", {found.free_bytes / _GB:.1f} GB are free there"
        lines.append(f"disk: {found.todo * found.frame_bytes / _GB:.2f} GB{room}")
        if found.memory is not None:
            lines.append(f"memory: {found.workers} x {found.memory / _GB:.2f} GB")
    lines.append("dry run: nothing was written")
    return "\n".join(lines)


def _try(job: Job, log: Log, indices: Sequence[int], layout: Layout, found: Forecast) -> None:
    """Read, compute and write a batch, as a worker would."""
    threads = torch.get_num_threads()
    torch.set_num_threads(layout.threads)
    try:
        model, recent = make_model(job.config, layout.devices[0]), RecentSweeps(log, job.config.num_history + 2)
        chosen = list(indices[: job.batch])
        start = time.perf_counter()
        windows = [window(recent, index, job.config.num_history) for index in chosen]
        read = time.perf_counter() - start
        model(windows)  # warms up
        start = time.perf_counter()
        results = [result.to("cpu") for result in model(windows)]
        computed = time.perf_counter() - start
        with tempfile.TemporaryDirectory() as scratch:
            file = Path(scratch) / "flow.feather"
            start = time.perf_counter()
            for result in results:
                write_flow(file, result, job.contents)
            written = time.perf_counter() - start
            found.frame_bytes = file.stat().st_size
        # The first window also reads its history: later ones read one sweep each.
        sweeps = len(chosen) + 1 + len(windows[0].pch)
        seconds = [("read", read / sweeps), ("compute", computed / len(chosen)), ("write", written / len(chosen))]
        found.ms = [(name, 1e3 * value) for name, value in seconds]
        found.memory = _peak_memory()
    finally:
        torch.set_num_threads(threads)


def _peak_memory() -> Optional[int]:
    with suppress(ImportError):  # not on every system
        import resource

        return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return None


def _existing(folder: Path) -> Path:
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
