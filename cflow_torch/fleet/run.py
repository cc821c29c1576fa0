"""Run a fleet: count the events of its workers and write the report; or count what a run would compute."""

from __future__ import annotations

import platform
import re
import signal
import time
from collections import Counter
from contextlib import closing
from typing import Any, Iterable, Iterator, Mapping, Sequence

from cflow_torch.data.atomic import remove_stale
from cflow_torch.data.catalog import source_name
from cflow_torch.data.json_file import write_json
from cflow_torch.data.paths import as_path
from cflow_torch.fleet.executors import Executor, describe_error
from cflow_torch.fleet.job import Done, Event, Failed, Job, Noted, Opened, Part, Shard
from cflow_torch.fleet.manifest import complete_frames, is_of_run
from cflow_torch.fleet.parallel import run_parallel
from cflow_torch.fleet.progress import Progress, log_line
from cflow_torch.fleet.stop_signal import StopSignal
from cflow_torch.fleet.work import open_quickly
from cflow_torch.types import CFlowError

_SHOWN = 3  # how often a message is shown during a run; the report names every log or frame with this message
_SHOWN_FAILURES = 20  # that are listed at the end; the report has them all
_NUMBER = re.compile(r"-?\d[\d.e+-]*")  # messages that differ by these only are alike


def run_fleet(
    executors: Sequence[Executor],
    parts: Sequence[Part],
    job: Job,
    devices: Sequence[str],
    shard: Shard,
    engine: str,
    about: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Compute the frames of a shard that are not complete, and write a report.

    Call `manifest.check_logs` first.

    Args:
        executors: of `Worker` objects of the job, one per device.
        engine: name of what made the executors, for the report.

    Returns:
        The report of `Counters.report` with the entries of `about`. It is also written to OUTPUT/reports/<shard>.json.
        "exit_status" is 0 if every frame of the shard is on disk, 1 if not or if the report could not be written. It is
        130 after Ctrl-C, 143 after SIGTERM and 129 after SIGHUP.
    """
    counters = Counters(parts)
    start = time.perf_counter()
    with StopSignal() as stop, closing(run_parallel(executors, parts, stop)) as events:
        try:
            _follow(events, counters, len(parts))
        except KeyboardInterrupt:
            stop.received = stop.received or signal.SIGINT
        except CFlowError as error:  # no worker is left
            if not counters.total:
                raise
            log_line(f"ended early: {error}")
        ended_by = 0 if counters.is_complete else stop.received or 0
        name = signal.Signals(ended_by).name if ended_by else ""
        report = {
            **counters.report(time.perf_counter() - start, name),
            "engine": engine,
            "shard": {"index": shard.index, "count": shard.count},
            "devices": list(devices),
            "batch": job.batch,
            "machine": platform.platform(),
            **(about or {}),
        }
        report["exit_status"] = 128 + ended_by if ended_by else 0 if counters.is_complete else 1
        try:
            file = report_file(job.output, shard)
            remove_stale(file.parent)
            write_json(file, report)
        except OSError as error:
            log_line(f"the report could not be written: {error}")
            report["exit_status"] = report["exit_status"] or 1
    return report


def report_file(output: str, shard: Shard) -> Any:
    return as_path(output) / "reports" / f"shard-{shard.index}-of-{shard.count}.json"


def _follow(events: Iterator[Event], counters: Counters, num_parts: int) -> None:
    """Count the events and show the progress. The total is an estimate until all logs are open."""
    with Progress() as progress:
        for event in events:
            counters.add(event)
            if counters.num_opened:
                progress.total = round(counters.total * max(1, num_parts / counters.num_opened))
            if isinstance(event, Failed) and counters.times_failed(event.message) <= _SHOWN:
                log_line(f"failed: {event.name}: {event.message}")
            elif isinstance(event, Noted) and counters.times_noted(event.message) <= _SHOWN:
                log_line(f"warning: {event.name}: {event.message}")
            progress.update(counters.total - counters.num_waiting - progress.n)
        progress.total = progress.n


def count_frames(job: Job, parts: Iterable[Part]) -> Iterator[tuple[str, int, int]]:
    """Yield the name of each part's log, the number of its frames, and how many of them are not complete.

    A log that cannot be opened counts as 0. Cost: opens the log and lists its files in the output. Nothing is written.
    """
    for part in parts:
        try:
            with open_quickly(job, part.source) as log:
                stamps = set(part.stamps(log).values())
                folder = as_path(job.output) / log.log_id
                complete = complete_frames(folder) if not job.redo and is_of_run(folder, job.identity) else set()
                yield log.log_id, len(stamps), len(stamps - complete)
        except Exception as error:
            yield f"{source_name(part.source)}: cannot be opened: {describe_error(error)}", 0, 0


def forecast(job: Job, parts: Sequence[Part]) -> str:
    """Count the frames that a run would compute: a table with a row per log."""
    rows = list(count_frames(job, parts))
    total, left = sum(frames for _, frames, _ in rows), sum(todo for _, _, todo in rows)
    lines = [f"{frames:8} {todo:8}  {name}" for name, frames, todo in rows]
    end = f"{total:8} {left:8}  in total; dry run: nothing was written to {job.output}"
    return "\n".join(["  frames    to do  log", *lines, end])


class Counters:
    """Counts frames and collects failures and notes, from the events of a run."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self.failures: list[tuple[str, str]] = []  # (frame or log, message)
        self.notes: Counter[tuple[str, str]] = Counter()  # (log, message)
        self.num_opened = 0  # parts
        self.total = self.num_before = self.num_computed = self.num_failed = 0  # frames of opened parts
        # Names of what is neither done nor failed: logs of parts that are not open, and frames of those that are.
        self._unopened = Counter(source_name(part.source) for part in parts)
        self.waiting: Counter[str] = Counter()
        self._seconds: Counter[str] = Counter()  # by stage, of all workers together
        self._causes: Counter[str] = Counter()  # of the failures

    @property
    def is_complete(self) -> bool:
        return not (self.failures or +self._unopened or +self.waiting)

    def times_noted(self, message: str) -> int:
        """Count how often a message was noted, for any log."""
        return sum(count for (_, text), count in self.notes.items() if text == message)

    def times_failed(self, message: str) -> int:
        """Count how often something failed with a message like this one."""
        return self._causes[_cause(message)]

    def add(self, event: Event) -> None:
        if isinstance(event, Noted):
            self.notes[event.name, event.message] += 1
        elif isinstance(event, Opened):
            self.num_opened += 1
            self.total += event.num_frames
            self.num_before += event.num_frames - len(event.todo)
            self._unopened[event.source] -= 1
            self.waiting.update(event.todo)
        elif isinstance(event, Done):
            self.num_computed += 1
            self.waiting[event.name] -= 1
            self._seconds.update(event.seconds)
        else:
            self.failures.append((event.name, event.message))
            self._causes[_cause(event.message)] += 1
            is_frame = self.waiting[event.name] > 0
            self.num_failed += is_frame
            (self.waiting if is_frame else self._unopened)[event.name] -= 1

    @property
    def num_waiting(self) -> int:
        """Number of frames of opened parts that are neither on disk nor failed."""
        return self.total - self.num_before - self.num_computed - self.num_failed

    def report(self, seconds: float, signal_name: str) -> dict[str, Any]:
        """Return all figures of a run that took `seconds`. `signal_name` is the signal that stopped it, "" = none.

        Returns:
            "status": "complete", "incomplete" (something failed or is missing) or "interrupted".
            "frames": numbers of frames: "total", "complete_before", "computed", "failed" and "waiting" (not done, of
            opened logs); numbers of logs or parts of logs: "failed_logs" and "unopened_parts".
            "frames_per_s": computed frames. "stages": seconds per computed frame, summed over all workers.
            "failures": frame or log, and message. "waiting": frames. "notes": log, message and how often.
        """
        return {
            "status": "interrupted" if signal_name else "complete" if self.is_complete else "incomplete",
            "stopped_by": signal_name or None,
            "frames": {
                "total": self.total,
                "complete_before": self.num_before,
                "computed": self.num_computed,
                "failed": self.num_failed,
                "failed_logs": len(self.failures) - self.num_failed,
                "waiting": self.num_waiting,
                "unopened_parts": sum((+self._unopened).values()),
            },
            "seconds": seconds,
            "frames_per_s": self.num_computed / seconds if seconds > 0 else 0.0,
            "stages": {name: total / max(1, self.num_computed) for name, total in self._seconds.items()},
            "failures": self.failures,
            "waiting": sorted(self.waiting.elements()),
            "notes": [[*note, count] for note, count in self.notes.items()],
        }


def format_report(report: dict[str, Any]) -> str:
    """Return the report as a table, without the times of the stages."""
    frames, shard, devices = report["frames"], report["shard"], report["devices"]
    workers = f"workers: {len(devices)} on {', '.join(sorted(set(devices)))}"
    rows = {
        "status": report["status"] + (f" by {report['stopped_by']}" if report["stopped_by"] else ""),
        "engine": f"{report['engine']}, {workers}, shard {shard['index']} of {shard['count']}",
        "frames": frames["total"],
        "  complete before": frames["complete_before"],
        "  computed": frames["computed"],
        "  failed": frames["failed"],
        "  not done": frames["waiting"],
    }
    seldom = {
        "warnings": sum(count for *_, count in report["notes"]),
        "logs or parts of logs that failed": frames["failed_logs"],
        "logs or parts of logs not begun": frames["unopened_parts"],
    }
    rows.update({name: count for name, count in seldom.items() if count})
    rows.update({"seconds": f"{report['seconds']:.1f}", "frames/s": f"{report['frames_per_s']:.2f}"})
    width = max(map(len, rows))
    return "\n".join(f"{name:{width}}  {value}".rstrip() for name, value in rows.items())


def format_missing(report: dict[str, Any]) -> str:
    """List what is missing, a line each, and failures of one cause together; "" if nothing is."""
    alike: dict[str, dict[str, str]] = {}  # cause -> frame or log -> message; parts of a log repeat it
    for name, message in report["failures"]:
        alike.setdefault(_cause(message), {}).setdefault(name, message)
    lines = []
    for failures in alike.values():
        (first, message), *others = failures.items()
        more = f" (and {len(others)} more, to {others[-1][0]})" if others else ""
        lines.append(f"  {first}{more}: {message}")
    lines += [f"  {name}: not done" for name in report["waiting"]]
    if len(lines) > _SHOWN_FAILURES:
        lines[_SHOWN_FAILURES:] = [f"  and {len(lines) - _SHOWN_FAILURES} more, all of them in the report"]
    if report["frames"]["unopened_parts"]:
        lines.append(f"  {report['frames']['unopened_parts']} logs or parts of logs: not begun")
    return "\n".join(lines)


def _cause(message: str) -> str:
    """Return a message without its numbers."""
    return _NUMBER.sub("#", message)
