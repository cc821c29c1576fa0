"""What a run would do: frames, outputs, time, memory, disk. Writes nothing into its output."""

from __future__ import annotations

import shutil
import tempfile
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Dict, List, Optional, Sequence, Tuple

from tqdm import tqdm

from cflow_torch.data.catalog import open_log
from cflow_torch.data.paths import as_path, is_remote
from cflow_torch.fleet.job import Done, Job, Unit
from cflow_torch.fleet.machine import Layout, threads
from cflow_torch.fleet.manifest import complete_frames, frame_file
from cflow_torch.fleet.work import Worker, describe, source_name

_GB = 1e9


@dataclass
class Forecast:
    """What a run would do.

    Args:
        logs: of each log: name, frames, complete ones, time stamps of the first and the last frame ("" without any).
        failures: logs that cannot be opened and why.
        workers: at once.
        seconds: of one frame by stage, one worker alone, measured on a few frames; empty if nothing is to be done.
        memory: bytes of one worker, measured after these frames; None where the system does not tell.
        frame_bytes: size of one flow file.
        free_bytes: room where the output goes; None on an object store.
    """

    logs: List[Tuple[str, int, int, str]] = field(default_factory=list)
    failures: List[Tuple[str, str]] = field(default_factory=list)
    workers: int = 1
    seconds: Dict[str, float] = field(default_factory=dict)
    memory: Optional[int] = None
    frame_bytes: int = 0
    free_bytes: Optional[int] = None


def make_forecast(job: Job, units: Sequence[Unit], layout: Layout) -> Forecast:
    """Open every log, count, and try a few frames.

    Cost: opens all logs; computes two batches.
    """
    found = Forecast(workers=len(layout.devices))
    for unit in units:
        try:
            log = open_log(job.reader, unit.source, **{**job.settings, "check": False})
            stamps = [int(log.timestamps[i]) for i in unit.frames(len(log.timestamps) - 1)]
            complete = set() if job.redo else complete_frames(as_path(job.output) / log.log_id)
            todo = [stamp for stamp in stamps if stamp not in complete]
            span = f"{stamps[0]} ... {stamps[-1]}" if stamps else ""
            found.logs.append((log.log_id, len(stamps), len(stamps) - len(todo), span))
            if todo and not found.seconds:
                _try(job, replace(unit, only=frozenset(todo[: 2 * job.batch])), layout, found)
        except Exception as error:
            found.failures.append((source_name(unit.source), describe(error)))
    output = as_path(job.output)
    if not is_remote(output):
        with suppress(OSError):
            found.free_bytes = shutil.disk_usage(next(path for path in (output, *output.parents) if path.exists())).free
    return found


def format_forecast(found: Forecast, job: Job) -> str:
    """As text, a line per log."""
    width = max([len(name) for name, *_ in found.logs] + [3])
    lines = [f"{'log':{width}}  frames  complete  to do  time stamps"]
    for name, total, complete, span in found.logs:
        lines.append(f"{name:{width}}  {total:6}  {complete:8}  {total - complete:5}  {span}")
    lines += [f"cannot be opened: {name}: {message}" for name, message in found.failures]
    total, complete = sum(log[1] for log in found.logs), sum(log[2] for log in found.logs)
    todo = total - complete
    lines.append(f"{len(found.logs)} logs, {total} frames, {complete} complete, {todo} to do")
    lines.append(f"outputs: {frame_file(as_path(job.output) / '<log>', 0).parent}/<time stamp>.feather")
    if found.seconds:
        stages = ", ".join(f"{name} {1e3 * seconds:.1f}" for name, seconds in found.seconds.items())
        lines.append(f"one frame on one worker, ms (tried on {job.batch} at once): {stages}")
        time = tqdm.format_interval(todo * sum(found.seconds.values()) / found.workers)
        lines.append(f"time: about {time} with {found.workers} workers, less where stages overlap")
        room = "" if found.free_bytes is None else f", {found.free_bytes / _GB:.1f} GB are free there"
        lines.append(f"disk: {todo * found.frame_bytes / _GB:.2f} GB{room}")
        if found.memory is not None:
            lines.append(f"memory: {found.workers} x {found.memory / _GB:.2f} GB")
    lines.append("dry run: nothing was written")
    return "\n".join(lines)


def _try(job: Job, unit: Unit, layout: Layout, found: Forecast) -> None:
    """Read, compute and write two batches, as a worker would. The first warms up, if there is a second."""
    with tempfile.TemporaryDirectory() as scratch, threads(layout.threads):
        worker = Worker(replace(job, output=scratch, check=False), layout.devices[0])
        done = [event for event in worker.run(unit) if isinstance(event, Done)]
        worker.close()
        found.frame_bytes = max(file.stat().st_size for file in Path(scratch).rglob("*.feather"))
    timed = done[job.batch :] or done
    for stage in ("read", "compute", "write"):
        found.seconds[stage] = sum(event.seconds[stage] for event in timed) / len(timed)
    with suppress(ImportError):  # not on every system
        import resource

        found.memory = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
