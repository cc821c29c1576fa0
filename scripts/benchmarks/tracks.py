"""Score tracks on labelled HDF5 scenes and on simulated drives.

python scripts/benchmarks/tracks.py DATA/pandaset-002 DATA/kitti-0000/kitti-0000-c2.h5     scenes, or folders of them
python scripts/benchmarks/tracks.py --simulated av2 nuscenes --num-sweeps 12               a street and a crossing each

The drives have the seeds 300 and 301; settings of the tracker were chosen on 400 and 401. Ground masks are exact where
the data set has masks, and estimated by grid elsewhere. nuScenes is read at 10 Hz. We score confirmed tracks. A moving
object has a labelled speed of 0.5 m/s or more.

Columns: moving objects with 20 active points or more, over all sweeps; the share of them that the flow moves in part,
and of which a track has a point (coverage); changes of the track that has most points of an object; moving boxes a
sweep most of whose points have labels; those of them whose labelled points mostly belong to no moving object (false
boxes); median error of the horizontal velocity of the flow and of the tracks, m/s.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any, Dict, NamedTuple

import numpy as np
import torch
from table import markdown

from cflow_torch import Tracker, VerifiedFlow, make_config, make_model
from cflow_torch.applications.moving_groups import MOVING
from cflow_torch.applications.track_table import confirmed, join_tables
from cflow_torch.data.catalog import GroundSegmentedLog
from cflow_torch.data.hdf5 import HDF5Log, find_hdf5_scenes
from cflow_torch.data.log import Log, windows
from cflow_torch.evaluation.frame import ego_motion_flow
from cflow_torch.simulator import make_drive
from cflow_torch.simulator.benchmark import FORMATS
from cflow_torch.simulator.drive import Drive
from cflow_torch.types import Sweep

WITH_MASKS = ("av2", "aevascenes")
DRIVES = ((300, "street"), (301, "crossing"))
SPEED, POINTS = 0.5, 20  # m/s and points, least of a scored object
Row = Dict[str, Any]


class Truth(NamedTuple):
    """Objects of one sweep."""

    object_id: np.ndarray  # (N,) int64 of each point, 0 = background
    is_known: np.ndarray  # (N,) bool, False = without label
    velocity: np.ndarray  # (objects, 3) over ground, m/s in the world, by id


class LabelledLog(HDF5Log):
    """A scene with labels and the ids of objects."""

    def truth(self, index: int) -> Truth:
        """Mean velocity of the labelled points of each object."""
        sweep, after, labels = self.sweep(index), self.sweep(index + 1), self.labels(index)
        seconds = (self.timestamps[index + 1] - self.timestamps[index]) * 1e-9
        residual = labels.flow - ego_motion_flow(sweep.points, np.linalg.inv(after.pose) @ sweep.pose)
        object_id = np.where(labels.is_valid, self.values(index, "flow_instance_id"), 0).astype(np.int64)
        count = np.bincount(object_id).clip(1)
        velocity = np.stack([np.bincount(object_id, each) / count for each in residual.T], 1) / seconds
        velocity[0] = 0
        return Truth(object_id, labels.is_valid, velocity @ after.pose[:3, :3].T)


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

    def truth(self, index: int) -> Truth:
        """Velocity of each body to the next sweep."""
        times = (np.array(self.timestamps[index : index + 2]) - self.timestamps[0]) * 1e-9
        now, then = self.drive.scene.body_poses(times)[:, :, :3, 3]
        velocity = np.concatenate([np.zeros((1, 3)), (then - now) / (times[1] - times[0])])
        solid = self.drive.returns(index * self.step).solid.numpy()
        body = np.append(self.drive.scene.table.body, len(now))[solid]
        return Truth(np.where(body < len(now), body + 1, 0), np.ones(len(body), bool), velocity)


def score(log: LabelledLog | SimulatedLog, model: VerifiedFlow) -> Row:
    """Counts and errors of a drive, to be summed."""
    read = log if log.sweep(0).is_ground is not None else GroundSegmentedLog(log, "grid")
    tracker, tables, sweeps = Tracker(), [], []
    for index, given in enumerate(windows(read, model.config.num_history, model.config.num_future)):
        flow = model([given])[0]
        table, track_id = tracker.push(given, flow)
        tables.append({**table, "sweep": np.full(len(table["id"]), index)})
        sweeps.append((flow.numpy(), np.asarray(given.pc1.pose)[:3, :3], track_id, log.truth(index)))
    kept = confirmed(join_tables(tables))
    counts: Row = dict.fromkeys(("objects", "moved", "tracked", "switches", "boxes", "false"), 0)
    counts.update(sweeps=len(sweeps), single=[], tracks=[])
    last: dict[int, int] = {}
    for index, (flow, rotation, track_id, truth) in enumerate(sweeps):
        rows = {name: values[kept["sweep"] == index] for name, values in kept.items()}
        seconds = (log.timestamps[index + 1] - log.timestamps[index]) * 1e-9
        moves = np.linalg.norm(flow["residual_flow"], axis=1) >= MOVING
        for row in rows["id"][rows["is_moving"]]:
            on_track = track_id == row
            if truth.is_known[on_track].mean() > 0.5:
                is_moving = np.isin(truth.object_id[on_track & truth.is_known], moving(truth))
                counts["boxes"] += 1
                counts["false"] += is_moving.mean() < 0.5
        for each in moving(truth):
            on_object = flow["is_valid"] & (truth.object_id == each)
            if on_object.sum() < POINTS:
                continue
            counts["objects"] += 1
            counts["moved"] += (on_object & moves).any()
            found = Counter(track_id[on_object & np.isin(track_id, rows["id"])].tolist())
            if not found:
                continue
            track = found.most_common(1)[0][0]
            counts["tracked"] += 1
            counts["switches"] += last.get(each, track) != track
            last[each] = track
            on_track = moves & (track_id == track)
            if on_track.any():
                row = np.flatnonzero(rows["id"] == track)[0]
                filtered = np.array([rows["vx"][row], rows["vy"][row]])
                single = rotation @ flow["residual_flow"][on_track].mean(0) / seconds
                for name, velocity in (("single", single[:2]), ("tracks", filtered)):
                    counts[name].append(float(np.linalg.norm(velocity - truth.velocity[each, :2])))
    return counts


def moving(truth: Truth) -> np.ndarray:
    """Ids of the objects that move."""
    return np.flatnonzero(np.linalg.norm(truth.velocity, axis=1) >= SPEED)


def summary(name: str, parts: list[Row]) -> Row:
    """A row of the table."""
    total = {key: sum((part[key] for part in parts[1:]), parts[0][key]) for key in parts[0]}
    return {
        "drive": name,
        "sweeps": total["sweeps"],
        "objects x sweeps": total["objects"],
        "moved by the flow, %": 100 * total["moved"] / max(1, total["objects"]),
        "coverage, %": 100 * total["tracked"] / max(1, total["objects"]),
        "id switches": total["switches"],
        "boxes a sweep": total["boxes"] / total["sweeps"],
        "false boxes a sweep": total["false"] / total["sweeps"],
        "velocity, single": float(np.median(total["single"] or [np.nan])),
        "velocity, tracks": float(np.median(total["tracks"] or [np.nan])),
    }


def main() -> None:
    """Estimate, track, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="*", type=Path)
    parser.add_argument("--simulated", nargs="*", default=(), choices=tuple(FORMATS), metavar="SENSOR")
    parser.add_argument("--model", default="default", help="preset")
    parser.add_argument("--num-sweeps", type=int, default=20, help="of a simulated drive")
    given = parser.parse_args()
    torch.set_num_threads(1)
    model = make_model(make_config(given.model), "auto")
    files = [file for path in given.paths for file in find_hdf5_scenes(path)]
    rows = [summary(file.stem, [score(LabelledLog(file), model)]) for file in files]
    for sensor in given.simulated:
        drives = [SimulatedLog(sensor, seed, scene, given.num_sweeps) for seed, scene in DRIVES]
        rows.append(summary(f"simulated {sensor}", [score(log, model) for log in drives]))
    print(markdown(rows))


if __name__ == "__main__":
    main()
