"""Compare tracks with the moving groups of single sweeps, on simulated drives of five sensors.

python scripts/benchmarks/tracks.py                        a drive of 20 sweeps per sensor and scene
python scripts/benchmarks/tracks.py --model fast --only av2

Drives have seeds 300 and above; settings of the tracker were chosen on seeds 400 and 401. Ground masks are exact where
the data set has masks, and estimated by grid elsewhere. nuScenes is read at 10 Hz. We score an object in a sweep if it
moves at 0.5 m/s or more and has at least 20 active points.

Columns: number of scored objects over all sweeps; the share of them with a moving group, and with a track (recall); id
switches per 100 objects with a track; error of the horizontal velocity of groups and of tracks over the same objects,
m/s, mean and median; share of groups and of table rows that are static objects.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Dict, Iterator

import numpy as np
import torch
from table import markdown

from cflow_torch import Tracker, make_config, make_model
from cflow_torch.applications.moving_groups import MOVING
from cflow_torch.applications.track_table import confirmed, join_tables
from cflow_torch.data.catalog import GroundSegmentedLog
from cflow_torch.data.log import CachedLog, FlowLabels, Log, window
from cflow_torch.simulator import make_drive
from cflow_torch.simulator.benchmark import FORMATS
from cflow_torch.simulator.drive import Drive
from cflow_torch.types import FlowResult, Sweep, Window

WITH_MASKS = ("av2", "aevascenes")
SPEED, POINTS = 0.5, 20  # m/s and points, least of a scored object
Row = Dict[str, Any]


class SimulatedLog(Log):
    """A simulated drive with the sweep rate and ground masks of its data set, and with the truth."""

    def __init__(self, profile: str, seed: int, scene: str, num_sweeps: int) -> None:
        self.step, self._has_masks = 2 if profile == "nuscenes" else 1, profile in WITH_MASKS
        self.drive: Drive = make_drive(seed, num_sweeps * self.step, profile, scene)
        self.log_id, self.timestamps = self.drive.log_id, self.drive.timestamps[:: self.step]

    def sweep(self, index: int) -> Sweep:
        """Sweep of the drive, without its mask if the data set has none."""
        sweep = self.drive.sweep(index * self.step)
        return sweep if self._has_masks else replace(sweep, is_ground=None)

    def labels(self, index: int) -> FlowLabels | None:
        """None, because `truth` has more."""
        return None

    def truth(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """(N,) index of each point's body, the last = ground; (bodies + 1, 3) velocities over ground, m/s."""
        times = (np.array(self.timestamps[index : index + 2]) - self.timestamps[0]) * 1e-9
        now, then = self.drive.scene.body_poses(times)[:, :, :3, 3]
        velocity = np.concatenate([(then - now) / (times[1] - times[0]), np.zeros((1, 3))])
        table, solid = self.drive.scene.table, self.drive.returns(index * self.step).solid.numpy()
        return np.append(table.body, len(now))[solid], velocity

    def opened(self) -> Log:
        """The log with ground masks."""
        return self if self._has_masks else GroundSegmentedLog(self, "grid")


def score(log: SimulatedLog, pairs: Iterator[tuple[int, Window, FlowResult]]) -> Row:
    """Counts and errors of a drive, to be summed."""
    tracker, tables, sweeps = Tracker(), [], []
    for index, given, result in pairs:
        table, track_id = tracker.push(given, result)
        tables.append({**table, "sweep": np.full(len(table["id"]), index)})
        sweeps.append((index, result.numpy(), given, track_id))
    kept = confirmed(join_tables(tables))
    counts: Row = dict.fromkeys(("objects", "grouped", "tracked", "switches", "groups", "false_groups"), 0)
    counts.update(rows=len(kept["id"]), false_rows=0, raw=[], filtered=[])
    last: dict[int, int] = {}
    for index, flow, given, track_id in sweeps:
        body, velocity = log.truth(index)
        ground = len(velocity) - 1
        seconds = (log.timestamps[index + 1] - log.timestamps[index]) * 1e-9
        moves = (np.linalg.norm(flow["residual_flow"], axis=1) >= MOVING) & (flow["cluster_id"] >= 0)
        rotation = np.asarray(given.pc1.pose)[:3, :3]
        rows = {name: values[kept["sweep"] == index] for name, values in kept.items()}
        track_id = np.where(np.isin(track_id, rows["id"]), track_id, -1)
        is_dynamic = np.linalg.norm(velocity, axis=1) >= SPEED
        for owner in _bodies_of(flow["cluster_id"], moves, body):
            counts["groups"] += 1
            counts["false_groups"] += not is_dynamic[owner]
        for owner in _bodies_of(track_id, track_id >= 0, body):
            has_moved = is_dynamic[owner] or (owner < ground and not log.drive.scene.bodies[owner].is_static)
            counts["false_rows"] += not has_moved
        for dynamic in np.flatnonzero(is_dynamic):
            on_body = flow["is_valid"] & (body == dynamic)
            if on_body.sum() < POINTS:
                continue
            counts["objects"] += 1
            group = _most_frequent(flow["cluster_id"][on_body & moves])
            of_track = _most_frequent(track_id[on_body & (track_id >= 0)])
            counts["grouped"] += group is not None
            if of_track is None:
                continue
            counts["tracked"] += 1
            counts["switches"] += last.get(dynamic, of_track) != of_track
            last[dynamic] = of_track
            if group is None:
                continue
            raw = rotation @ flow["residual_flow"][moves & (flow["cluster_id"] == group)].mean(0) / seconds
            row = np.flatnonzero(rows["id"] == of_track)[0]
            filtered = np.array([rows[name][row] for name in ("vx", "vy")])
            counts["raw"].append(float(np.linalg.norm((raw - velocity[dynamic])[:2])))
            counts["filtered"].append(float(np.linalg.norm(filtered - velocity[dynamic, :2])))
    return counts


def _most_frequent(numbers: np.ndarray) -> int | None:
    """The most frequent number, None without numbers."""
    values, count = np.unique(numbers, return_counts=True)
    return int(values[count.argmax()]) if len(values) else None


def _bodies_of(group: np.ndarray, chosen: np.ndarray, body: np.ndarray) -> Iterator[int]:
    """For each group with at least five chosen points, the body that most of them belong to."""
    for value, count in zip(*np.unique(group[chosen], return_counts=True)):
        owner = _most_frequent(body[chosen & (group == value)])
        if count >= 5 and owner is not None:
            yield owner


def summary(sensor: str, parts: list[Row]) -> Row:
    """A row of the table."""
    total = {name: sum((part[name] for part in parts[1:]), parts[0][name]) for name in parts[0]}
    raw, filtered = (total[name] or [float("nan")] for name in ("raw", "filtered"))

    def share(part: str, whole: str) -> float:
        return 100 * total[part] / max(1, total[whole])

    return {
        "sensor": sensor,
        "objects": total["objects"],
        "recall of groups, %": share("grouped", "objects"),
        "recall of tracks, %": share("tracked", "objects"),
        "switches / 100": share("switches", "tracked"),
        "velocity, single (mean, median)": f"{np.mean(raw):.3f}, {np.median(raw):.3f}",
        "velocity, tracks": f"{np.mean(filtered):.3f}, {np.median(filtered):.3f}",
        "static groups, %": share("false_groups", "groups"),
        "static rows, %": share("false_rows", "rows"),
        "rows": total["rows"],
    }


def main() -> None:
    """Simulate, estimate, track, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="default", help="preset")
    parser.add_argument("--only", nargs="*", default=tuple(FORMATS), choices=tuple(FORMATS))
    parser.add_argument("--scenes", nargs="*", default=("street", "crossing"))
    parser.add_argument("--first-seed", type=int, default=300)
    parser.add_argument("--num-sweeps", type=int, default=20)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    model = make_model(make_config(given.model), "auto")

    def pairs(log: Log) -> Iterator[tuple[int, Window, FlowResult]]:
        recent = CachedLog(log, model.config.num_sweeps)
        for index in range(len(log.timestamps) - 1):
            sweeps = window(recent, index, model.config.num_history, model.config.num_future)
            yield index, sweeps, model([sweeps])[0]

    rows, everything = [], []
    for sensor in given.only:
        logs = [
            SimulatedLog(sensor, given.first_seed + number, scene, given.num_sweeps)
            for number, scene in enumerate(given.scenes)
        ]
        parts = [score(log, pairs(log.opened())) for log in logs]
        everything += parts
        rows.append(summary(sensor, parts))
        print(rows[-1], flush=True)
    rows.append(summary("all", everything))
    print(markdown(rows))
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
