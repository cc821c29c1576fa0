#!/usr/bin/env python3
"""Confidence of the flow and P(moving): fit their tables on simulated drives, or evaluate them on other data.

  python scripts/ablation/calibrate_confidence.py fit           writes verified/confidence.json, two passes
  python scripts/ablation/calibrate_confidence.py fit-objects   the same, only the rows of objects with a motion
  python scripts/ablation/calibrate_confidence.py fit-low       the same, only the bin of points that are not drawn
  python scripts/ablation/calibrate_confidence.py evaluate      Argoverse 2 pair, KITTI 0000, PandaSet, simulated drives

The windows come from sets.py. We fit on pairs (h = 0) and history (h = 4) of five sensors, region +-70 m, without
ground: four kinds of scenes, seeds 100-103, and motorways, seeds 822-825. We evaluate on motorways, seeds 826-827, and
on drives with seeds 500-501. docs/verified.md explains the columns.

Points that are not drawn are low, and mostly ground that the mask misses. Simulated masks are exact, so we fit these
points on real drives as well: the Argoverse 2 pair, KITTI 0000, 0-15, and PandaSet 002, 0-27.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Iterable, Sequence
from unittest.mock import patch

import numpy as np
import sets
import torch
from sets import HISTORY, Item
from sklearn.isotonic import isotonic_regression

from cflow_torch import make_config, make_model
from cflow_torch.applications.moving_groups import MOVING
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.types import FlowResult
from cflow_torch.verified import confidence

SEEDS, MOTORWAYS = range(100, 104), range(822, 826)
OTHER_SEEDS, OTHER_MOTORWAYS = range(500, 502), range(826, 828)
TABLES = ("probabilities", "moving")  # of the confidence, of P(moving)
RIGHT = 0.1  # metres
DROPPED = (0.0, 0.05, 0.1, 0.3)
NUM_BINS = 10  # of the calibration error
MAX_POINTS = 3000  # per window and bin in the fit, so that one large vehicle does not decide it
BOX = (-70.0, -70.0, -math.inf, 70.0, 70.0, math.inf)
TABLE_FILE = Path(confidence.__file__).with_name("confidence.json")
# Columns of the statistics, sums over the points of a bin: all points, and dynamic ones.
POINTS, RIGHT_ONES, DYNAMIC, RIGHT_DYNAMIC, ERROR, DYNAMIC_ERROR, MISSED = range(7)
FALSE_ALARMS = 0.02  # share of static points


def statistics(items: Iterable[Item], histories: Sequence[int], max_points: float = math.inf) -> np.ndarray:
    """(C, 7) float64: sums over the points of each of the C bins of the table, for windows with each of some h.

    `max_points` is the weight of a window in a bin; if it has more points, all of them get less weight.
    """
    num_bins = len(confidence.TABLE["probabilities"])
    sums = np.zeros((num_bins, 7))
    models = [make_model(make_config("default", num_history=h, point_cloud_range=BOX)) for h in histories]
    encoded = [i / num_bins for i in range(num_bins)]  # so that the confidence of a point is the number of its bin
    with patch.dict(confidence.TABLE, probabilities=encoded):
        for window, frame in items:
            for model in models:
                (result,) = model([replace(window, pcf=())])
                of_window = _sums(result, frame, num_bins)
                sums += of_window * np.minimum(1, max_points / np.maximum(of_window[:, :1], 1))
    return sums


def _sums(result: FlowResult, frame: EvalFrame, num_bins: int) -> np.ndarray:
    flow, truth = result.numpy(), frame.labels.flow - frame.pose_flow
    is_scored = frame.labels.is_valid if frame.eval_mask is None else frame.labels.is_valid & frame.eval_mask
    rows = np.flatnonzero(flow["is_valid"] & is_scored)
    bins = np.rint(flow["confidence"][rows] * num_bins).astype(int)
    error = np.linalg.norm(flow["residual_flow"][rows] - truth[rows], axis=1)
    moves = np.linalg.norm(truth[rows], axis=1) >= MOVING
    right = error < RIGHT
    is_missed = moves & (2 * np.linalg.norm(flow["residual_flow"][rows], axis=1) < np.linalg.norm(truth[rows], axis=1))
    columns = (np.ones(len(rows)), right, moves, right & moves, error, error * moves, is_missed)
    return np.stack([np.bincount(bins, column, num_bins) for column in columns], 1)


def fit(sums: np.ndarray) -> dict[str, list[float]]:
    """Probability of each bin in both tables: share of points, made monotonic along each row of a table."""
    table = confidence.TABLE
    biases = len(table["bias"])
    sizes, shares, margins = (1 + len(table[name]) for name in ("size", "share", "margin"))
    # Lengths of rows, and whether the confidence falls along them: the more is unmatched or biased, the worse.
    rows = [
        *2 * [(1, False)],
        (biases, True),
        *2 * [(sizes, True)],
        *4 * [(shares, False)],
        *4 * [(1, False)],
        *8 * [(margins, False)],
    ]
    first_moving = len(rows) - 8
    result: dict[str, list[float]] = {name: [] for name in TABLES}
    start = 0
    for number, (length, is_falling) in enumerate(rows):
        of_row = sums[start : start + length]
        start += length
        result["probabilities"] += monotonic(of_row[:, POINTS], of_row[:, RIGHT_ONES], is_falling)
        grows = is_falling or number >= first_moving
        result["moving"] += monotonic(of_row[:, POINTS], of_row[:, DYNAMIC], not grows)
    return result


def monotonic(points: np.ndarray, hits: np.ndarray, is_falling: bool) -> list[float]:
    """Share of hits of each bin of a row, (L,) each. An empty row has the share one half."""
    prior = (hits.sum() + 0.5) / (points.sum() + 1)
    share = (hits + prior) / (points + 1)
    rising = isotonic_regression(-share if is_falling else share, sample_weight=points + 1)
    return [min(max(round(abs(float(value)), 4), 0.0001), 0.9999) for value in rising]  # nothing is certain


def calibration_error(sums: np.ndarray, dynamic: bool, table: str = "probabilities") -> float:
    """Mean difference of a probability and its share of points over tenths of it, weighted by points."""
    predicted = np.array(confidence.TABLE[table])
    columns = [POINTS, DYNAMIC] if table == "moving" else [DYNAMIC, RIGHT_DYNAMIC] if dynamic else [POINTS, RIGHT_ONES]
    points, right = sums[:, columns].T
    tenth = np.minimum((predicted * NUM_BINS).astype(int), NUM_BINS - 1)
    gaps = np.abs(np.bincount(tenth, predicted * points - right, NUM_BINS))
    return float(gaps.sum() / max(points.sum(), 1))


def first(order: np.ndarray, points: np.ndarray, share: float) -> np.ndarray:
    """(C,) part of each bin that is among the first `share` of the points (C,), in an order of bins."""
    before = np.cumsum(points[order]) - points[order]
    taken = np.empty(len(points))
    taken[order] = np.clip((share * points.sum() - before) / np.maximum(points[order], 1), 0, 1)
    return taken


def least_trusted(points: np.ndarray, share: float) -> np.ndarray:
    """(C,) part of each bin that is among the least trusted `share` of the points (C,)."""
    return first(np.argsort(confidence.TABLE["probabilities"], kind="stable"), points, share)


def sparsification(sums: np.ndarray, dynamic: bool) -> list[float]:
    """Mean error after each of the shares `DROPPED` is dropped."""
    points, error = sums[:, DYNAMIC], sums[:, DYNAMIC_ERROR]
    if not dynamic:
        points, error = sums[:, POINTS] - points, sums[:, ERROR] - error
    kept = [1 - least_trusted(points, share) for share in DROPPED]
    return [float((error * left).sum() / max((points * left).sum(), 1)) for left in kept]


def share_of_missed_found(sums: np.ndarray, table: str = "probabilities") -> float:
    """Share of the missed points among those that hold `FALSE_ALARMS` of the static points.

    These are the points of least confidence, or of the highest P(moving).
    """
    values = np.array(confidence.TABLE[table])
    order = np.argsort(-values if table == "moving" else values, kind="stable")
    taken = first(order, sums[:, POINTS] - sums[:, DYNAMIC], FALSE_ALARMS)
    return float((sums[:, MISSED] * taken).sum() / max(sums[:, MISSED].sum(), 1))


def share_of_missed_trusted(sums: np.ndarray) -> float:
    """Share of the missed points with a confidence above one half."""
    is_trusted = np.array(confidence.TABLE["probabilities"]) > 0.5
    return float(sums[is_trusted, MISSED].sum() / max(sums[:, MISSED].sum(), 1))


def simulated(seeds: Sequence[int], motorways: Sequence[int]) -> Iterable[Item]:
    """The windows of simulated drives of all sensors, and of motorways."""
    for profile in sets.PROFILES:
        yield from sets.simulated(profile, seeds)
        yield from sets.motorway(profile, motorways)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=("fit", "fit-objects", "fit-low", "evaluate"))
    given = parser.parse_args()
    torch.set_num_threads(1)
    pair = [sets.make_item(item.window, item.frame.labels) for item in sets.av2_pair()]  # ego motion of the poses
    if given.task != "evaluate":
        items = list(simulated(SEEDS, MOTORWAYS))
        if given.task != "fit-low":
            first_bin = confidence.Bins.unknown + 1 if given.task == "fit" else confidence.Bins.moving
            for _ in range(2):  # P(moving) decides which objects move, and so which points are right
                for name, values in fit(statistics(items, (0, HISTORY), MAX_POINTS)).items():
                    confidence.TABLE[name][first_bin:] = values[first_bin:]
        if given.task != "fit-objects":
            real = [*pair, *sets.kitti(sets.KITTI)[HISTORY:], *sets.kitti(sets.PANDASET["a1"])[HISTORY:]]
            for name, values in fit(statistics([*items, *real], (0, HISTORY), MAX_POINTS)).items():
                confidence.TABLE[name][confidence.Bins.left_out] = values[confidence.Bins.left_out]
        TABLE_FILE.write_text(json.dumps(confidence.TABLE) + "\n", encoding="utf-8")
        return
    kitti = [item for path in (sets.KITTI, sets.KITTI_LATER) for item in sets.kitti(path)[HISTORY:]]
    pandaset = [item for path in sets.PANDASET.values() for item in sets.kitti(path)[HISTORY::4]]
    others = {
        "KITTI 0000": kitti,
        "PandaSet": pandaset,
        "simulated": list(simulated(OTHER_SEEDS, ())),
        "motorways": list(simulated((), OTHER_MOTORWAYS)),
    }
    dropped = ", ".join(f"{100 * share:.0f}" for share in DROPPED)
    columns = f"error, all / dynamic | dynamic, dropped {dropped} % | static, the same | missed found"
    columns += " | P(moving): error | missed found | missed, confidence > .5"
    print(f"| set | {columns} |\n|{'---|' * 8}")
    for name, items, h in (
        ("Argoverse 2 pair", pair, 0),
        *((name, items, h) for h in (0, HISTORY) for name, items in others.items()),
    ):
        sums = statistics(items, (h,))
        gaps = " / ".join(f"{calibration_error(sums, dynamic):.4f}" for dynamic in (False, True))
        left = (", ".join(f"{value:.4f}" for value in sparsification(sums, dynamic)) for dynamic in (True, False))
        found = f"{share_of_missed_found(sums):.2f} of {sums[:, MISSED].sum():.0f}"
        gap, share, trusted = (
            calibration_error(sums, False, "moving"),
            share_of_missed_found(sums, "moving"),
            share_of_missed_trusted(sums),
        )
        print(f"| {name}, h = {h} | {gaps} | {' | '.join(left)} | {found} | {gap:.4f} | {share:.2f} | {trusted:.2f} |")


if __name__ == "__main__":
    main()
