"""What a run has done: counted from the events of its workers, then as a table and as JSON."""

from __future__ import annotations

import platform
from collections import Counter
from typing import Any, Sequence

from cflow_torch.fleet.job import Done, Event, Opened, Shard, Unit
from cflow_torch.fleet.machine import Layout

_SHOWN = 20  # failures that the table lists; JSON has them all
_WAITING, _BEFORE, _COMPUTED, _FAILED = "waiting", "complete_before", "computed", "failed"  # states of a frame


class Counters:
    """Counts frames, each once, however often its unit was begun.

    Args:
        units: what was asked for.
    """

    def __init__(self, units: Sequence[Unit]) -> None:
        self.failures: list[tuple[str, str]] = []  # (frame or log, message)
        self._log_ids: dict[int, str] = {}  # of units that were opened
        self._states: dict[tuple[int, int], str] = {}  # (unit number, time stamp) -> state
        self._unopened = {unit.number for unit in units}
        self._seconds: Counter[str] = Counter()  # by stage, of all workers together

    @property
    def total(self) -> int:
        """Frames of the units that were opened."""
        return len(self._states)

    @property
    def num_opened(self) -> int:
        """Units that were begun."""
        return len(self._log_ids)

    @property
    def waiting(self) -> list[str]:
        """Frames of opened units that are neither on disk nor failed, in order."""
        waiting = sorted(key for key, state in self._states.items() if state == _WAITING)
        return [f"{self._log_ids[unit]}/{stamp}" for unit, stamp in waiting]

    @property
    def is_complete(self) -> bool:
        """Every frame is on disk."""
        return not (self.failures or self._unopened or self.waiting)

    def add(self, event: Event) -> int:
        """Count an event in; returns the number of frames that it settles (on disk, or failed)."""
        unit, states = event.unit, {}
        self._unopened.discard(unit)
        if isinstance(event, Opened):
            # A unit is opened again after its worker died: what is no longer to be done got its name before.
            complete = _COMPUTED if unit in self._log_ids else _BEFORE
            self._log_ids[unit] = event.log_id
            states = {**dict.fromkeys(event.frames, complete), **dict.fromkeys(event.todo, _WAITING)}
        elif isinstance(event, Done):
            states = {event.timestamp: _COMPUTED}
            self._seconds.update(event.seconds)
        else:
            self.failures.append((event.name, event.message))
            states = {} if event.timestamp is None else {event.timestamp: _FAILED}
        unsettled = {stamp: s for stamp, s in states.items() if self._states.get((unit, stamp), _WAITING) == _WAITING}
        self._states.update({(unit, stamp): state for stamp, state in unsettled.items()})
        return sum(state != _WAITING for state in unsettled.values())

    def report(self, seconds: float, layout: Layout, shard: Shard, engine: str, signal_name: str) -> dict[str, Any]:
        """All figures of a run.

        Args:
            seconds: from the start of the engine to its end.
            layout: what it ran on.
            shard: which share of the work it was.
            engine: "local" or "ray".
            signal_name: what stopped it, "" if nothing did.

        Returns:
            "status": "complete", "incomplete" (something failed or is missing) or "interrupted"; "frames": "total",
            "complete_before", "computed", "failed", "failed_logs" (or parts of logs), "waiting" (of begun logs) and
            "unopened_units"; "frames_per_s" of those computed; "stages": seconds per computed frame, summed over the
            workers, that overlap in time; "failures", "waiting".
        """
        counts = Counter(self._states.values())
        computed, failed = counts[_COMPUTED], counts[_FAILED]
        return {
            "status": "interrupted" if signal_name else "complete" if self.is_complete else "incomplete",
            "stopped_by": signal_name or None,
            "engine": engine,
            "shard": {"index": shard.index, "count": shard.count},
            "devices": list(layout.devices),
            "batch": layout.batch,
            "machine": platform.platform(),
            "frames": {
                "total": self.total,
                "complete_before": counts[_BEFORE],
                "computed": computed,
                "failed": failed,
                "failed_logs": len(self.failures) - failed,
                "waiting": counts[_WAITING],
                "unopened_units": len(self._unopened),
            },
            "seconds": seconds,
            "frames_per_s": computed / seconds if seconds > 0 else 0.0,
            "stages": {name: total / max(1, computed) for name, total in self._seconds.items()},
            "failures": [list(failure) for failure in self.failures],
            "waiting": self.waiting,
        }


def format_report(report: dict[str, Any]) -> str:
    """The table."""
    frames, shard, devices = report["frames"], report["shard"], report["devices"]
    workers = f"workers: {len(devices)} on {', '.join(sorted(set(devices)))}"
    rows = [
        ("status", report["status"] + (f" by {report['stopped_by']}" if report["stopped_by"] else "")),
        ("engine", f"{report['engine']}, {workers}, shard {shard['index']} of {shard['count']}"),
        ("frames", frames["total"]),
        ("  complete before", frames["complete_before"]),
        ("  computed", frames["computed"]),
        ("  failed", frames["failed"]),
        ("  not done", frames["waiting"]),
    ]
    if frames["failed_logs"]:
        rows.append(("logs or parts of logs that failed", frames["failed_logs"]))
    if frames["unopened_units"]:
        rows.append(("logs or parts of logs not begun", frames["unopened_units"]))
    rows.append(("seconds", f"{report['seconds']:.1f}"))
    rows.append(("frames/s", f"{report['frames_per_s']:.2f}"))
    if report["stages"]:
        rows.append(("ms per frame and worker (stages overlap)", ""))
        rows += [(f"  {name}", f"{1e3 * seconds:.1f}") for name, seconds in report["stages"].items()]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:{width}}  {value}".rstrip() for name, value in rows)


def format_missing(report: dict[str, Any]) -> str:
    """What is not there, a line each; "" if nothing is missing."""
    lines: list[str] = list(dict.fromkeys(f"  {name}: {message}" for name, message in report["failures"]))  # of parts
    lines += [f"  {name}: not done" for name in report["waiting"]]
    if len(lines) > _SHOWN:
        lines[_SHOWN:] = [f"  and {len(lines) - _SHOWN} more, all of them in the report"]
    if report["frames"]["unopened_units"]:
        lines.append(f"  {report['frames']['unopened_units']} logs or parts of logs: not begun")
    return "\n".join(lines)
