"""Replay a log in real time and measure the latency: `cflow stream`."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from tqdm import tqdm

from cflow_torch.applications.stream import FlowStream
from cflow_torch.cli.commands import Stream
from cflow_torch.cli.logs import open_first_log
from cflow_torch.cli.outputs import machine, output_folder
from cflow_torch.data.atomic import ensure_writable
from cflow_torch.data.json_file import write_json
from cflow_torch.data.log import Log
from cflow_torch.fleet.manifest import versions
from cflow_torch.types import CFlowError


def task(cfg: Stream) -> None:
    output = output_folder(cfg)
    # The log finds the ground, or has none where data.find_ground is null.
    stream = FlowStream(cfg.model, device=cfg.device, ground=None, max_gap=cfg.max_gap)
    log = open_first_log(cfg.data)
    ensure_writable(output)
    steps = np.diff(log.sweep_times(stream.config.sweep_interval)[: cfg.count])
    if not (steps <= cfg.max_gap).any():
        raise CFlowError(
            f"no sweep of {log.log_id} is within max_gap={cfg.max_gap:g} s of the next one: give a larger one"
        )
    report = {"log": log.log_id, **play(stream, log, cfg.pace, cfg.count)}
    report.update(machine=machine(), versions=versions())
    print(_summary(report))
    write_json(output / "stream.json", report)
    print(f"written to {output / 'stream.json'}")


def play(stream: FlowStream, log: Log, pace: Any = None, count: Any = None) -> dict[str, Any]:
    """Push at most `count` sweeps of a log into a stream.

    `pace` is a factor on the speed of the recording; None = each sweep as soon as the previous one is done.

    Returns:
        "sweeps", "results"; "latency": "p50" and "p99", seconds from the time a sweep is due to the flow of the sweep
        before; "interval": median seconds between sweeps, None without `pace`; "in_time": share of results that were
        ready before the next sweep; "rate": sweeps per second.
    """
    seconds = log.sweep_times(stream.config.sweep_interval)[:count]
    due = None if pace is None else seconds / pace
    latencies: list[float] = []
    begin = time.perf_counter()
    progress = tqdm(range(len(seconds)), desc=f"stream {log.log_id}", unit="sweep", disable=None)
    for index in progress:
        sweep = log.sweep(index)
        arrival = time.perf_counter() if due is None else begin + due[index]
        time.sleep(max(arrival - time.perf_counter(), 0.0))
        result = stream.push(sweep)
        if result is not None:
            result.is_valid.any().item()  # waits for the GPU
            latencies.append(time.perf_counter() - arrival)
            progress.set_postfix_str(f"latency {1000 * latencies[-1]:.0f} ms")
    elapsed = time.perf_counter() - begin
    p50, p99 = np.percentile(latencies or [np.nan], (50, 99)).tolist()
    interval = None if due is None else float(np.median(np.diff(due)))
    return {
        "sweeps": len(seconds),
        "results": len(latencies),
        "latency": {"p50": p50, "p99": p99},
        "interval": interval,
        "in_time": None if interval is None else float(np.mean(np.array(latencies) <= interval)),
        "rate": len(seconds) / elapsed,
    }


def _summary(report: dict[str, Any]) -> str:
    p50, p99 = (1000 * report["latency"][name] for name in ("p50", "p99"))
    lines = [
        f"log {report['log']}: {report['sweeps']} sweeps, {report['results']} results, {report['rate']:.1f} sweeps/s",
        f"latency: median {p50:.0f} ms, 99 % within {p99:.0f} ms",
    ]
    if report["interval"] is not None:
        share, interval = 100 * report["in_time"], 1000 * report["interval"]
        lines.append(f"{share:.0f} % of the results were ready before the next sweep (every {interval:.0f} ms)")
    return "\n".join(lines)
