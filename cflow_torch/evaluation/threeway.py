"""Three-way end-point error with accuracy, angle error and dynamic IoU."""

from __future__ import annotations

from typing import Any, Dict, List, Union

import numpy as np

from cflow_torch.evaluation.accumulator import Accumulator
from cflow_torch.evaluation.categories import META_NAMES, meta_class
from cflow_torch.evaluation.definitions import Definition
from cflow_torch.evaluation.masks import ScoredPoints

CLASSES = ("background", "foreground")
MOTIONS = ("static", "dynamic")
DISTANCES = ("close", "far")
QUANTITIES = ("epe", "accuracy_strict", "accuracy_relax", "angle_error")
ACCURACY_STRICT, ACCURACY_RELAX = 0.05, 0.1  # metres, and share of the true flow
ACCURACY_EPS = 1e-10  # metres, keeps the share finite
FRAME_COUNT_EPS, FRAME_IOU_EPS = 1e-8, 1e-6  # of OpenSceneFlow's per-frame values

# The three sets of the score as (class, motion).
_SETS = {"epe_fd": (1, 1), "epe_fs": (1, 0), "epe_bs": (0, 0)}


def point_quantities(predicted: np.ndarray, true: np.ndarray, sweep_interval: float) -> np.ndarray:
    """Error measures of each point.

    Args:
        predicted, true: (M, 3) float64, metres per frame.
        sweep_interval: seconds; fourth component that makes the angle one between space-time vectors.

    Returns:
        (4, M) float64, rows as in `QUANTITIES`: end-point error in metres; 1 where error or error / true length is
        below 0.05, below 0.1; angle in radians.
    """
    error = np.linalg.norm(predicted - true, axis=1)
    share = error / (np.linalg.norm(true, axis=1) + ACCURACY_EPS)
    time = np.full((len(true), 1), sweep_interval)
    units: List[np.ndarray] = []
    for flow in (predicted, true):
        vector = np.concatenate([flow, time], axis=1)
        units.append(vector / np.linalg.norm(vector, axis=1, keepdims=True))
    angle = np.arccos(np.clip((units[0] * units[1]).sum(axis=1), -1.0, 1.0))
    strict = (error < ACCURACY_STRICT) | (share < ACCURACY_STRICT)
    relax = (error < ACCURACY_RELAX) | (share < ACCURACY_RELAX)
    return np.stack([error, strict.astype(np.float64), relax.astype(np.float64), angle])


class ThreeWayEPE(Accumulator):
    """Streaming three-way EPE: foreground dynamic, foreground static, background static, and their mean.

    Args:
        definition: name or `Definition`.

    Convention: a point is dynamic if its true residual is at least `dynamic_threshold`. With average "points" all
    means are over all points and a set without points is NaN; with "frames" the three errors and the IoU are means
    over frames, where an absent set counts as 0, so that frames without movers pull `epe_fd` and the IoU down. The
    breakdown is over points in both cases.
    """

    totals = ("count", "sums", "segmentation", "num_frames", "frame_sums")

    def __init__(self, definition: Union[str, Definition] = "opensceneflow") -> None:
        super().__init__(definition)
        self.count = np.zeros((2, 2, 2), dtype=np.int64)  # class, motion, distance
        self.sums = np.zeros((len(QUANTITIES), 2, 2, 2), dtype=np.float64)
        self.segmentation = np.zeros(3, dtype=np.int64)  # true positives, false positives, false negatives
        self.num_frames = 0
        self.frame_sums = np.zeros(len(_SETS) + 1, dtype=np.float64)  # per-frame values of the sets and the IoU

    def update_points(self, scored: ScoredPoints) -> None:
        """Add the scored points of one frame."""
        keep = scored.in_region
        foreground = scored.category > 0
        if self.definition.foreground == "meta":
            meta = meta_class(scored.category)
            foreground = meta > META_NAMES.index("BACKGROUND")
            keep = keep & (meta >= 0)
        true, predicted = scored.is_dynamic[keep], scored.predicted_dynamic[keep]
        cell = 4 * foreground[keep] + 2 * true + ~scored.is_close[keep]
        quantities = point_quantities(
            scored.predicted_flow[keep], scored.true_flow[keep], self.definition.sweep_interval
        )
        count = np.bincount(cell, minlength=8).reshape(2, 2, 2)
        sums = np.stack([np.bincount(cell, row, minlength=8).reshape(2, 2, 2) for row in quantities])
        segmentation = np.array([(true & predicted).sum(), (~true & predicted).sum(), (true & ~predicted).sum()])
        self.count += count
        self.sums += sums
        self.segmentation += segmentation
        self.num_frames += 1
        means = [sums[0][place].sum() / (count[place].sum() + FRAME_COUNT_EPS) for place in _SETS.values()]
        self.frame_sums += np.array([*means, segmentation[0] / (segmentation.sum() + FRAME_IOU_EPS)])

    def compute(self) -> Dict[str, Any]:
        """Scores so far.

        Returns:
            `epe_fd`, `epe_fs`, `epe_bs`, `epe_3way` in metres, `dynamic_iou`, `num_frames`, and "breakdown":
            class -> motion -> "all" / "close" / "far" -> `count` and the values of `QUANTITIES`.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.definition.average == "frames":
                values = self.frame_sums / self.num_frames
            else:
                means = [self.sums[0][place].sum() / self.count[place].sum() for place in _SETS.values()]
                values = np.array([*means, self.segmentation[0] / self.segmentation.sum()])
        result: Dict[str, Any] = {key: float(value) for key, value in zip(_SETS, values)}
        result["epe_3way"] = float(np.mean(values[: len(_SETS)]))
        result["dynamic_iou"] = float(values[-1])
        result["num_frames"] = self.num_frames
        result["breakdown"] = {
            name: {motion: self._cells(row, column) for column, motion in enumerate(MOTIONS)}
            for row, name in enumerate(CLASSES)
        }
        return result

    def _cells(self, row: int, column: int) -> Dict[str, Dict[str, float]]:
        counts, sums = self.count[row, column], self.sums[:, row, column]
        cells = {"all": (counts.sum(), sums.sum(axis=1))}
        cells.update({name: (counts[place], sums[:, place]) for place, name in enumerate(DISTANCES)})
        return {
            name: {
                "count": int(count),
                **{key: float(total / count) if count else float("nan") for key, total in zip(QUANTITIES, totals)},
            }
            for name, (count, totals) in cells.items()
        }
