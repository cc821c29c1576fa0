#!/usr/bin/env python3
"""Confidence of the flow (docs/verified.md): fit its table on simulated drives, and evaluate it on others.

  python scripts/ablation/calibrate_confidence.py fit CACHE                 writes verified/confidence.json
  python scripts/ablation/calibrate_confidence.py evaluate CACHE --seeds 300 301 302 303 --figure docs/confidence.png
  python scripts/ablation/calibrate_confidence.py evaluate --real             Argoverse 2 pair, KITTI 0000 (CFLOW_DATA)

CACHE is a folder for the simulated drives. The windows come from sets.py: five sensors, four kinds of scenes, pairs
(h = 0) and history (h = 4), region +-70 m, without ground. We fit on seeds 100 ... 103. A point is right if the
end-point error of its residual flow is below 0.1 m per interval.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Iterable, Iterator, Sequence

import numpy as np
import sets
import torch
from derived_sets import MOVES
from sets import Item
from sklearn.isotonic import isotonic_regression

from cflow_torch import make_config, make_model
from cflow_torch.types import FlowResult
from cflow_torch.verified import confidence

RIGHT = 0.1  # metres
DROPPED = (0.0, 0.05, 0.1, 0.2, 0.3, 0.5)
NUM_BINS = 10  # of the reliability table
MAX_POINTS = 3000  # per window and bin in the fit, so that one large vehicle does not decide it
BOX = (-70.0, -70.0, -math.inf, 70.0, 70.0, math.inf)
TABLE_FILE = Path(confidence.__file__).with_name("confidence.json")
# Columns of the statistics, sums over the points of a bin: all points, and dynamic ones.
POINTS, RIGHT_ONES, DYNAMIC, RIGHT_DYNAMIC, ERROR, DYNAMIC_ERROR = range(6)


def simulated(cache: Path, seeds: Sequence[int]) -> Iterator[Item]:
    """Simulated windows of all sensors."""
    for profile in sets.PROFILES:
        yield from sets.simulated(profile, tuple(seeds), cache)


def kitti() -> Iterator[Item]:
    """Windows of both parts of KITTI 0000 with the whole history."""
    for path in (sets.KITTI, sets.KITTI_LATER):
        yield from sets.kitti(path)[sets.HISTORY :]


def statistics(items: Iterable[Item], histories: Sequence[int], max_points: float = math.inf) -> np.ndarray:
    """(C, 6) float64: sums over the points of each of the C bins of the table.

    Args:
        items: with h = 4.
        histories: each window is evaluated with each of these h.
        max_points: weight of a window in a bin; if it has more points, all of them get less weight.
    """
    num_bins = len(confidence.TABLE["probabilities"])
    kept, sums = confidence.TABLE["probabilities"], np.zeros((num_bins, 6))
    models = {h: make_model(make_config("default", num_history=h, point_cloud_range=BOX)) for h in histories}
    confidence.TABLE["probabilities"] = [i / num_bins for i in range(num_bins)]  # the result encodes the bin
    try:
        for number, item in enumerate(items, 1):
            for h, model in models.items():
                (result,) = model([replace(item.window, pch=item.window.pch[:h], pcf=())])
                of_window = _sums(result, item, num_bins)
                sums += of_window * np.minimum(1, max_points / np.maximum(of_window[:, :1], 1))
            print(f"\r{number} windows", end="", file=sys.stderr, flush=True)
    finally:
        confidence.TABLE["probabilities"] = kept
    print(file=sys.stderr)
    return sums


def _sums(result: FlowResult, item: Item, num_bins: int) -> np.ndarray:
    flow, truth = result.numpy(), item.labels.flow - item.pose_flow
    is_scored = item.labels.is_valid if item.eval_mask is None else item.labels.is_valid & item.eval_mask
    rows = np.flatnonzero(flow["is_valid"] & is_scored)
    bins = np.rint(flow["confidence"][rows] * num_bins).astype(int)
    error = np.linalg.norm(flow["residual_flow"][rows] - truth[rows], axis=1)
    moves = np.linalg.norm(truth[rows], axis=1) >= MOVES
    right = error < RIGHT
    columns = (np.ones(len(rows)), right, moves, right & moves, error, error * moves)
    return np.stack([np.bincount(bins, column, num_bins) for column in columns], 1)


def fit(sums: np.ndarray) -> list[float]:
    """Probability of each bin: share of right points, made monotonic along each row of the table."""
    table = confidence.TABLE
    sizes = [1, 1 + len(table["crowd"]), 1 + len(table["share"])] + 4 * [1 + len(table["margin"])]
    starts = np.cumsum([0, *sizes])
    result: list[float] = []
    for row, (start, end) in enumerate(zip(starts, starts[1:])):
        points, right = sums[start:end, POINTS], sums[start:end, RIGHT_ONES]
        prior = right.sum() / max(points.sum(), 1)
        share = (right + prior) / (points + 1)
        is_falling = row == 1  # the more is unlinked, the worse
        rising = isotonic_regression(-share if is_falling else share, sample_weight=points + 1)
        result += [min(round(abs(float(value)), 4), 0.9999) for value in rising]  # nothing is certain
    return result


def reliability(sums: np.ndarray, dynamic: bool = False) -> tuple[list[tuple[float, float, int]], float]:
    """Mean confidence, share of right points and number of points by tenths of confidence; calibration error."""
    predicted = np.array(confidence.TABLE["probabilities"])
    points, right = sums[:, [DYNAMIC, RIGHT_DYNAMIC] if dynamic else [POINTS, RIGHT_ONES]].T
    tenth = np.minimum((predicted * NUM_BINS).astype(int), NUM_BINS - 1)
    rows, gap = [], 0.0
    for i in range(NUM_BINS):
        inside = tenth == i
        number = points[inside].sum()
        if number:
            rows.append(((predicted * points)[inside].sum() / number, right[inside].sum() / number, int(number)))
            gap += abs(rows[-1][0] - rows[-1][1]) * number
    return rows, gap / max(points.sum(), 1)


def sparsification(sums: np.ndarray, dynamic: bool, shares: Sequence[float]) -> list[float]:
    """Mean error after a share of the points is dropped, the least confident first. Ties: dropped proportionally.

    Args:
        sums: result of `statistics`.
        dynamic: True = dynamic points, False = static ones.
        shares: of these points, from 0 to below 1.
    """
    order = np.argsort(confidence.TABLE["probabilities"], kind="stable")
    points, error = sums[order, DYNAMIC], sums[order, DYNAMIC_ERROR]
    if not dynamic:
        points, error = sums[order, POINTS] - points, sums[order, ERROR] - error
    mean = error / np.maximum(points, 1)
    before = np.concatenate(([0.0], np.cumsum(points)[:-1]))
    result = []
    for share in shares:
        left = np.clip(before + points - share * points.sum(), 0, points)
        result.append(float((mean * left).sum() / max(left.sum(), 1)))
    return result


def report(name: str, sums: np.ndarray) -> None:
    """Print the calibration of a set."""
    rows, gap = reliability(sums)
    print(f"\n### {name}\n\nExpected calibration error {gap:.4f}; of dynamic points {reliability(sums, True)[1]:.3f}\n")
    print("| mean confidence | share right | points |\n|---|---|---|")
    for mean, share, number in rows:
        print(f"| {mean:.3f} | {share:.3f} | {number} |")
    print(f"\n| dropped | {' | '.join(f'{100 * share:.0f} %' for share in DROPPED)} |\n|{'---|' * (1 + len(DROPPED))}")
    for kind, dynamic in (("dynamic", True), ("static", False)):
        values = sparsification(sums, dynamic, DROPPED)
        print(f"| {kind} EPE, m | {' | '.join(f'{value:.4f}' for value in values)} |")


def draw(sums_of: dict[str, np.ndarray], path: Path) -> None:
    """Draw the reliability, and the error over the dropped share, with a line per set."""
    from matplotlib.figure import Figure

    styles = ({"color": "blue", "marker": "o"}, {"color": "orange", "marker": "s"}, {"color": "green", "marker": "^"})
    figure = Figure(figsize=(13, 4.2), layout="constrained")
    diagram, moving, static = figure.subplots(1, 3)
    diagram.plot([0, 1], [0, 1], color="0.6", linestyle="--", label="ideal")
    shares = np.linspace(0, 0.5, 26)
    for (name, sums), style in zip(sums_of.items(), styles):
        rows, gap = reliability(sums)
        diagram.plot([r[0] for r in rows], [r[1] for r in rows], label=f"{name}: error {gap:.3f}", **style)
        for axes, dynamic in ((moving, True), (static, False)):
            axes.plot(100 * shares, sparsification(sums, dynamic, shares), label=name, markevery=5, **style)
    diagram.set(xlabel="confidence", ylabel="share of points right to 0.1 m", title="Reliability", xlim=(0, 1.02))
    moving.set(xlabel="least confident dropped, %", ylabel="EPE, m", title="Dynamic points")
    static.set(xlabel="least confident dropped, %", ylabel="EPE, m", title="Static points")
    for axes in (diagram, moving, static):
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=9)
    figure.savefig(path, dpi=110)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=("fit", "evaluate"))
    parser.add_argument("cache", type=Path, nargs="?", help="folder of the simulated drives")
    parser.add_argument("--seeds", type=int, nargs="+", default=[100, 101, 102, 103])
    parser.add_argument("--real", action="store_true", help="evaluate: also on real data")
    parser.add_argument("--figure", type=Path, help="evaluate: PNG to draw")
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    if args.task == "fit":
        sums = statistics(simulated(args.cache, args.seeds), (0, 4), MAX_POINTS)
        table = {**confidence.TABLE, "probabilities": fit(sums)}
        TABLE_FILE.write_text(json.dumps(table) + "\n", encoding="utf-8")
        return
    sums_of: dict[str, np.ndarray] = {}
    for h in (0, sets.HISTORY) if args.cache is not None else ():
        sums_of[f"simulated, h = {h}"] = statistics(simulated(args.cache, args.seeds), (h,))
    if args.real:
        pair = [sets.make_item(item.window, item.labels) for item in sets.av2_pair()]  # ego motion of the poses
        sums_of["Argoverse 2 pair"] = statistics(pair, (0,))
        for h in (0, sets.HISTORY):
            sums_of[f"KITTI 0000, h = {h}"] = statistics(kitti(), (h,))
    for name, sums in sums_of.items():
        report(name, sums)
    if args.figure is not None:
        draw(sums_of, args.figure)


if __name__ == "__main__":
    main()
