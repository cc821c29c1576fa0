#!/usr/bin/env python3
"""The targets of speed and what is reached, in one run: times in turn with what they are compared with, medians.

  python scripts/benchmarks/speed_table.py                                          a simulated street
  python scripts/benchmarks/speed_table.py --data-set av2 --root /data/av2/val/LOG --repeats 50 --json FILE
  python scripts/benchmarks/speed_table.py --before CHECKOUT                         an older version in every row, too

Every version computes in processes of its own. Needs opencv-python-headless, and torch 2.9 for the counts.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, Sequence

import numpy as np
from table import markdown

ROOT = Path(__file__).resolve().parents[2]
HISTORY = 4
SCALES = (0.8, 0.4, 0.3, 0.2, 0.1)  # the paper's figure benefit_multiscale
PAPER: dict[str, Any] = {"preset": "paper"}
FULL = {**PAPER, "num_history": HISTORY, "pixel_sizes": SCALES}
KEYS = {"preset": "keypoints"}
REST_S = 0.02  # threads of what ran before spin for some milliseconds
FLOW_PAIRS, FLOW_LOGS = 40, 5
Rows = Iterator[Dict[str, Any]]


def like_default(**more: Any) -> dict[str, Any]:
    """`paper` with the region of `default`."""
    from cflow_torch import make_config

    return {**PAPER, "point_cloud_range": make_config("default").point_cloud_range, **more}


# A process that measures: it is given calls as lines of JSON and answers each with its seconds.


def serve(file: str) -> None:
    """Read the clouds, then time what is asked for."""
    import torch

    from cflow_torch import Sweep, Window, estimate_flow, make_config

    clouds = pickle.loads(Path(file).read_bytes())  # of this run
    (p0, T, g0), (p1, _, g1), *past = clouds

    def ours(options: dict[str, Any]) -> Any:
        older = past[: options.get("num_history", make_config(options["preset"]).as_dict().get("num_history", 0))]
        history = {"pch": [c[0] for c in older], "T_ego1_egoh": [c[1] for c in older], "gmh": [c[2] for c in older]}
        return estimate_flow(p0, p1, T_ego1_ego0=T, gm0=g0, gm1=g1, device="cpu", **history, **options)

    def loop(options: dict[str, Any]) -> Any:
        import cv2
        from opencv_loop import opencv_flow

        cv2.setNumThreads(1)
        config = make_config(**options)
        sweeps = [Sweep(points, ground, pose) for points, pose, ground in clouds]
        return opencv_flow(Window(sweeps[0], sweeps[1], tuple(sweeps[2 : 2 + config.num_history])), config)

    print(json.dumps(torch.__version__), flush=True)
    for line in sys.stdin:
        call = json.loads(line)
        run, seconds = {"ours": ours, "loop": loop}[call["of"]], []
        for _ in range(call["repeats"]):
            start = time.perf_counter()
            run(call["options"])
            seconds.append(time.perf_counter() - start)
        print(json.dumps(seconds), flush=True)


class Measurer:
    """Such a process.

    Args:
        clouds: file of the clouds.
        checkout: whose package it is.
        environment: more of it.
    """

    def __init__(self, clouds: Path, checkout: Path, **environment: str) -> None:
        call = [sys.executable, __file__, "--serve", str(clouds)]
        environ = {**os.environ, "PYTHONPATH": str(checkout), **environment}
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self._process = subprocess.Popen(call, cwd=checkout, env=environ, text=True, **pipes)  # type: ignore
        self.answer()

    def ask(self, options: dict[str, Any], repeats: int = 2, of: str = "ours") -> None:
        """Begin to time a call."""
        self._process.stdin.write(json.dumps({"of": of, "options": options, "repeats": repeats}) + "\n")  # type: ignore
        self._process.stdin.flush()  # type: ignore[union-attr]

    def answer(self) -> Any:
        """Seconds of the runs that were asked for."""
        return json.loads(self._process.stdout.readline())  # type: ignore[union-attr]

    def end(self) -> None:
        """End the process."""
        self._process.stdin.close()  # type: ignore[union-attr]
        self._process.wait()


def in_turn(calls: Sequence[tuple[Measurer, dict[str, Any], str]], repeats: int) -> list[list[float]]:
    """Seconds of each call, one after the other; of the two runs of a call the second counts."""
    times: list[list[float]] = [[] for _ in calls]
    for repeat in range(-1, repeats):
        for (measurer, options, of), seconds in zip(calls, times):
            time.sleep(REST_S)
            measurer.ask(options, 2, of)
            taken = measurer.answer()[-1]
            if repeat >= 0:
                seconds.append(taken)
    return times


def ratio(over: Sequence[float], under: Sequence[float]) -> float:
    """The median of neighbouring runs: a slow spell of the machine hits both."""
    return statistics.median(a / b for a, b in zip(over, under))


# The rows


def latencies(versions: dict[str, Measurer], repeats: int) -> Rows:
    """One thread a window; "is" is the time of the second over that of the first, or the other way round."""
    now = versions["now"]
    four = {"num_history": HISTORY}
    scales = {"pixel_sizes": (0.4, 0.2, 0.1)}
    default0, default4 = {"preset": "default", "num_history": 0}, {"preset": "default", **four}
    for name, target, options, other, of in (
        ("`default` / `paper`, h 0", "<= 2", default0, like_default(), "ours"),
        ("`default` / `paper`, h 4", "<= 2", default4, like_default(**four), "ours"),
        ("`default` / `paper`, h 4, its scales", "", default4, like_default(**four, **scales), "ours"),
        ("OpenCV loop / `default`, h 4, its scales", ">= 3", default4, like_default(**four, **scales), "loop"),
        ("OpenCV loop / `paper`, h 0", ">= 2", PAPER, PAPER, "loop"),
        ("OpenCV loop / `paper`, h 4, five scales", ">= 4", FULL, FULL, "loop"),
        ("`keypoints` / `paper`, h 0", "<= 3", KEYS, PAPER, "ours"),
    ):
        calls = [(version, options, "ours") for version in versions.values()]
        *ours, theirs = in_turn([*calls, (now, other, of)], repeats)
        row: dict[str, Any] = {"what": name, "target": target}
        row["is"] = ratio(theirs, ours[0]) if of == "loop" else ratio(ours[0], theirs)
        row["ms"] = "{:.1f} and {:.1f}".format(*(1000 * statistics.median(seconds) for seconds in (ours[0], theirs)))
        for old in ours[1:]:
            row["before / now"] = ratio(old, ours[0])
        yield row


def two_processes(start: Callable[[], Measurer], repeats: int) -> Rows:
    """`paper` and `default` on a pair at once, torch's own number of threads, against each alone."""
    calls = ({**PAPER, "num_history": 0}, {"preset": "default", "num_history": 0})
    both = [start(), start()]
    alone: list[list[float]] = [[], []]
    beside: list[list[float]] = [[], []]
    for repeat in range(-1, repeats):
        seconds = []
        for measurer, options in zip(both, calls):
            measurer.ask(options, 5)
            seconds.append(statistics.median(measurer.answer()))
        numbers = [max(5, round(max(seconds) * 5 / each)) for each in seconds]  # both take as long
        for measurer, options, number in zip(both, calls, numbers):
            measurer.ask(options, number)
        for kind, values in ((alone, seconds), (beside, [statistics.median(each.answer()) for each in both])):
            for of_call, value in zip(kind, values if repeat >= 0 else []):
                of_call.append(value)
    for measurer in both:
        measurer.end()
    for name, here, there in zip(("paper", "default"), alone, beside):
        ms = "{:.1f} and {:.1f}".format(*(1000 * statistics.median(seconds) for seconds in (there, here)))
        about = {"what": f"`{name}`, two processes at once / alone", "target": "<= 1.3"}
        yield {**about, "is": ratio(there, here), "ms": ms}


def flow_on_cores(folder: Path, preset: str, repeats: int) -> Rows:
    """`cflow flow` on two cores against one: windows a second from the first flow file to the last."""
    from cflow_torch.simulator.benchmark import benchmark_logs

    (drive,) = benchmark_logs(folder / "drives", "av2", [900], FLOW_PAIRS + 1)
    for number in range(FLOW_LOGS):
        if not (folder / "logs" / f"log-{number}").exists():  # a link to the folder would be one log, seen five times
            shutil.copytree(drive, folder / "logs" / f"log-{number}", copy_function=os.link)
    cores = sorted(os.sched_getaffinity(0))[:2]
    rates: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(repeats):
        for count, values in rates.items():
            with tempfile.TemporaryDirectory(dir=folder) as output:
                call = [sys.executable, "-m", "cflow_torch.cli.main", "flow", "data=av2", f"model={preset}"]
                call += [f"data.root={folder / 'logs'}", f"output={output}", f"engine.workers={count}"]
                os.sched_setaffinity(0, cores[:count])  # inherited
                try:
                    subprocess.run([*call, "data.check=false"], check=True, stdout=subprocess.DEVNULL)
                finally:
                    os.sched_setaffinity(0, cores)
                written = sorted(file.stat().st_mtime_ns for file in Path(output).glob("*/*.feather"))
                values.append(1e9 * (len(written) - 1) / (written[-1] - written[0]))
    speeds = "{:.1f} and {:.1f} windows/s".format(*(statistics.median(rates[count]) for count in (2, 1)))
    name = f"`cflow flow`, `{preset}`, two cores / one"
    yield {"what": name, "target": ">= 1.8", "is": ratio(rates[2], rates[1]), "ms": speeds}


def counts(clouds: Sequence[Any]) -> Rows:
    """Launches and waits of a window on a pretend accelerator; launches of sixteen windows against one."""
    sys.path.insert(0, str(ROOT / "tests"))
    import pretend_device

    from cflow_torch import Sweep, Window, make_config, make_model

    sweeps = [Sweep(points, ground, pose) for points, pose, ground in clouds]
    cases = {"`paper`": (PAPER, "400 / 25"), "`default`": ({"preset": "default"}, "2500 / 60")}
    cases.update({"`paper`, h 4, five scales": (FULL, "1500 / 80"), "`keypoints`": (KEYS, "500 / 25")})
    for name, (options, target) in cases.items() if pretend_device.IS_THERE else ():
        config = make_config(**options)
        window = Window(sweeps[0], sweeps[1], tuple(sweeps[2 : 2 + config.num_history]))
        with pretend_device.PretendDevice() as device:
            model = make_model(config, pretend_device.DEVICE)
            model([window])
            one, sixteen = (device.count(partial(model, [window] * number)) for number in (1, 16))
        yield {"what": f"launches / waits of a window, {name}", "target": target, "is": "{} / {}".format(*one)}
        yield {"what": f"launches of 16 windows / one, {name}", "target": "<= 1.3", "is": sixteen[0] / one[0]}


def load(data_set: str, root: str) -> list[Any]:
    """Points, T_ego1_ego and ground of t, t+1, t-1, ... of a simulated street or of the first log below a folder."""
    from cflow_torch.data.catalog import find_sources, open_log
    from cflow_torch.data.log import window
    from cflow_torch.simulator import make_drive

    log: Any = make_drive(seed=7, num_sweeps=HISTORY + 2, profile="av2")
    if root:
        log = open_log(data_set, find_sources(data_set, root)[0], check=False)
    sweeps = window(log, min(HISTORY, len(log.timestamps) - 2), HISTORY)
    to_t1 = np.linalg.inv(np.asarray(sweeps.pc1.pose))
    arrays = [(s.points, to_t1 @ np.asarray(s.pose), s.is_ground) for s in (sweeps.pc0, sweeps.pc1, *sweeps.pch)]
    return [tuple(np.ascontiguousarray(array) for array in cloud) for cloud in arrays]


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data-set", default="av2", help="data set of --root, as in cflow's data=")
    parser.add_argument("--root", default="", help="a log or a folder of logs; default: a simulated street")
    parser.add_argument("--before", type=Path, help="a checkout of an older version")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=3, help="of cflow flow")
    parser.add_argument("--folder", type=Path, default=Path("outputs/benchmarks/speed"), help="drives and scratch")
    parser.add_argument("--only", nargs="*", choices=("processes", "latency", "counts", "flow"))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.serve:
        serve(given.serve)
        return
    from cflow_torch.cli.run import machine, versions

    given.folder.mkdir(parents=True, exist_ok=True)
    clouds, file = load(given.data_set, given.root), given.folder.resolve() / "clouds.pickle"
    file.write_bytes(pickle.dumps(clouds))
    checkouts = {"now": ROOT, **({"before": given.before.resolve()} if given.before else {})}
    servers = {name: Measurer(file, checkout, OMP_NUM_THREADS="1") for name, checkout in checkouts.items()}
    parts = {
        "processes": two_processes(lambda: Measurer(file, ROOT), max(3, given.repeats // 4)),
        "latency": latencies(servers, given.repeats),
        "counts": counts(clouds),
        "flow": flow_on_cores(given.folder, "fast", given.rounds),
    }
    rows = []
    for name in given.only or parts:
        for row in parts[name]:
            rows.append(row)
            print(row, file=sys.stderr, flush=True)
    for server in servers.values():
        server.end()
    about = {"points": len(clouds[0][0]), "older_sweeps": len(clouds) - 2, "repeats": given.repeats}
    report = {"machine": machine(), "versions": versions(), **about, "rows": rows}
    print(json.dumps({key: value for key, value in report.items() if key != "rows"}))
    print(markdown(rows))
    if given.json:
        given.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
