"""What a run would do: frames, outputs, time, memory, disk. Writes nothing into its output."""

from __future__ import annotations

import shutil
import tempfile
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Iterator, Sequence

from tqdm import tqdm

from cflow_torch.data.catalog import open_log
from cflow_torch.data.paths import as_path, is_remote
from cflow_torch.fleet.job import Done, Job, Unit
from cflow_torch.fleet.machine import Layout
from cflow_torch.fleet.manifest import complete_frames, frame_file
from cflow_torch.fleet.work import Worker, describe, source_name
from cflow_torch.windows.memory import peak_memory

_GB = 1e9


def forecast(job: Job, units: Sequence[Unit], layout: Layout) -> str:
    """Open every log, count, and try a few frames: as text, a line per log.

    Cost: opens all logs; computes two batches.
    """
    rows, failures, trial = [], [], None
    for unit in units:
        try:
            log = open_log(job.reader, unit.source, **{**job.settings, "check": False})
            stamps = [int(log.timestamps[i]) for i in unit.frames(len(log.timestamps) - 1)]
            complete = set() if job.redo else complete_frames(as_path(job.output) / log.log_id)
            todo = [stamp for stamp in stamps if stamp not in complete]
            span = f"{stamps[0]} ... {stamps[-1]}" if stamps else ""
            rows.append((log.log_id, len(stamps), len(stamps) - len(todo), len(todo), span))
            if todo and trial is None:
                trial = _try(job, replace(unit, only=frozenset(todo[: 2 * job.batch])), layout)
        except Exception as error:
            failures.append(f"cannot be opened: {source_name(unit.source)}: {describe(error)}")

    width = max([len(name) for name, *_ in rows] + [3])
    lines = [f"{'log':{width}}  frames  complete  to do  time stamps"]
    lines += [f"{name:{width}}  {total:6}  {before:8}  {left:5}  {span}" for name, total, before, left, span in rows]
    lines += failures
    total, before, left = (sum(column) for column in zip(*(row[1:4] for row in rows))) if rows else (0, 0, 0)
    lines.append(f"{len(rows)} logs, {total} frames, {before} complete, {left} to do")
    lines.append(f"outputs: {frame_file(as_path(job.output) / '<log>', 0).parent}/<time stamp>.feather")
    if trial is not None:
        lines += _costs(job, layout, left, *trial)
    lines.append("dry run: nothing was written")
    return "\n".join(lines)


def _try(job: Job, unit: Unit, layout: Layout) -> tuple[dict[str, float], int]:
    """Read, compute and write two batches, as a worker would. The first warms up, if there is a second.

    Returns:
        Seconds of one frame by stage, and the bytes of its file.
    """
    with tempfile.TemporaryDirectory() as scratch:
        worker = Worker(replace(job, output=scratch, settings={**job.settings, "check": False}), layout.devices[0])
        done = [event for event in worker.run(unit) if isinstance(event, Done)]
        worker.close()
        frame_bytes = max(file.stat().st_size for file in Path(scratch).rglob("*.feather"))
    timed = done[job.batch :] or done
    stages = ("read", "compute", "write")
    return {stage: sum(event.seconds[stage] for event in timed) / len(timed) for stage in stages}, frame_bytes


def _costs(job: Job, layout: Layout, todo: int, seconds: dict[str, float], frame_bytes: int) -> Iterator[str]:
    """Time, room and memory for the frames that are to be done."""
    workers, output = len(layout.devices), as_path(job.output)
    stages = ", ".join(f"{name} {1e3 * value:.1f}" for name, value in seconds.items())
    yield f"one frame on one worker, ms (tried on {job.batch} at once): {stages}"
    time = tqdm.format_interval(todo * sum(seconds.values()) / workers)
    yield f"time: about {time} with {workers} workers, less where stages overlap"
    room = ""
    if not is_remote(output):
        with suppress(OSError):
            free = shutil.disk_usage(next(path for path in (output, *output.parents) if path.exists())).free
            room = f", {free / _GB:.1f} GB are free there"
    yield f"disk: {todo * frame_bytes / _GB:.2f} GB{room}"
    memory = peak_memory()
    if memory is not None:
        yield f"memory: {workers} x {memory / _GB:.2f} GB"
