#!/usr/bin/env python3
"""Compare labels of moving points with DUFOMap and HDBSCAN: precision, recall and processor time.

  python scripts/benchmarks/label_table.py                                     simulated drives of five sensors
  python scripts/benchmarks/label_table.py --peer-python VENV/bin/python --scenes DATA/kitti-0000 --json FILE

We score labelled points within 50 m that are not ground. A point moves if its true residual flow is at least 0.05 m per
sweep. DUFOMap and HDBSCAN run in a separate process (peers.py). Our time includes `nnd`, which they do not compute.
Times are processor seconds per sweep without reading and writing, medians over the scenes of a row.
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
from typing import Any, Sequence

import numpy as np
import torch
from peers import RANGE
from scipy import spatial  # noqa: F401 (its import is not timed)
from table import markdown

from cflow_torch import make_config, make_model
from cflow_torch.applications.labels import find_labels
from cflow_torch.applications.moving_groups import MOVING
from cflow_torch.data.catalog import open_log
from cflow_torch.data.hdf5 import HDF5Log, find_hdf5_scenes, write_hdf5_scene
from cflow_torch.data.log import CachedLog, window, windows
from cflow_torch.evaluation.frame import ego_motion_flow
from cflow_torch.simulator.benchmark import FORMATS, benchmark_logs

SCENES = ("street", "crossing")
SEEDS = (300, 301, 302, 303)  # settings were chosen on 100 to 103


def ours(file: Path, preset: str) -> dict[str, Any]:
    """Label a scene by a preset; returns the counts, and seconds per sweep."""
    model, log = make_model(make_config(preset), "cpu"), HDF5Log(file)
    cached = CachedLog(log, len(log))
    sweeps = list(cached)  # read before the clock starts
    model([window(cached, 0)])
    start = time.process_time()
    flows = (model([w])[0] for w in windows(cached, model.config.num_history, model.config.num_future))
    labels = [each["dufo"] > 0 for _, each in find_labels(cached, flows, model)]
    return {"seconds": (time.process_time() - start) / len(sweeps), "counts": counts(log, labels)}


def theirs(file: Path, python: str, scratch: str) -> Any:
    """Label a scene by DUFOMap; returns the counts, and seconds of DUFOMap and HDBSCAN. None if not installed."""
    labels = Path(scratch) / "labels.npz"
    call = [python, Path(__file__).with_name("peers.py"), file, labels]
    done = subprocess.run(list(map(str, call)), capture_output=True, text=True)
    if "ModuleNotFoundError" in done.stderr:
        print(done.stderr.strip().splitlines()[-1], file=sys.stderr)
        return None
    if done.returncode:
        raise SystemExit(done.stderr)
    with np.load(labels) as stored, HDF5Log(file) as log:
        found = [stored[f"arr_{k}"] for k in range(len(stored))]
        return {**json.loads(done.stdout.splitlines()[-1]), "counts": counts(log, found)}


def counts(log: Any, labels: Sequence[np.ndarray]) -> list[int]:
    """Numbers of true positive, false positive and false negative points."""
    total = np.zeros(3, np.int64)
    for index, found in enumerate(labels):
        sweep, truth = log.sweep(index), log.labels(index)
        if truth is None:
            continue
        pose_flow = ego_motion_flow(sweep.points, np.linalg.inv(log.sweep(index + 1).pose) @ sweep.pose)
        is_scored = truth.is_valid & ~sweep.is_ground & (np.linalg.norm(sweep.points[:, :2], axis=1) <= RANGE)
        moves = np.linalg.norm(truth.flow - pose_flow, axis=1) >= MOVING
        total += [(is_scored & a & b).sum() for a, b in ((found, moves), (found, ~moves), (~found, moves))]
    return [int(each) for each in total]


def simulated(folder: Path, num_sweeps: int) -> dict[str, list[Path]]:
    """Write scenes of simulated drives of each sensor."""
    rows: dict[str, list[Path]] = {}
    for sensor, made in FORMATS.items():
        for seed in SEEDS if sensor == "av2" else SEEDS[:2]:
            scene = ("street", "highway", "crossing", "narrow")[seed % 4] if sensor == "av2" else SCENES[seed % 2]
            file = folder / f"{sensor}-{scene}-{seed}.h5"
            if not file.exists():
                (source,) = benchmark_logs(folder / "cache", sensor, [seed], num_sweeps, [scene])
                write_hdf5_scene(open_log(made.data_set, source, check=False, **made.settings), file)
            rows.setdefault(f"simulated {sensor}", []).append(file)
    return rows


def score(parts: Sequence[dict[str, Any]]) -> str:
    """Precision and recall over several scenes."""
    found, false, missed = np.sum([part["counts"] for part in parts], 0)
    return f"{found / max(found + false, 1):.3f}, {found / max(found + missed, 1):.3f}"


def table_row(name: str, scenes: list[dict[str, Any]], presets: Sequence[str]) -> dict[str, Any]:
    """A row of the table."""
    row: dict[str, Any] = {"precision, recall": f"{name} ({len(scenes)})"}
    seconds = {preset: statistics.median(each[preset]["seconds"] for each in scenes) for preset in presets}
    for preset in presets:
        row[preset], row[f"{preset}, s"] = score([each[preset] for each in scenes]), f"{seconds[preset]:.2f}"
    peers = [each["peers"] for each in scenes]
    if None in peers:
        return {**row, "DUFOMap": "not installed"}
    dufo, hdb = (statistics.median(each[name] for each in peers) for name in ("dufomap", "hdbscan"))
    faster = ", ".join(f"{(dufo + hdb) / seconds[preset]:.1f}" for preset in presets)
    return {**row, "DUFOMap": score(peers), "DUFOMap, s": f"{dufo:.2f}", "HDBSCAN, s": f"{hdb:.2f}", "faster": faster}


def main() -> None:
    """Simulate, label, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer-python", default=sys.executable, help="interpreter that has the peers")
    parser.add_argument("--scenes", type=Path, nargs="*", default=[], help="labelled HDF5 scenes, or folders of them")
    parser.add_argument("--no-simulated", action="store_true")
    parser.add_argument("--presets", nargs="+", default=["offline", "fast"])
    parser.add_argument("--num-sweeps", type=int, default=8)
    parser.add_argument("--folder", type=Path, help="keeps the simulated scenes")
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    results: dict[str, list[dict[str, Any]]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        rows = {} if chosen.no_simulated else simulated(chosen.folder or Path(scratch), chosen.num_sweeps)
        for path in chosen.scenes:
            rows.update({file.stem: [file] for file in find_hdf5_scenes(path)})
        for row, files in rows.items():
            for file in files:
                result = {"file": file.name, **{preset: ours(file, preset) for preset in chosen.presets}}
                result["peers"] = theirs(file, chosen.peer_python, scratch)
                results.setdefault(row, []).append(result)
                print(json.dumps(result), file=sys.stderr, flush=True)
    if chosen.json:
        chosen.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    print(markdown([table_row(name, scenes, chosen.presets) for name, scenes in results.items()]))


if __name__ == "__main__":
    main()
