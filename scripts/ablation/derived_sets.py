"""Derive sets: longer steps with chained labels, static components pasted next to moving objects, partial sweeps."""

from __future__ import annotations

from dataclasses import replace
from typing import Callable, Mapping, Sequence, Tuple

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from cflow_torch.applications.moving_groups import MOVING
from cflow_torch.data.log import FlowLabels
from cflow_torch.data.odometry import Odometry
from cflow_torch.evaluation.frame import EvalFrame, ego_motion_flow
from cflow_torch.transforms import relative_transform, transform_points
from cflow_torch.types import Sweep, Window

# Points (N, 3), instance (N,) with 0 = background, total flow (N, 3), usable (N,) bool; all of one sweep.
Labelled = Tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
Component = Tuple[np.ndarray, np.ndarray]  # of a static component: its points at t and at t+1, (N, 3), frame of t+1
MIN_POINTS = 6  # to fit the motion of an object
GAP = 0.22  # metres between an object and the pasted component: one component at pixels of 0.1 m
DYNAMIC_POINTS, STATIC_POINTS = 20, 80  # least of a moving object; of a pasted component, per sweep
LONGER_SIDE = (0.6, 4.0)  # metres, of a pasted component
REACH, PIXEL = 34.0, 0.1  # metres: half side of the square in which we search components; side of its pixels
SQUARE = np.ones((3, 3), bool)
# Which azimuths, (N,) degrees, a sweep of a drive measures, by its index and that of sweep t.
CUTS: Mapping[str, Callable[[np.ndarray, int, int], np.ndarray]] = {
    "front": lambda azimuth, index, t: np.abs(azimuth) < 35,
    "turning": lambda azimuth, index, t: (azimuth - 15 * index) % 360 < 120,
    "older": lambda azimuth, index, t: (azimuth < 0) | (index >= t),
    "quarter": lambda azimuth, index, t: (azimuth < 0) | (azimuth > 90) | (index % 3 > 0),
}


def chain_flow(pairs: Sequence[Labelled], pose_flow: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Chain the labels of consecutive pairs, of sweeps t, t + 1, ... t + k - 1, to the flow t -> t + k.

    Objects move by the product of their rigid motions, the background by `pose_flow`, (N, 3) metres in the axes of t +
    k. Also returns (N,) bool, False for objects with too few points in one of the sweeps.
    """
    points, instance = pairs[0][0].astype(np.float64), pairs[0][1]
    flow, is_known = pose_flow.astype(np.float64), np.ones(len(points), bool)
    for number in np.unique(instance[instance > 0]):
        rows = instance == number
        chosen = [(of == number) & usable for _, of, _, usable in pairs]
        if min(map(np.count_nonzero, chosen)) < MIN_POINTS:
            is_known[rows] = False
            continue
        moved = points[rows]
        for (positions, _, step, _), of_object in zip(pairs, chosen):
            start = positions[of_object].astype(np.float64)
            end = start + step[of_object]
            rotation, _ = Rotation.align_vectors(end - end.mean(0), start - start.mean(0))
            moved = rotation.apply(moved - start.mean(0)) + end.mean(0)
        flow[rows] = moved - points[rows]
    return flow.astype(np.float32), is_known


def paste_static(
    pair: Window, frame: EvalFrame, instance: np.ndarray, number: int
) -> tuple[Window, FlowLabels, np.ndarray]:
    """Paste a static component of the pair next to every moving object; return pair, labels and mask with its points.

    The component is `GAP` away from the area that the object covers from t to t+1, on the far side from the sensor,
    where it does not occlude the object. It has the same position in the world in both sweeps. `number` varies which
    component is pasted next to which object.
    """
    pc0, labels, T_ego1_ego0 = pair.pc0, frame.labels, frame.transform()
    points0, residual = transform_points(pc0.points, T_ego1_ego0), labels.flow - frame.pose_flow
    counted = frame.eval_mask & labels.is_valid & ~pc0.is_ground & (np.abs(pc0.points[:, :2]) <= REACH + 1).all(1)
    is_dynamic = counted & (np.linalg.norm(residual, axis=1) >= MOVING)
    components = find_components(points0, pair, counted & ~is_dynamic & (instance == 0), instance)
    added: list[Component] = [(np.zeros((0, 3)), np.zeros((0, 3)))]
    for moving in np.unique(instance[instance > 0]):
        rows = (instance == moving) & is_dynamic
        if rows.sum() >= DYNAMIC_POINTS and components:
            chosen = components[(number + int(moving)) % len(components)]
            added.append(shift_next_to(chosen, points0[rows], residual[rows]))
    more0, more1 = (np.concatenate(parts) for parts in zip(*added))
    more0 = (more0 - T_ego1_ego0[:3, 3]) @ T_ego1_ego0[:3, :3]  # back to the frame of t
    labels = FlowLabels(
        np.concatenate([labels.flow, ego_motion_flow(more0, T_ego1_ego0)]),
        np.concatenate([labels.category, np.zeros(len(more0), labels.category.dtype)]),
        np.concatenate([labels.is_valid, np.ones(len(more0), bool)]),
    )
    eval_mask = np.concatenate([frame.eval_mask, np.ones(len(more0), bool)])
    return Window(_append(pc0, more0), _append(pair.pc1, more1)), labels, eval_mask


def find_components(points0: np.ndarray, pair: Window, static: np.ndarray, instance: np.ndarray) -> list[Component]:
    """Find dilated components of both sweeps of suitable size and without objects, in raster order.

    `points0` are the points of t in the frame of t+1, and `static` those that are static according to the labels.
    """
    points1 = pair.pc1.points.astype(np.float64)
    pixels = []
    for points, is_ground in ((points0, pair.pc0.is_ground), (points1, pair.pc1.is_ground)):
        inside = (np.abs(points[:, :2]).max(1) < REACH) & ~is_ground
        pixels.append(np.where(inside, np.floor((points[:, 1::-1] + (REACH + 1)) / PIXEL).T, 0).astype(int))
    image = np.zeros([int(2 * (REACH + 1) / PIXEL) + 1] * 2, bool)
    for row_and_col in pixels:
        image[tuple(row_and_col)] = True
    image[0, 0] = False  # points outside, and the ground
    labels, _ = ndimage.label(ndimage.binary_dilation(image, SQUARE), SQUARE)
    label0, label1 = (labels[tuple(row_and_col)] for row_and_col in pixels)
    found = []
    for label in np.setdiff1d(label0[static & (label0 > 0)], label0[instance > 0]):
        pasted = points0[(label0 == label) & static], points1[label1 == label]
        longer = np.ptp(pasted[0][:, :2], 0).max()
        if min(map(len, pasted)) >= STATIC_POINTS and LONGER_SIDE[0] <= longer <= LONGER_SIDE[1]:
            found.append(pasted)
    return found


def shift_next_to(component: Component, points: np.ndarray, residual: np.ndarray) -> Component:
    """Shift the component next to the path of an object with (N, 3) points and residual flow."""
    along = np.median(residual[:, :2], axis=0)
    along = along / np.linalg.norm(along)
    across = np.array([-along[1], along[0]])
    if across @ points[:, :2].mean(0) < 0:  # away from the sensor
        across = -across
    lane, own = (np.concatenate(parts)[:, :2] for parts in ((points, points + residual), component))
    shift = ((lane @ across).max() + GAP - (own @ across).min()) * across
    shift += ((lane @ along).mean() - (own @ along).mean()) * along
    at0, at1 = (each + np.append(shift, 0.0) for each in component)
    return at0, at1


def _append(sweep: Sweep, points: np.ndarray) -> Sweep:
    """Append points that are not ground."""
    is_ground = np.concatenate([sweep.is_ground, np.zeros(len(points), bool)])
    return replace(sweep, points=np.concatenate([sweep.points, points.astype(np.float32)]), is_ground=is_ground)


def cut_sweep(sweep: Sweep, cut: str, index: int, t: int) -> tuple[Sweep, np.ndarray]:
    """Keep the points that a sweep has in some azimuths, see `CUTS`. Also return which these are, (N,) bool."""
    kept = CUTS[cut](np.degrees(np.arctan2(sweep.points[:, 1], sweep.points[:, 0])), index, t)
    return Sweep(sweep.points[kept], is_ground=sweep.is_ground[kept], pose=sweep.pose), kept


def with_pose_errors(given: Window, error: str, seed: int) -> Window:
    """Return a window without later sweeps, whose poses have an error of `POSE_ERRORS`."""
    sweeps, errors = given.sweeps, POSE_ERRORS[error](len(given.sweeps), np.random.default_rng(seed))
    moved = [replace(sweep, pose=sweep.pose @ T) for sweep, T in zip(sweeps, errors)]
    if error == "rounded positions":
        for sweep in moved:
            sweep.pose[:3, 3] = sweep.pose[:3, 3].round(1)
    return given.with_sweeps(moved)


def _noise(metres: float, degrees: float) -> Callable[[int, np.random.Generator], np.ndarray]:
    """Draw errors of x and y, and of the heading, normally distributed, (K, 4, 4)."""

    def draw(count: int, rng: np.random.Generator) -> np.ndarray:
        errors = np.tile(np.eye(4), (count, 1, 1))
        errors[:, :3, :3] = Rotation.from_euler("z", rng.normal(0, degrees, count), degrees=True).as_matrix()
        errors[:, :2, 3] = rng.normal(0, metres, (count, 2))
        return errors

    return draw


def _of_one_pose(count: int, rng: np.random.Generator) -> np.ndarray:
    errors = np.tile(np.eye(4), (count, 1, 1))
    errors[rng.integers(2), :2, 3] = 0.12, 0.09  # of t or t+1
    return errors


# The errors of the poses of K sweeps, (K, 4, 4), in the frame of the vehicle.
POSE_ERRORS: Mapping[str, Callable[[int, np.random.Generator], np.ndarray]] = {
    "exact": _noise(0.0, 0.0),
    "noise of 2 cm, 0.1 degrees": _noise(0.02, 0.1),
    "noise of 10 cm, 0.5 degrees": _noise(0.1, 0.5),
    "headings off by 0.3 degrees": _noise(0.0, 0.3),
    "rounded positions": _noise(0.0, 0.0),
    "one pose off by 15 cm": _of_one_pose,
}


def with_refined_poses(given: Window) -> Window:
    """Refine the poses of a window without later sweeps, oldest sweep first, as `estimate_poses` does."""
    odometry = Odometry()
    refined = []
    before = None
    for sweep in (*reversed(given.pch), given.pc0, given.pc1):
        start = None if before is None else relative_transform(sweep.pose, before.pose)
        refined.append(replace(sweep, pose=odometry.next_pose(np.asarray(sweep.points), "a sweep", start)))
        before = sweep
    *history, pc0, pc1 = refined
    return Window(pc0, pc1, tuple(reversed(history)))
