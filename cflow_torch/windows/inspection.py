"""Warn of input that is allowed, but likely a mistake: units, axes, order of sweeps, poses, ground without a mask."""

from __future__ import annotations

import warnings
from contextlib import contextmanager
from typing import Iterator, Sequence

import numpy as np
import torch

from cflow_torch.config import Config
from cflow_torch.errors import CFlowError, NoActivePoints, warn
from cflow_torch.types import Array, FlowResult, Sweep, Window, as_numpy
from cflow_torch.windows.ego_motion import relative_transform
from cflow_torch.windows.ground import has_ground, is_upside_down
from cflow_torch.windows.structure import FEWEST_IN_PLACE, Patches, is_better_inverted, move, structure
from cflow_torch.windows.validation import have_same_points

UPSIDE_DOWN = "z seems to point down, because nearly all points lie below the ground: give points with z up"
REPEATED = "pc1 has the same points as pc0, so everything seems to move with the sensor: give two different sweeps"
_GROUND = (
    "a sweep without a ground mask contains ground, which joins the objects on it into one cluster, so moving objects "
    "are missed: give masks (Sweep.is_ground, see cflow_torch.windows.ground.find_ground), all False if this is not "
    "ground"
)
BACKWARD = (
    "two sweeps in a row fit better if the motion between them is inverted: are poses inverted (they must be "
    "T_world_ego, and T_ego1_ego0 maps from t to t+1), or are sweeps interchanged?"
)
_FEWEST_REPEATED = 100  # this many equal points are no coincidence
_MOST_POINTS = 20_000  # of a sweep, for the comparison of two sweeps
_LEAST_MOTION, _REACH = 0.3, 30.0  # metres; we judge ego motions that move a point 30 m away by at least 0.3 m


class Inspection:
    """Warns of likely mistakes in the windows of a model.

    In every window, it checks that pc1 does not repeat pc0. It makes the other checks once each, only in the first
    window of a call. Once such a window has points, it checks that z points up and ground is masked. Once the sensor
    moves in such a window, it checks poses and order of sweeps. Cost: about 20 ms, once; 5 us for each window.
    """

    def __init__(self) -> None:
        self._has_seen_points = self._has_seen_motion = False

    def __call__(self, windows: Sequence[Window]) -> None:
        for window in windows:
            if repeats(window.pc0, window.pc1):
                warn(REPEATED)
        if not windows or len(windows[0].pc0.points) == 0:
            return
        first = windows[0]
        if not self._has_seen_points:
            self._has_seen_points = True
            if is_upside_down(first.pc0.points):
                warn(UPSIDE_DOWN)
            elif first.pc0.is_ground is None and has_ground(first.pc0.points):
                warn(_GROUND)
        if not self._has_seen_motion and has_moved(first.pc0, first.pc1):
            self._has_seen_motion = True
            if is_backward(first.pc0, first.pc1):
                warn(BACKWARD)


def repeats(pc0: Sweep, pc1: Sweep) -> bool:
    """Test whether two sweeps have the same points, at least 100. False for tensors on a GPU, so as not to wait."""
    for points in (pc0.points, pc1.points):
        if len(points) < _FEWEST_REPEATED or (isinstance(points, torch.Tensor) and points.device.type != "cpu"):
            return False
    return have_same_points(pc0, pc1)


def has_moved(pc0: Sweep, pc1: Sweep) -> bool:
    """Test whether the poses differ enough to judge the direction of the ego motion. False without poses."""
    if pc0.pose is None or pc1.pose is None:
        return False
    T = relative_transform(pc1.pose, pc0.pose)
    return bool(np.linalg.norm(T[:3, 3]) + _REACH * np.abs(T[:2, :2] - np.eye(2)).max() >= _LEAST_MOTION)


def is_backward(pc0: Sweep, pc1: Sweep) -> bool:
    """Test whether the static structure of two sweeps fits better if the ego motion from their poses is inverted."""
    T_ego1_ego0 = relative_transform(pc1.pose, pc0.pose)
    older, newer = (structure(_thinned(sweep)) for sweep in (pc0, pc1))
    patches = Patches(newer[:, :2])
    given, none, inverted = (
        patches.agreement(move(older, T)) for T in (T_ego1_ego0, np.eye(4), np.linalg.inv(T_ego1_ego0))
    )
    return inverted * len(older) > FEWEST_IN_PLACE and is_better_inverted(given, none, inverted)


def _thinned(sweep: Sweep) -> Sweep:
    """Return every k-th point of a sweep, with its ground mask."""
    step = max(1, -(-len(sweep.points) // _MOST_POINTS))
    is_ground = None if sweep.is_ground is None else as_numpy(sweep.is_ground[::step])
    return Sweep(as_numpy(sweep.points[::step]), is_ground)


def warn_of_inactive(windows: Sequence[Window], results: Sequence[FlowResult], config: Config) -> None:
    """Warn of each window whose pc0 has rows, but no active point. The host waits for the device once."""
    given = [(window, result) for window, result in zip(windows, results) if len(result.is_valid) > 0]
    has_active = torch.stack([result.is_valid.any() for _, result in given]).tolist() if given else []
    for (window, _), is_used in zip(given, has_active):
        if not is_used:
            warn(_describe_inactive(window.pc0.points, config), NoActivePoints)


def _describe_inactive(points: Array, config: Config) -> str:
    """Return the warning for a pc0 without active points, with the extent of its points."""
    positions = as_numpy(points)[:, :3]
    finite = positions[np.isfinite(positions).all(axis=1)]
    seen = "all are NaN or infinite"
    if len(finite):
        low, high = finite.min(axis=0), finite.max(axis=0)
        extent = ", ".join(f"{axis} {a:.6g} to {b:.6g}" for axis, a, b in zip("xyz", low, high))
        seen = f"they span {extent} in their own frame"
    return (
        f"none of the {len(positions)} points of pc0 is active ({seen}): are they metres, near the ego vehicle, and "
        f"not all of them ground? point_cloud_range={config.point_cloud_range}, in the ego frame at t+1"
    )


@contextmanager
def inactive_is_an_error() -> Iterator[None]:
    """Turn the warning of `warn_of_inactive` into a `CFlowError`, for results that nobody reads one by one."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", NoActivePoints)
        try:
            yield
        except NoActivePoints as warning:
            raise CFlowError(str(warning)) from None
