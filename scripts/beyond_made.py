"""Sets made of a real one: longer steps by chained labels, movers with something static pasted beside them."""

from __future__ import annotations

from typing import List, NamedTuple, Optional, Sequence, Tuple

import numpy as np
import torch

from cflow_torch.data.log import FlowLabels
from cflow_torch.evaluation.frame import ego_motion_flow
from cflow_torch.ops.labeling import connected_components
from cflow_torch.types import Sweep, Window

# Points (N, 3), instance (N,) with 0 = background, total flow (N, 3), usable (N,) bool; all of one sweep.
Labelled = Tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
FEWEST_POINTS = 6  # that a motion of an object is fitted to
GAP = 0.22  # metres between a mover and what is pasted: within one component at pixels of 0.1 m
MOVER_POINTS, STATIC_POINTS = 20, 80  # fewest of a mover; of a component that is pasted, per sweep
LONGER_SIDE = (0.6, 4.0)  # metres, of a component that is pasted
REACH, PIXEL = 34.0, 0.1  # metres: half side of the square that components are looked for in; side of its pixels
DYNAMIC = 0.05  # metres per sweep


def chain_flow(pairs: Sequence[Labelled], pose_flow: np.ndarray) -> Tuple[np.ndarray, np.ndarray]:
    """Flow over several sweeps from the labels of the pairs between.

    Args:
        pairs: of sweeps t, t + 1, ... t + k - 1 in turn; flow is that to the next sweep.
        pose_flow: (N, 3) metres, flow t -> t + k of what does not move, axes of t + k.

    Returns:
        (N, 3) float32 total flow t -> t + k of the points of t: every object moves by its rigid motions one after the
        other, the background by `pose_flow`; (N,) bool, False for objects that some sweep between has too little of.
    """
    points, instance = pairs[0][0].astype(np.float64), pairs[0][1]
    flow, is_known = pose_flow.astype(np.float64), np.ones(len(points), bool)
    for number in np.unique(instance[instance > 0]):
        rows = instance == number
        moved: Optional[np.ndarray] = points[rows]
        for at, of, step, usable in pairs:
            chosen = (of == number) & usable
            if chosen.sum() < FEWEST_POINTS:
                moved = None
                break
            start = at[chosen].astype(np.float64)
            R, t = fit_rigid(start, start + step[chosen])  # ego frame of this sweep to that of the next
            moved = moved @ R.T + t
        if moved is None:
            is_known[rows] = False
        else:
            flow[rows] = moved - points[rows]
    return flow.astype(np.float32), is_known


def fit_rigid(start: np.ndarray, end: np.ndarray) -> Tuple[np.ndarray, np.ndarray]:
    """R (3, 3) and t (3,) with the least squares of R start + t - end; (N, 3) float64 each."""
    start_mean, end_mean = start.mean(0), end.mean(0)
    u, _, vt = np.linalg.svd((start - start_mean).T @ (end - end_mean))
    R = vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    return R, end_mean - R @ start_mean


class Component(NamedTuple):
    """Something static: its points at t and at t+1, (N, 3) float64 each, frame of t+1."""

    at0: np.ndarray
    at1: np.ndarray


def paste_static(
    pair: Window, labels: FlowLabels, instance: np.ndarray, scored: np.ndarray, number: int
) -> Tuple[Window, FlowLabels]:
    """A pair in which every mover has a static component of the same pair beside it.

    Args:
        pair: sweeps with poses and ground masks.
        labels: truth.
        instance: (N,) object of each point of t, 0 = background.
        scored: (N,) bool, points whose truth counts.
        number: of the pair; pairs differ in which component goes to which mover.

    Returns:
        The pair with the points of the components appended to both sweeps, and the labels of all points of t.

    Convention: a component stands `GAP` beside the lane that the mover needs from t to t+1, on the side away from the
        sensor, where it does not shade it, and in both sweeps at the same place of the world.
    """
    pc0, pc1 = pair.pc0, pair.pc1
    T_ego1_ego0 = np.linalg.inv(pc1.pose) @ pc0.pose
    points0 = pc0.points.astype(np.float64) @ T_ego1_ego0[:3, :3].T + T_ego1_ego0[:3, 3]  # frame of t+1
    residual = labels.flow - ego_motion_flow(pc0.points, T_ego1_ego0)
    counted = scored & ~pc0.is_ground & (np.abs(pc0.points[:, :2]) <= REACH + 1).all(1)
    is_dynamic = counted & (np.linalg.norm(residual, axis=1) >= DYNAMIC)
    static = counted & ~is_dynamic & (instance == 0)
    components = find_components(points0, pc1.points.astype(np.float64), pc0.is_ground, pc1.is_ground, static, instance)
    added: List[Component] = []
    for mover in np.unique(instance[instance > 0]):
        rows = (instance == mover) & is_dynamic
        if rows.sum() >= MOVER_POINTS and components:
            chosen = components[(number + int(mover)) % len(components)]
            added.append(beside(chosen, points0[rows], residual[rows]))
    if not added:
        return pair, labels
    more0, more1 = (np.concatenate(parts) for parts in zip(*added))
    more0 = (more0 - T_ego1_ego0[:3, 3]) @ T_ego1_ego0[:3, :3]  # back to the frame of t
    made = Window(_append(pc0, more0), _append(pc1, more1))
    return made, FlowLabels(
        np.concatenate([labels.flow, ego_motion_flow(more0, T_ego1_ego0)]),
        np.concatenate([labels.category, np.zeros(len(more0), labels.category.dtype)]),
        np.concatenate([labels.is_valid, np.ones(len(more0), bool)]),
    )


def find_components(
    points0: np.ndarray,
    points1: np.ndarray,
    is_ground0: np.ndarray,
    is_ground1: np.ndarray,
    static: np.ndarray,
    instance: np.ndarray,
) -> List[Component]:
    """Dilated components of both sweeps that hold no object and are large enough, but not too large, in raster order.

    Args:
        points0, points1: (N, 3), (N1, 3) float64, frame of t+1.
        is_ground0, is_ground1: (N,), (N1,) bool.
        static: (N,) bool, points that are known to be static.
        instance: (N,) object of each point of t, 0 = background.
    """
    inside0, inside1 = (np.abs(points[:, :2]).max(1) < REACH for points in (points0, points1))
    rows0, rows1 = np.flatnonzero(inside0 & ~is_ground0), np.flatnonzero(inside1 & ~is_ground1)
    cells = np.floor((np.concatenate([points0[rows0, :2], points1[rows1, :2]]) + (REACH + 1)) / PIXEL).astype(int)
    side = int(2 * (REACH + 1) / PIXEL) + 1
    occupied, of_point = np.unique(cells[:, 1] * side + cells[:, 0], return_inverse=True)
    image = torch.zeros(side * side, dtype=torch.bool)
    pixels = torch.from_numpy(occupied)
    image[pixels] = True
    first = connected_components(image.view(1, side, side), pixels, reach=3).numpy()  # as if dilated
    label0, label1 = np.split(first[of_point.reshape(-1)], [len(rows0)])
    taken = np.unique(label0[instance[rows0] > 0])
    found = []
    for label in np.setdiff1d(label0[static[rows0]], taken):
        part = Component(points0[rows0[(label0 == label) & static[rows0]]], points1[rows1[label1 == label]])
        if (
            min(map(len, part)) >= STATIC_POINTS
            and LONGER_SIDE[0] <= np.ptp(part.at0[:, :2], 0).max() <= LONGER_SIDE[1]
        ):
            found.append(part)
    return found


def beside(component: Component, mover: np.ndarray, residual: np.ndarray) -> Component:
    """The component, shifted to stand `GAP` beside the lane of a mover (N, 3) with residual flow (N, 3)."""
    along = np.median(residual[:, :2], axis=0)
    along = along / np.linalg.norm(along)
    across = np.array([-along[1], along[0]])
    if across @ mover[:, :2].mean(0) < 0:  # away from the sensor
        across = -across
    lane, own = (np.concatenate(parts)[:, :2] for parts in ((mover, mover + residual), component))
    shift = ((lane @ across).max() + GAP - (own @ across).min()) * across
    shift += ((lane @ along).mean() - (own @ along).mean()) * along
    return Component(*(points + np.append(shift, 0.0) for points in component))


def _append(sweep: Sweep, points: np.ndarray) -> Sweep:
    """A sweep with more points that are not ground."""
    return Sweep(
        np.concatenate([sweep.points, points.astype(np.float32)]),
        np.concatenate([sweep.is_ground, np.zeros(len(points), bool)]),
        sweep.pose,
        sweep.timestamp_ns,
    )
