"""Score tracks on labelled HDF5 scenes and on simulated drives. docs/applications.md explains the columns.

python scripts/benchmarks/tracks.py DATA/pandaset-002 DATA/kitti-0000/kitti-0000-c2.h5     scenes, or folders of them
python scripts/benchmarks/tracks.py --simulated av2 nuscenes --num-sweeps 12               a street and a crossing each

The drives have the seeds 300 and 301; we chose settings of the tracker on 400, 401 and 700 to 703. Ground masks are
exact where the data set has masks, and estimated by grid elsewhere. nuScenes is read at 10 Hz. We score confirmed
tracks, and only boxes most of whose points have labels. The id of an object switches when another track has most of its
points. The errors of the velocity are horizontal.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from typing import Any, Dict

import numpy as np
import torch
from labelled import SENSORS, LabelledLog, SimulatedLog, Truth, open_scenes
from table import markdown

from cflow_torch import Tracker, VerifiedFlow, make_config, make_model
from cflow_torch.applications.moving_groups import MOVING
from cflow_torch.applications.track_table import confirmed, join_tables
from cflow_torch.data.catalog import GroundSegmentedLog
from cflow_torch.data.log import windows

DRIVES = ((300, "street"), (301, "crossing"))
SPEED, POINTS = 0.5, 20  # m/s and points, least of a scored object
Row = Dict[str, Any]


def score(log: LabelledLog | SimulatedLog, model: VerifiedFlow) -> Row:
    """Counts and errors of a drive, to be summed."""
    tracker, tables, sweeps = Tracker(), [], []
    for index, given in enumerate(windows(GroundSegmentedLog(log), model.config.num_history, model.config.num_future)):
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="*", type=Path)
    parser.add_argument("--simulated", nargs="*", default=(), choices=SENSORS, metavar="SENSOR")
    parser.add_argument("--num-sweeps", type=int, default=20, help="of a simulated drive")
    given = parser.parse_args()
    torch.set_num_threads(1)
    model = make_model(make_config("default"), "auto")
    rows = [summary(log.log_id, [score(log, model)]) for log in open_scenes(given.paths)]
    for sensor in given.simulated:
        drives = [SimulatedLog(sensor, seed, scene, given.num_sweeps) for seed, scene in DRIVES]
        rows.append(summary(f"simulated {sensor}", [score(log, model) for log in drives]))
    print(markdown(rows))


if __name__ == "__main__":
    main()
