"""Three-way end-point error with accuracy, angle error and dynamic IoU."""

from __future__ import annotations

from typing import Any, Sequence

import numpy as np

from cflow_torch.data.categories import CATEGORIES, meta_class
from cflow_torch.evaluation.definitions import Definition
from cflow_torch.evaluation.scored_points import Accumulator, ScoredPoints

MOTIONS = ("static", "dynamic")
DISTANCES = ("close", "far")
QUANTITIES = ("epe", "accuracy_strict", "accuracy_relax", "angle_error")
ACCURACY_STRICT, ACCURACY_RELAX = 0.05, 0.1  # metres, and fraction of the true flow
ACCURACY_EPS = 1e-10  # metres, keeps the fraction finite
FRAME_COUNT_EPS, FRAME_IOU_EPS = 1e-8, 1e-6  # OpenSceneFlow adds them to the denominators of per-frame values

# The three sets of the score as (categories, motion).
_FOREGROUND = slice(1, None)
_SETS: dict[str, tuple[Any, int]] = {"epe_fd": (_FOREGROUND, 1), "epe_fs": (_FOREGROUND, 0), "epe_bs": (0, 0)}
_GROUPS: dict[str, Any] = {"background": slice(0, 1), "foreground": _FOREGROUND}


def point_quantities(predicted: np.ndarray, true: np.ndarray, sweep_interval: float) -> np.ndarray:
    """Compute the (4, M) float64 error measures of points from (M, 3) float64 flows, metres per frame.

    The rows are `QUANTITIES`: end-point error in metres; 1 where the error in metres or error / true length is below
    0.05, else 0; the same for 0.1; angle in radians between (x, y, z, `sweep_interval`) of both flows.
    """
    error = np.linalg.norm(predicted - true, axis=1)
    share = error / (np.linalg.norm(true, axis=1) + ACCURACY_EPS)
    time = np.full((len(true), 1), sweep_interval)
    vectors = [np.concatenate([flow, time], axis=1) for flow in (predicted, true)]
    units = [vector / np.linalg.norm(vector, axis=1, keepdims=True) for vector in vectors]
    angle = np.arccos(np.clip((units[0] * units[1]).sum(axis=1), -1.0, 1.0))
    strict = (error < ACCURACY_STRICT) | (share < ACCURACY_STRICT)
    relax = (error < ACCURACY_RELAX) | (share < ACCURACY_RELAX)
    return np.stack([error, strict.astype(np.float64), relax.astype(np.float64), angle])


class ThreeWayEPE(Accumulator):
    """Three-way EPE: foreground dynamic, foreground static, background static, and their mean.

    A point is dynamic if its true residual is at least `dynamic_threshold`. With average "points" all means are over
    all points, and a set without points is NaN. With "frames" the three errors and the IoU are means over frames, where
    an absent set counts as 0; so frames without dynamic points lower `epe_fd` and the IoU. The breakdowns are over
    points in both cases.
    """

    def __init__(self, definition: Definition) -> None:
        # The last quantity is 1 where a point is predicted as dynamic.
        super().__init__(definition, (len(CATEGORIES), len(MOTIONS), len(DISTANCES)), len(QUANTITIES) + 1)
        self.num_frames = 0
        self.frame_sums = np.zeros(len(_SETS) + 1, dtype=np.float64)  # per-frame values of the sets and the IoU

    def cells(self, scored: ScoredPoints) -> tuple[np.ndarray, Sequence[np.ndarray]]:
        """Return the cell (category, motion, distance) of each scored point, and its quantities.

        These are `QUANTITIES`, then 1 if the point is predicted as dynamic, else 0.
        """
        keep = scored.in_region
        meta = meta_class(scored.category)
        if self.definition.foreground == "meta":
            keep = keep & (meta >= 0)
        cell = 4 * scored.category[keep] + 2 * scored.is_dynamic[keep] + ~scored.is_close[keep]
        flows = scored.predicted_flow[keep], scored.true_flow[keep]
        predicted = scored.predicted_dynamic[keep].astype(np.float64)
        return cell, [*point_quantities(*flows, self.definition.sweep_interval), predicted]

    def _add(self, count: np.ndarray, sums: np.ndarray) -> None:
        super()._add(count, sums)
        self.num_frames += 1
        self.frame_sums += _values(count, sums, FRAME_COUNT_EPS, FRAME_IOU_EPS)

    def compute(self) -> dict[str, Any]:
        """Return `epe_fd`, `epe_fs`, `epe_bs`, `epe_3way` in metres, `dynamic_iou` and "breakdown".

        The keys of "breakdown" are "background" and "foreground", then "static" and "dynamic", then "all", "close" and
        "far". Each entry has `count`, `num_predicted` (points predicted as dynamic) and the values of `QUANTITIES`.
        """
        values = _values(self.count, self.sums)
        if self.definition.average == "frames":
            with np.errstate(invalid="ignore"):
                values = self.frame_sums / self.num_frames
        return {
            **dict(zip(_SETS, values.tolist())),
            "epe_3way": float(np.mean(values[:-1])),
            "dynamic_iou": float(values[-1]),
            "breakdown": {name: self._group(members) for name, members in _GROUPS.items()},
        }

    def _group(self, categories: Any) -> dict[str, dict[str, dict[str, float]]]:
        """Compute motion -> distance -> means over a group of categories."""
        count = self.count[categories].sum(axis=0)
        sums = self.sums[:, categories].sum(axis=1)
        columns: dict[str, Any] = {"all": slice(None), **{name: [column] for column, name in enumerate(DISTANCES)}}
        return {
            motion: {
                name: _means(count[row, column].sum(), sums[:, row, column].sum(axis=1))
                for name, column in columns.items()
            }
            for row, motion in enumerate(MOTIONS)
        }


def _values(count: np.ndarray, sums: np.ndarray, count_eps: float = 0.0, iou_eps: float = 0.0) -> np.ndarray:
    """Return (4,) float64: the mean error of each of `_SETS`, and the IoU of true and predicted dynamic points."""
    predicted = sums[-1]
    true = count[:, 1].sum()
    with np.errstate(divide="ignore", invalid="ignore"):
        means = [sums[0][cells].sum() / (count[cells].sum() + count_eps) for cells in _SETS.values()]
        return np.array([*means, predicted[:, 1].sum() / (true + predicted[:, 0].sum() + iou_eps)])


def _means(count: np.integer, sums: np.ndarray) -> dict[str, float]:
    means = {key: float(total / count) if count else float("nan") for key, total in zip(QUANTITIES, sums)}
    return {"count": int(count), "num_predicted": int(sums[-1]), **means}
