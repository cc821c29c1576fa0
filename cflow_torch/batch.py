"""The door: windows of arrays or tensors -> one checked set of tensors in the frame of t+1."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, List, Sequence, Tuple

import numpy as np
import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.ego import compensate, relative_transform
from cflow_torch.grid import Grid
from cflow_torch.inputs import (
    check_distance,
    check_windows,
    choose_device,
    elapsed_times,
    read_ground,
    read_positions,
    source_sweeps,
)
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.types import FlowResult, Window

# Working memory that a window takes before its clusters are known: positions, pixels and temporaries of a point;
# occupancy and cluster of a pixel of every sweep.
_BYTES_PER_POINT = 160
_BYTES_PER_PIXEL = 10


@dataclass(frozen=True)
class Batch:
    """The points that take part, of all sweeps of all windows one after the other: t+1, t, t-1, ... of each window.

    Args:
        positions: (3, P) float64, metres, frame of t+1 of the point's window; finite, not ground, inside the region.
        image: (P,) int64, window * num_steps + step of each point; step 0 = sweep t+1, 1 = t, 2 = t-1, ...
        num_windows: B.
        num_steps: S, 1 + the longest list of source sweeps.
        elapsed: (B, S) float64, sweep intervals from the sweep to t+1: the k that divides an estimate and
            scales a warp (0 for step 0).
        seconds: (B, S) float64, the same in seconds, for `max_speed`.
        sources: of each window, what its result is made of.
    """

    positions: Tensor
    image: Tensor
    num_windows: int
    num_steps: int
    elapsed: Tensor
    seconds: Tensor
    sources: Tuple[Source, ...]


@dataclass(frozen=True)
class Source:
    """pc0 of one window: all N rows of it, and which of the batch's points they are.

    Args:
        points: its points among the P points of the batch, Q of them.
        row: (Q,) int64, their rows in pc0.
        takes_part: (N,) bool.
        pose_flow: (N, 3) float32.
    """

    points: slice
    row: Tensor
    takes_part: Tensor
    pose_flow: Tensor


def split_windows(windows: Sequence[Window], config: Config, grid: Grid) -> List[List[Window]]:
    """Windows in groups that fit `max_memory`, in order. The result of a window does not depend on its group.

    Args:
        windows: B windows; an empty list gives no group.
        config: `max_memory`; None = one group.
        grid: the finest scale, whose images are the largest.

    Returns:
        Groups of at least one window.

    Raises:
        CFlowError: not a list of windows.
    """
    check_windows(windows)
    groups: List[List[Window]] = []
    used = 0
    per_point = _BYTES_PER_POINT
    if config.method == "keypoints":  # descriptors: two copies of L^2 bytes for at most half of the points
        per_point += config.patch_size**2
    for window in windows:
        sweeps = (window.pc1, window.pc0, *window.pch)
        points = sum(sweep.points.shape[0] for sweep in sweeps)
        needed = per_point * points + (_BYTES_PER_PIXEL * len(sweeps) + 30) * grid.height * grid.width
        if not groups or (config.max_memory is not None and used + needed > config.max_memory):
            groups.append([])
            used = 0
        groups[-1].append(window)
        used += needed
    return groups


def make_batch(windows: Sequence[Window], config: Config, grid: Grid, device: Any = "auto") -> Batch:
    """Check windows, bring every sweep into the frame of its t+1, keep what takes part.

    Args:
        windows: B windows, at least one.
        config: settings; `num_history` bounds the history that is accepted.
        grid: the region; which of the scales it belongs to does not matter here.
        device: "auto" = that of the tensors given, else a GPU if there is one, else the CPU.

    Returns:
        The batch, on one device.

    Raises:
        CFlowError: wrong shape or dtype, a transform that is not rigid, mixed devices, poses for some sweeps
            only, more history than `num_history`, time stamps out of order or with gaps, poses too far apart.

    Cost: linear in points; the only Python loop over sweeps, because they arrive as a list.
    """
    chosen_device = choose_device(windows, device)
    kept = [source_sweeps(window, config) for window in windows]
    num_steps = 1 + max(len(sources) for sources in kept)
    positions, sources = [], []
    image, count, num_points = [], [], 0
    elapsed, seconds = np.zeros((2, len(windows), num_steps))
    for index, (window, older) in enumerate(zip(windows, kept)):
        times = elapsed_times(window, older, config)
        elapsed[index, 1 : 1 + len(times)], seconds[index, 1 : 1 + len(times)] = zip(*times)
        for step, (name, sweep, _) in enumerate([("pc1", window.pc1, 0), *older]):
            raw = read_positions(sweep, chosen_device)
            transform = None
            if sweep.pose is not None and step > 0:
                transform = relative_transform(window.pc1.pose, sweep.pose, f"pose of {name}")
                check_distance(transform, name)
            moved = compensate(raw, transform)
            takes_part = grid.contains(moved)
            if sweep.is_ground is not None:
                takes_part &= ~read_ground(sweep, name, raw.shape[1], chosen_device)
            row = flat_nonzero(takes_part)
            if step == 1:
                points = slice(num_points, num_points + row.numel())
                sources.append(Source(points, row, takes_part, _pose_flow(raw, moved)))
            positions.append(moved[:, row])
            image.append(index * num_steps + step)
            count.append(row.numel())
            num_points += row.numel()
    return Batch(
        positions=torch.cat(positions, 1),
        image=torch.repeat_interleave(
            torch.tensor(image, device=chosen_device), torch.tensor(count, device=chosen_device), output_size=num_points
        ),
        num_windows=len(windows),
        num_steps=num_steps,
        elapsed=torch.as_tensor(elapsed, device=chosen_device),
        seconds=torch.as_tensor(seconds, device=chosen_device),
        sources=tuple(sources),
    )


def split_results(batch: Batch, residual_flow: Tensor, cluster_id: Tensor, score: Tensor) -> List[FlowResult]:
    """Values of the points of the batch -> one full-length result per window, for all rows of its pc0.

    Args:
        batch: as made by `make_batch`.
        residual_flow: (P, 3) float64, metres, axes of ego1.
        cluster_id: (P,) int64, -1 = none.
        score: (P,) float32.

    Returns:
        B results; rows that took no part have residual flow 0, cluster -1, score 0, is_valid False.
    """
    results = []
    for source in batch.sources:
        pose_flow, is_valid = source.pose_flow.clone(), source.takes_part.clone()
        residual = torch.zeros_like(pose_flow).index_copy_(0, source.row, residual_flow[source.points].float())
        cluster = torch.full_like(is_valid, -1, dtype=torch.int64).index_copy_(0, source.row, cluster_id[source.points])
        scores = torch.zeros_like(is_valid, dtype=torch.float32).index_copy_(0, source.row, score[source.points])
        results.append(FlowResult(residual, pose_flow, residual + pose_flow, cluster, scores, is_valid))
    return results


def _pose_flow(raw: Tensor, moved: Tensor) -> Tensor:
    """(N, 3) float32 T p - p; 0 for points that are not finite."""
    if moved is raw:
        return torch.zeros((raw.shape[1], 3), dtype=torch.float32, device=raw.device)
    # A point that is not finite has no finite coordinate after the transform.
    flow = torch.empty((raw.shape[1], 3), dtype=torch.float32, device=raw.device)
    return flow.copy_((moved - raw).t()).nan_to_num_(0.0, 0.0, 0.0)
