"""Sets made of a real one: longer steps by chained labels, movers with something static pasted beside them."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple, Sequence, Tuple

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from cflow_torch.data.log import FlowLabels
from cflow_torch.evaluation.frame import ego_motion_flow
from cflow_torch.types import Sweep, Window

# Points (N, 3), instance (N,) with 0 = background, total flow (N, 3), usable (N,) bool; all of one sweep.
Labelled = Tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
FEWEST_POINTS = 6  # that a motion of an object is fitted to
GAP = 0.22  # metres between a mover and what is pasted: within one component at pixels of 0.1 m
MOVER_POINTS, STATIC_POINTS = 20, 80  # fewest of a mover; of a component that is pasted, per sweep
LONGER_SIDE = (0.6, 4.0)  # metres, of a component that is pasted
REACH, PIXEL = 34.0, 0.1  # metres: half side of the square that components are looked for in; side of its pixels
MOVES = 0.05  # metres per sweep
SQUARE = np.ones((3, 3), bool)


def chain_flow(pairs: Sequence[Labelled], pose_flow: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
        chosen = [(of == number) & usable for _, of, _, usable in pairs]
        if min(map(np.count_nonzero, chosen)) < FEWEST_POINTS:
            is_known[rows] = False
            continue
        moved = points[rows]
        for (at, _, step, _), of_object in zip(pairs, chosen):
            start = at[of_object].astype(np.float64)
            end = start + step[of_object]
            turn, _ = Rotation.align_vectors(end - end.mean(0), start - start.mean(0))
            moved = turn.apply(moved - start.mean(0)) + end.mean(0)
        flow[rows] = moved - points[rows]
    return flow.astype(np.float32), is_known


class Component(NamedTuple):
    """Something static: its points at t and at t+1, (N, 3) float64 each, frame of t+1."""

    at0: np.ndarray
    at1: np.ndarray


def paste_static(
    pair: Window, labels: FlowLabels, instance: np.ndarray, scored: np.ndarray, number: int
) -> tuple[Window, FlowLabels]:
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
    is_dynamic = counted & (np.linalg.norm(residual, axis=1) >= MOVES)
    static = counted & ~is_dynamic & (instance == 0)
    components = find_components(points0, pair, static, instance)
    added: list[Component] = []
    for mover in np.unique(instance[instance > 0]):
        rows = (instance == mover) & is_dynamic
        if rows.sum() >= MOVER_POINTS and components:
            chosen = components[(number + int(mover)) % len(components)]
            added.append(beside(chosen, points0[rows], residual[rows]))
    if not added:
        return pair, labels
    more0, more1 = (np.concatenate(parts) for parts in zip(*added))
    more0 = (more0 - T_ego1_ego0[:3, 3]) @ T_ego1_ego0[:3, :3]  # back to the frame of t
    return Window(_append(pc0, more0), _append(pc1, more1)), FlowLabels(
        np.concatenate([labels.flow, ego_motion_flow(more0, T_ego1_ego0)]),
        np.concatenate([labels.category, np.zeros(len(more0), labels.category.dtype)]),
        np.concatenate([labels.is_valid, np.ones(len(more0), bool)]),
    )


def find_components(points0: np.ndarray, pair: Window, static: np.ndarray, instance: np.ndarray) -> list[Component]:
    """Dilated components of both sweeps that hold no object and are large enough, but not too large, in raster order.

    Args:
        points0: (N, 3) float64, points of t in the frame of t+1.
        pair: sweeps.
        static: (N,) bool, points that are known to be static.
        instance: (N,) object of each point of t, 0 = background.
    """
    points1 = pair.pc1.points.astype(np.float64)
    pixels = []
    for points, is_ground in ((points0, pair.pc0.is_ground), (points1, pair.pc1.is_ground)):
        inside = (np.abs(points[:, :2]).max(1) < REACH) & ~is_ground
        pixels.append(np.where(inside, np.floor((points[:, 1::-1] + (REACH + 1)) / PIXEL).T, 0).astype(int))
    image = np.zeros([int(2 * (REACH + 1) / PIXEL) + 1] * 2, bool)
    for row_and_col in pixels:
        image[tuple(row_and_col)] = True
    image[0, 0] = False  # all that lies outside, and the ground
    labels, _ = ndimage.label(ndimage.binary_dilation(image, SQUARE), SQUARE)
    label0, label1 = (labels[tuple(row_and_col)] for row_and_col in pixels)
    found = []
    for label in np.setdiff1d(label0[static & (label0 > 0)], label0[instance > 0]):
        part = Component(points0[(label0 == label) & static], points1[label1 == label])
        longer = np.ptp(part.at0[:, :2], 0).max()
        if min(map(len, part)) >= STATIC_POINTS and LONGER_SIDE[0] <= longer <= LONGER_SIDE[1]:
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
    is_ground = np.concatenate([sweep.is_ground, np.zeros(len(points), bool)])
    return replace(sweep, points=np.concatenate([sweep.points, points.astype(np.float32)]), is_ground=is_ground)
