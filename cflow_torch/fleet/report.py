"""The last word of a run: what is there, what is not, how long it took; as a table and as JSON."""

from __future__ import annotations

import platform
from typing import Any, Dict, List

from cflow_torch.fleet.counters import Counters
from cflow_torch.fleet.machine import Layout
from cflow_torch.fleet.shard import Shard

_SHOWN = 20  # failures that the table lists; JSON has them all


def make_report(
    counters: Counters, seconds: float, layout: Layout, shard: Shard, engine: str, signal_name: str
) -> Dict[str, Any]:
    """All figures of a run.

    Args:
        counters: what was done.
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
    waiting = counters.waiting
    return {
        "status": "interrupted" if signal_name else "complete" if counters.is_complete else "incomplete",
        "stopped_by": signal_name or None,
        "engine": engine,
        "shard": {"index": shard.index, "count": shard.count},
        "devices": list(layout.devices),
        "threads": layout.threads,
        "batch": layout.batch,
        "machine": platform.platform(),
        "frames": {
            "total": counters.total,
            "complete_before": counters.complete_before,
            "computed": counters.computed,
            "failed": counters.num_failed_frames,
            "failed_logs": len(counters.failures) - counters.num_failed_frames,
            "waiting": len(waiting),
            "unopened_units": counters.num_unopened,
        },
        "seconds": seconds,
        "frames_per_s": counters.computed / seconds if seconds > 0 else 0.0,
        "stages": {name: total / max(1, counters.computed) for name, total in counters.seconds.items()},
        "failures": [list(failure) for failure in counters.failures],
        "waiting": waiting,
    }


def format_report(report: Dict[str, Any]) -> str:
    """The table."""
    frames, shard, devices = report["frames"], report["shard"], report["devices"]
    workers = f"workers: {len(devices)} on {', '.join(sorted(set(devices)))}, threads of each: {report['threads']}"
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


def format_missing(report: Dict[str, Any]) -> str:
    """What is not there, a line each; "" if nothing is missing."""
    lines: List[str] = [f"  {name}: {message}" for name, message in report["failures"]]
    lines += [f"  {name}: not done" for name in report["waiting"]]
    if len(lines) > _SHOWN:
        lines[_SHOWN:] = [f"  and {len(lines) - _SHOWN} more, all of them in the report"]
    if report["frames"]["unopened_units"]:
        lines.append(f"  {report['frames']['unopened_units']} logs or parts of logs: not begun")
    return "\n".join(lines)
