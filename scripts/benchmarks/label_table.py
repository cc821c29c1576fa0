#!/usr/bin/env python3
"""Labels of moving points beside DUFOMap and HDBSCAN: precision, recall, processor time, in one run, in turn.

  python scripts/benchmarks/label_table.py                                     simulated drives of five sensors
  python scripts/benchmarks/label_table.py --peer-python VENV/bin/python --scenes DATA/kitti-0000 --json FILE

Scored: labelled points within 50 m that are no ground; those with a true residual of at least 0.05 m a sweep move. The
peers (`pip install dufomap hdbscan h5py`) compute in a process of their own with the settings of OpenSceneFlow's
process.py, on one thread. Ours includes `nnd`, theirs has none. Seconds: of the processor, a sweep, read and written
data excluded, median over scenes of a row.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Dict, List

import numpy as np

SENSORS = ("av2", "nuscenes", "waymo", "truckscenes", "aevascenes")
SCENES = ("street", "crossing")
SEEDS = (300, 301, 302, 303)  # settings were chosen on 100 to 103
RANGE = 50.0


def peer(file: str) -> Dict[str, Any]:
    """DUFOMap and HDBSCAN on a scene: labels to a file beside it, seconds."""
    import h5py
    from dufomap import dufomap
    from hdbscan import HDBSCAN

    with h5py.File(file, "r") as scene:
        groups = [scene[stamp] for stamp in sorted(scene, key=int)]
        extrinsics = scene.attrs.get("ego_T_lidar", np.eye(4))
        points = [group["lidar"][:, :3].astype(np.float32) for group in groups]
        ground = [group["ground_mask"][()].astype(bool) for group in groups]
        poses = [group["pose"][()].astype(np.float64) @ extrinsics for group in groups]
    poses = [np.linalg.inv(poses[0]) @ pose for pose in poses]
    start = time.process_time()
    found = dufomap(0.15, 0.2, 1, num_threads=1)
    found.setCluster(0, 20, 0.2)
    for sweep, pose in zip(points, poses):
        distance = np.linalg.norm(sweep, axis=1)
        found.run(sweep[(distance > 2) & (distance < RANGE)], pose, cloud_transform=True)
    found.oncePropagateCluster(if_cluster=True, if_propagate=True)
    dufo = [(found.segment(p, pose, cloud_transform=True) > 0) & ~g for p, g, pose in zip(points, ground, poses)]
    middle = time.process_time()
    settings = {"min_cluster_size": 20, "cluster_selection_epsilon": 0.7, "core_dist_n_jobs": 1}
    for sweep, is_ground, moves in zip(points, ground, dufo):
        HDBSCAN(alpha=1.1, **settings).fit_predict(sweep[~is_ground])
        if moves.sum() >= 20:
            HDBSCAN(**settings).fit_predict(sweep[moves])
    end = time.process_time()
    np.savez(file + ".npz", *dufo)
    return {"dufomap": (middle - start) / len(points), "hdbscan": (end - middle) / len(points)}


def ours(file: str, presets: List[str]) -> Dict[str, Any]:
    """Labels of a scene by each preset, with their seconds a sweep."""
    import torch
    from scipy import spatial  # noqa: F401 (not to be timed)

    from cflow_torch import make_config, make_model
    from cflow_torch.applications.labels import find_labels
    from cflow_torch.data.hdf5 import HDF5Log
    from cflow_torch.data.log import RecentSweeps, window, windows

    torch.set_num_threads(1)
    answer = {}
    for preset in presets:
        model = make_model(make_config(preset), "cpu")
        log = HDF5Log(file)
        held = RecentSweeps(log, len(log))
        sweeps = list(held)
        model([window(held, 0)])
        start = time.process_time()
        flows = (model([w])[0] for w in windows(held, model.config.num_history, model.config.num_future))
        labels = [each["dufo"] > 0 for _, each in find_labels(held, flows, model)]
        answer[preset] = {"seconds": (time.process_time() - start) / len(sweeps), "counts": counts(log, labels)}
    return answer


def counts(log: Any, labels: Any) -> List[int]:
    """Points that move and are found, are not and are found, move and are missed."""
    total = np.zeros(3, np.int64)
    for index, found in enumerate(labels):
        sweep, truth = log.sweep(index), log.labels(index)
        if truth is None:
            continue
        T = np.linalg.inv(log.sweep(index + 1).pose) @ sweep.pose
        points = sweep.points.astype(np.float64)
        residual = truth.flow - (points @ T[:3, :3].T + T[:3, 3] - points)
        counts_here = truth.is_valid & ~sweep.is_ground & (np.linalg.norm(points[:, :2], axis=1) <= RANGE)
        moves = np.linalg.norm(residual, axis=1) >= 0.05
        total += [(counts_here & a & b).sum() for a, b in ((found, moves), (found, ~moves), (~found, moves))]
    return [int(each) for each in total]


def simulated(folder: Path, num_sweeps: int) -> Dict[str, List[Path]]:
    """Scenes of drives of each sensor."""
    from cflow_torch.data.catalog import open_log
    from cflow_torch.data.hdf5 import write_hdf5_scene
    from cflow_torch.simulator.benchmark import benchmark_logs, format_of

    rows: Dict[str, List[Path]] = {}
    for sensor in SENSORS:
        made = format_of(sensor)
        for seed in SEEDS if sensor == "av2" else SEEDS[:2]:
            scene = ("street", "highway", "crossing", "narrow")[seed % 4] if sensor == "av2" else SCENES[seed % 2]
            file = folder / f"{sensor}-{scene}-{seed}.h5"
            if not file.exists():
                (source,) = benchmark_logs(folder / "cache", sensor, [seed], num_sweeps, [scene])
                write_hdf5_scene(open_log(made.data_set, source, check=False, **made.settings), file)
            rows.setdefault(f"simulated {sensor}", []).append(file)
    return rows


def asked(python: str, call: str, *arguments: str) -> Any:
    """The answer of a process of its own; None if what it needs is not installed."""
    done = subprocess.run([python, __file__, "--" + call, *arguments], capture_output=True, text=True)
    if "ModuleNotFoundError" in done.stderr:
        print(done.stderr.strip().splitlines()[-1], file=sys.stderr)
        return None
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def score(rows: List[Any]) -> str:
    """Precision and recall of counts."""
    found, false, missed = np.sum(rows, 0)
    return f"{found / max(found + false, 1):.3f} | {found / max(found + missed, 1):.3f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer-python", default=sys.executable, help="interpreter that has the peers")
    parser.add_argument("--scenes", type=Path, nargs="*", default=[], help="labelled HDF5 scenes, or folders of them")
    parser.add_argument("--no-simulated", action="store_true")
    parser.add_argument("--presets", nargs="+", default=["offline", "fast"])
    parser.add_argument("--num-sweeps", type=int, default=8)
    parser.add_argument("--folder", type=Path, help="keeps the simulated scenes")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--peer", help=argparse.SUPPRESS)
    parser.add_argument("--ours", nargs="+", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.peer or chosen.ours:
        print(json.dumps(peer(chosen.peer) if chosen.peer else ours(chosen.ours[0], chosen.ours[1:])))
        return
    from cflow_torch.data.hdf5 import HDF5Log, find_hdf5_scenes

    with tempfile.TemporaryDirectory() as scratch:
        folder = chosen.folder or Path(scratch)
        rows = {} if chosen.no_simulated else simulated(folder, chosen.num_sweeps)
        for place in chosen.scenes:
            rows.update({file.stem: [file] for file in find_hdf5_scenes(place)})
        results: Dict[str, Any] = {}
        has_peers = True
        for row, files in rows.items():
            for file in files:
                answer = asked(sys.executable, "ours", str(file), *chosen.presets)
                copy = Path(scratch) / file.name  # the peer's labels lie beside it
                copy.symlink_to(file.resolve())
                theirs = asked(chosen.peer_python, "peer", str(copy)) if has_peers else None
                has_peers = theirs is not None
                if theirs is not None:
                    with np.load(f"{copy}.npz") as stored, HDF5Log(file) as log:
                        theirs["counts"] = counts(log, [stored[f"arr_{k}"] for k in range(len(stored))])
                copy.unlink()
                results.setdefault(row, []).append({"file": file.name, **answer, "peers": theirs})
                print(json.dumps(results[row][-1]), file=sys.stderr, flush=True)
    if chosen.json:
        chosen.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    report(results, chosen.presets)


def report(results: Dict[str, Any], presets: List[str]) -> None:
    """Print the table."""
    heads = [f"{name}: precision | recall | s" for name in presets]
    print(
        "| scenes | "
        + " | ".join([*heads, "DUFOMap: precision | recall", "DUFOMap s", "HDBSCAN s", "times faster"])
        + " |"
    )
    print("|---" * (5 + 3 * len(presets) + 1) + "|")
    for row, scenes in results.items():
        seconds = {p: statistics.median(each[p]["seconds"] for each in scenes) for p in presets}
        cells = [f"{score([each[p]['counts'] for each in scenes])} | {seconds[p]:.2f}" for p in presets]
        peers = [each["peers"] for each in scenes]
        if None in peers:
            cells += ["not installed | ", "", "", ""]
        else:
            dufo, hdb = (statistics.median(each[name] for each in peers) for name in ("dufomap", "hdbscan"))
            faster = ", ".join(f"{(dufo + hdb) / seconds[p]:.1f}" for p in presets)
            cells += [score([each["counts"] for each in peers]), f"{dufo:.2f}", f"{hdb:.2f}", faster]
        print(f"| {row} ({len(scenes)}) | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
