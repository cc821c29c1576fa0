#!/usr/bin/env python3
"""Compare scene flow of this package with that of other methods without training: error and processor time.

  python scripts/benchmarks/peers.py DATA/*.h5 DATA/av2/val --json rows.json
  python scripts/benchmarks/peers.py DATA/*.h5 --opensceneflow PATH --methods icpflow nsfp --json rows.json

  pip install open3d-cpu hdbscan h5py                                   # `clusters`
  pip install dztimer lightning torchmetrics tabulate                   # OpenSceneFlow's models, also the above

Methods: presets of this package; `zero`; `clusters` (HDBSCAN, and Open3D's ICP for each cluster); `icpflow`, `nsfp`,
`fastnsf` of a checkout of OpenSceneFlow (848bf86) with the settings of its YAML files, on a CPU (opensceneflow_cpu.py).
A method whose package is missing is skipped.

All methods get the same points: both sweeps in the frame of t+1, without ground, within 35 m (a square). Our presets
get the sweeps with the ground mask and the same region. We score labelled points that are not ground. Each set has the
windows 4, 12, 20, ... , or window 0 if it is short; with `--history 0 4` our presets also run with four older sweeps.
Processor time is that of the process, on one thread.
docs/benchmarks.md explains the columns, which are means over the sets of the mean over the windows.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any, Callable, Iterator, NamedTuple, Sequence

import numpy as np
import torch
from opensceneflow_cpu import load_models
from table import markdown

from cflow_torch import make_config, make_model
from cflow_torch.data.catalog import find_sources, open_log, recognise
from cflow_torch.data.json_file import read_json, write_json
from cflow_torch.data.log import window

sys.path.append(str(Path(__file__).resolve().parents[1] / "ablation"))
from run import pooled_figures, settings_of_set  # noqa: E402
from sets import NEAR, Item, make_item  # noqa: E402

OURS = ("default", "paper", "keypoints")
# Name -> class of the model in the checkout, whose YAML file has its name in lower case.
HARNESS = {"icpflow": "ICPFlow", "fastnsf": "FastNSF", "nsfp": "NSFP"}
METHODS = (*OURS, "zero", "clusters", *HARNESS)  # rows of the table in this order
SEED = 0  # of torch and NumPy, set before every window
START, EVERY = 4, 8  # first window, step between windows
RADIUS = 1.67  # metres, search radius of ICP-Flow in OpenSceneFlow
Method = Callable[["Case"], np.ndarray]


class Case(NamedTuple):
    """A window with its truth, and what the methods get."""

    item: Item  # the window, with ground masks
    rows: np.ndarray  # (N0',) int64, rows of sweep t that are not ground and within reach
    pc0: np.ndarray  # (N0', 3) float32 metres, frame of t+1
    pc1: np.ndarray  # (N1', 3) float32 metres, frame of t+1


def cases(path: Path, num_history: int, num_windows: int | None = None) -> Iterator[tuple[str, str, Case]]:
    """The chosen windows of the logs at a path, with the names of their sets and windows."""
    data_set = recognise(path)
    for source in find_sources(data_set, path):
        log = open_log(data_set, source, check=False)
        chosen = range(START, len(log) - 1, EVERY) or [0]
        for index in chosen[:num_windows]:
            labels = log.labels(index)
            if labels is not None:
                eval_mask = log.eval_mask(index)
                item = make_item(window(log, index, num_history), labels, eval_mask)
                yield log.log_id, f"{log.log_id}, {index}", make_case(item)


def make_case(item: Item) -> Case:
    """Compensate ego motion, and leave out ground and what is out of reach."""
    pc0, pc1 = item.window.pc0, item.window.pc1
    moved = (pc0.points + item.frame.pose_flow, pc1.points)
    rows = []
    for sweep, at in zip((pc0, pc1), moved):
        rows.append(np.flatnonzero(~sweep.is_ground & np.isfinite(at).all(1) & (np.abs(at[:, :2]) <= NEAR).all(1)))
    return Case(item, rows[0], moved[0][rows[0]], moved[1][rows[1]])


def preset(name: str, num_history: int) -> Method:
    model = make_model(make_config(name, **settings_of_set(name, num_history, NEAR)), "cpu")
    return lambda case: model([case.item.window])[0].numpy()["residual_flow"]


def on_rows(estimate: Callable[[Case], np.ndarray]) -> Method:
    """A method that returns the flow of `pc0` only; other points get zero."""

    def method(case: Case) -> np.ndarray:
        flow = np.zeros_like(case.item.frame.pose_flow)
        flow[case.rows] = estimate(case)
        return flow

    return method


def clusters(case: Case) -> np.ndarray:
    """Rigid motion of each cluster by point-to-point ICP, if 5 % more of its points match within 0.1 m than without."""
    import open3d
    from hdbscan import HDBSCAN

    def cloud(points: np.ndarray) -> Any:
        return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))

    registration = open3d.pipelines.registration
    label = HDBSCAN(min_cluster_size=20, core_dist_n_jobs=1).fit_predict(case.pc0)
    flow = np.zeros_like(case.pc0)
    for number in range(label.max() + 1):
        rows = label == number
        source = case.pc0[rows]
        low, high = source.min(0) - 2 * RADIUS, source.max(0) + 2 * RADIUS
        target = case.pc1[((case.pc1 >= low) & (case.pc1 <= high)).all(1)]
        if len(target) < 20:
            continue
        start, end, pose = cloud(source), cloud(target), np.eye(4)
        for radius in (RADIUS, 0.5, 0.2):
            pose = registration.registration_icp(start, end, radius, pose).transformation
        at_rest, moved = (registration.evaluate_registration(start, end, 0.1, T).fitness for T in (np.eye(4), pose))
        if moved > at_rest + 0.05:
            flow[rows] = source @ pose[:3, :3].T + pose[:3, 3] - source
    return flow


def of_harness(name: str, root: Path) -> Method:
    """A model of OpenSceneFlow with the settings of its YAML file."""
    from joblib import parallel_config
    from omegaconf import OmegaConf

    kind, models = HARNESS[name], load_models(root)
    if not hasattr(models, kind):
        raise ImportError(f"{kind}: a package of OpenSceneFlow is missing")
    settings: Any = OmegaConf.to_container(OmegaConf.load(root / "conf" / "model" / f"{kind.lower()}.yaml").target)
    del settings["_target_"]
    model = getattr(models, kind)(**settings)

    def estimate(case: Case) -> np.ndarray:
        clouds = {"pc0": [torch.from_numpy(case.pc0)], "pc1": [torch.from_numpy(case.pc1)]}  # compensated already
        with parallel_config("sequential"):  # its HDBSCAN would start processes, whose time is not that of this one
            return model({**clouds, "pose0": [torch.eye(4)], "pose1": [torch.eye(4)]})["flow"][0].numpy()

    return on_rows(estimate)


PLAIN = {"zero": lambda case: np.zeros_like(case.pc0), "clusters": clusters}


def make_method(name: str, num_history: int, opensceneflow: Path | None) -> Method:
    """A method by its name; an ImportError if a package is missing."""
    if name in OURS:
        return preset(name, num_history)
    if name in PLAIN:
        return on_rows(PLAIN[name])
    if opensceneflow is None:
        raise ImportError("give --opensceneflow PATH")
    return of_harness(name, opensceneflow)


def measure(method: Method, case: Case) -> dict[str, float]:
    torch.manual_seed(SEED)
    np.random.seed(SEED)
    begin = time.process_time()
    flow = method(case)
    seconds = time.process_time() - begin
    figures = pooled_figures([replace(case.item.frame, residual_flow=flow)])
    return {**{name: figures[name] for name in ("dynamic", "ratio", "static")}, "cpu": seconds}


def errors(rows: Sequence[dict[str, Any]]) -> str:
    """Dynamic error in metres, error over speed, static error in centimetres: mean over sets of that over windows."""
    if not rows:
        return ""
    of_sets: dict[str, list[list[float]]] = {}
    for row in rows:
        of_sets.setdefault(row["set"], []).append([row[column] for column in ("dynamic", "ratio", "static")])
    of_windows = (np.array(values, float) for values in of_sets.values())  # JSON has null for NaN
    dynamic, ratio, static = np.nanmean([np.nanmean(values, 0) for values in of_windows], 0)
    return f"{dynamic:.3f} / {ratio:.2f} / {100 * static:.1f}"


def table(rows: Sequence[dict[str, Any]]) -> str:
    """A Markdown table with a row per method; methods that miss windows have `default` on theirs in the last column."""
    older = {row["window"] for row in rows if row["history"] > 0}
    windows, lines = {row["window"] for row in rows}, []
    for name in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == name]
        pairs, longer = ([row for row in own if (row["history"] > 0) == is_longer] for is_longer in (False, True))
        seconds, older_seconds = (np.mean([row["cpu"] for row in some] or [np.nan]) for some in (pairs, longer))
        run = {row["window"] for row in pairs}
        same = [row for row in rows if (row["method"], row["history"]) == ("default", 0) and row["window"] in run]
        lines.append(
            {
                "method": name,
                "windows": f"{len(pairs)}",
                "two sweeps": errors(pairs),
                "CPU s": f"{seconds:.2f}" if pairs else "",
                "two sweeps, sets with older ones": errors([row for row in pairs if row["window"] in older]),
                "older sweeps": errors(longer),
                "CPU s, older sweeps": f"{older_seconds:.2f}" if longer else "",
                "`default` on these windows": errors(same) if run < windows else "",
            }
        )
    return markdown(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", type=Path, nargs="*", help="labelled scenes, or folders that a reader knows")
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS, metavar="NAME")
    parser.add_argument("--opensceneflow", type=Path, metavar="PATH", help="checkout of OpenSceneFlow")
    parser.add_argument("--history", type=int, nargs="+", default=(0, 4), help="numbers of older sweeps of our presets")
    parser.add_argument("--windows", type=int, help="at most so many windows of a set")
    parser.add_argument("--json", type=Path, help="file for the figures of every window; those of other runs are kept")
    given = parser.parse_args()
    torch.set_num_threads(1)
    key = itemgetter("window", "method", "history")
    rows = {key(row): row for row in (read_json(given.json) if given.json and given.json.is_file() else [])}
    runs = [(name, history) for name in given.methods for history in (given.history if name in OURS[:2] else (0,))]
    all_cases = [each for path in given.paths for each in cases(path, max(given.history), given.windows)]
    for name, history in runs:
        try:
            method = make_method(name, history, given.opensceneflow)
            for set_name, window_name, case in all_cases:
                if len(case.item.window.pch) >= history:
                    row = {"set": set_name, "window": window_name, "method": name, "history": history}
                    row.update(measure(method, case))
                    rows[key(row)] = row
                    print(json.dumps(row), file=sys.stderr, flush=True)
                    if given.json:
                        write_json(given.json, list(rows.values()))
        except ImportError as error:
            print(f"skipped {name}: {error}", file=sys.stderr)
    print(table(sorted(rows.values(), key=lambda row: (METHODS.index(row["method"]), row["history"]))))


if __name__ == "__main__":
    main()
