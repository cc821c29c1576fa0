"""Flow truth from tracked boxes: a point in a box moves with the box, every other point is static."""

from __future__ import annotations

from collections import Counter
from typing import Any, Mapping, Sequence

import numpy as np

from cflow_torch.data.categories import CATEGORIES, CATEGORY_INDEX
from cflow_torch.data.file_errors import shortened
from cflow_torch.data.log import FlowLabels, Log
from cflow_torch.errors import warn
from cflow_torch.transforms import transform_points
from cflow_torch.types import CFlowError

_LISTED = 20  # most names in a message, or most messages of one name each
_NO_CATEGORY = "NONE"
# Metres added to length, width and height of the boxes of t, because annotated boxes are a little too tight.
_MARGIN = (0.2, 0.2, 0.0)


class Boxes:
    """The K oriented boxes of one sweep; K may be 0.

    Attributes:
        track_id: K names; an object keeps its name over time, and no name occurs twice.
        category: (K,) uint8, Argoverse 2 index.
        size: (K, 3) float64, metres: length (x), width (y), height (z).
        pose: (K, 4, 4) float64 `T_ego_box`, box coordinates (origin at the centre) to the ego frame of the sweep.
        num_points: (K,) int64, LiDAR points on each object; None = not counted.
    """

    def __init__(self, track_id: Sequence[str], category: Any, size: Any, pose: Any, num_points: Any = None) -> None:
        self.track_id = track_id
        self.category = np.array(category, dtype=np.uint8)
        self.size = np.array(size, dtype=np.float64).reshape(-1, 3)
        self.pose = np.array(pose, dtype=np.float64).reshape(-1, 4, 4)
        self.num_points = num_points
        if not (np.isfinite(self.size).all() and np.isfinite(self.pose).all()):
            raise CFlowError("a box has numbers that are not finite; copy the annotations again")
        twice = sorted(name for name, times in Counter(track_id).items() if times > 1)
        if twice:
            raise CFlowError(f"a track may have only one box per sweep; these have more: {twice[:_LISTED]}")

    @property
    def names(self) -> list[str]:
        """The Argoverse 2 category of each box."""
        return [CATEGORIES[index] for index in self.category]


def category_indices(names: Sequence[Any], known: Mapping[Any, str]) -> list[int]:
    """Return the index of the Argoverse 2 category of each of K boxes; 0 = none. We say which are unknown.

    `names` are the categories of the boxes in their own data set. `known` maps these to categories of Argoverse 2.
    """
    unknown = sorted(set(names) - set(known), key=str)
    for name in unknown[:_LISTED]:  # Python shows each text once
        warn(
            f"we do not know the category {shortened(name)} of boxes, so labels have the flow of these boxes, but no "
            "category, and bucketed scores count their points as background"
        )
    return [CATEGORY_INDEX[known.get(name, _NO_CATEGORY)] for name in names]


def rows_in_box(points: np.ndarray, size: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return the rows of the points (N, 3+) inside a box of (3,) size around its centre, (K,) int64, ascending.

    `pose` is (4, 4) float64, box coordinates to the frame of the points.
    """
    # A bounding square rules out most points first.
    apart_x, apart_y = np.abs(np.asarray(points[:, :2], np.float64) - pose[:2, 3]).T
    reach = np.linalg.norm(size) / 2 + 1e-6
    near = np.flatnonzero((apart_x <= reach) & (apart_y <= reach))
    local = (np.asarray(points[near, :3], np.float64) - pose[:3, 3]) @ pose[:3, :3]
    x, y, z = (np.abs(local) <= np.asarray(size) / 2).T  # costs a tenth of `all` along the rows
    return near[x & y & z]  # type: ignore[no-any-return]


class BoxLog(Log):
    """Base class of logs whose truth comes from tracked boxes."""

    _poses: Any  # (K, 4, 4) float64, `T_world_ego` of each sweep; None = unknown, so there is no truth

    def _points(self, index: int) -> np.ndarray:
        """Read the (N, 3) float32 points of a sweep, in its ego frame."""
        raise NotImplementedError

    def _boxes(self, index: int) -> Boxes | None:
        """Read the boxes of a sweep; None = it is not annotated."""
        raise NotImplementedError

    def _labels(self, index: int) -> FlowLabels | None:
        boxes0, boxes1 = self._boxes(index), self._boxes(index + 1)
        if boxes0 is None or boxes1 is None or self._poses is None:
            return None
        T_ego1_ego0 = np.linalg.inv(self._poses[index + 1]) @ self._poses[index]
        return flow_from_boxes(self._points(index), boxes0, boxes1, T_ego1_ego0)


def flow_from_boxes(points: np.ndarray, boxes0: Boxes, boxes1: Boxes, T_ego1_ego0: np.ndarray) -> FlowLabels:
    """Compute the truth of a pair of sweeps from the boxes of both, each in the ego frame of its sweep.

    `points` are (N, 3) float, metres, in the ego frame of t, and `T_ego1_ego0` is (4, 4) float64.

    Convention: TOTAL flow, computed in float64 and rounded to float32 at the end. Points in a box whose track ends
        have the category of the box, the pose flow and `is_valid` False. A point in several boxes takes the flow and
        category of the last one. It is valid only if the tracks of all these boxes continue.

    Source: the recipe of av2-api (torch/structures/flow.py), which rounds the ego motion to float32 first.
    """
    start = np.asarray(points, dtype=np.float64)[:, :3]
    flow = transform_points(start, T_ego1_ego0) - start
    category = np.zeros(len(start), dtype=np.uint8)
    is_valid = np.ones(len(start), dtype=bool)
    successor = {track: row for row, track in enumerate(boxes1.track_id)}
    for row, track in enumerate(boxes0.track_id):
        inside = rows_in_box(start, boxes0.size[row] + _MARGIN, boxes0.pose[row])
        category[inside] = boxes0.category[row]
        if track not in successor:
            is_valid[inside] = False
            continue
        motion = boxes1.pose[successor[track]] @ np.linalg.inv(boxes0.pose[row])
        flow[inside] = transform_points(start[inside], motion) - start[inside]
    return FlowLabels(flow=flow.astype(np.float32), category=category, is_valid=is_valid)
