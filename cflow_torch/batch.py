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
from cflow_torch.types import CFlowError, FlowResult, Sweep, Window

# Working memory that a window takes before its clusters are known: positions, pixels and temporaries of a point;
# occupancy and cluster of a pixel of every sweep.
_BYTES_PER_POINT = 160
_BYTES_PER_PIXEL = 10

# Sweeps further apart than this many times the step from t to t+1 are no steady history: counting steps would mislead.
_LONGEST_GAP = 2.5
# No sweep of a window is further away than this, metres: 2 s at 50 m/s.
_FARTHEST_POSE = 100.0


@dataclass(frozen=True)
class Batch:
    """All points of all sweeps of all windows, one after the other: window by window, t+1, t, t-1, ... in each.

    Args:
        positions: (3, P) float64, metres, frame of t+1 of the point's window.
        takes_part: (P,) bool, finite, not ground, inside the region.
        image: (P,) int64, window * num_steps + step of each point; step 0 = sweep t+1, 1 = t, 2 = t-1, ...
        num_windows: B.
        num_steps: S, 1 + the longest list of source sweeps.
        elapsed: (B, S) float64, sweep intervals from the sweep to t+1: the k that divides an estimate and
            scales a warp (0 for step 0).
        seconds: (B, S) float64, the same in seconds, for `max_speed`.
        sources: where the points of each window's pc0 lie among the P points.
        pose_flow: (N, 3) float32 of each window's pc0.
    """

    positions: Tensor
    takes_part: Tensor
    image: Tensor
    num_windows: int
    num_steps: int
    elapsed: Tensor
    seconds: Tensor
    sources: Tuple[slice, ...]
    pose_flow: Tuple[Tensor, ...]


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
    if isinstance(windows, (Window, Sweep)) or not all(isinstance(w, Window) for w in windows):
        raise CFlowError("give a list of cflow_torch.Window (for one window, a list of length one)")
    groups: List[List[Window]] = []
    used = 0
    for window in windows:
        sweeps = (window.pc1, window.pc0, *window.pch)
        points = sum(shape[0] for shape in (getattr(sweep.points, "shape", ()) for sweep in sweeps) if shape)
        needed = _BYTES_PER_POINT * points + (_BYTES_PER_PIXEL * len(sweeps) + 30) * grid.height * grid.width
        if not groups or (config.max_memory is not None and used + needed > config.max_memory):
            groups.append([])
            used = 0
        groups[-1].append(window)
        used += needed
    return groups


def make_batch(windows: Sequence[Window], config: Config, grid: Grid, device: Any = "auto") -> Batch:
    """Check windows, bring every sweep into the frame of its t+1, mark what takes part.

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
    chosen_device = _device(windows, device)
    kept = [_sources(window, config) for window in windows]
    num_steps = 1 + max(len(sources) for sources in kept)
    positions, takes_part, sources, pose_flow = [], [], [], []
    image, count, num_points = [], [], 0
    elapsed, seconds = np.zeros((2, len(windows), num_steps))
    for index, (window, source_sweeps) in enumerate(zip(windows, kept)):
        times = _elapsed(window, source_sweeps, config)
        elapsed[index, 1 : 1 + len(times)], seconds[index, 1 : 1 + len(times)] = zip(*times)
        for step, (name, sweep, _) in enumerate([("pc1", window.pc1, 0), *source_sweeps]):
            raw = _positions(sweep, name, chosen_device)
            transform = None
            if sweep.pose is not None and step > 0:
                transform = relative_transform(window.pc1.pose, sweep.pose, f"pose of {name}")
                _check_distance(transform, name)
            moved = compensate(raw, transform)
            inside = grid.contains(moved)
            if sweep.is_ground is not None:
                inside &= ~_ground(sweep, name, raw.shape[1], chosen_device)
            if step == 1:
                sources.append(slice(num_points, num_points + raw.shape[1]))
                pose_flow.append(_pose_flow(raw, moved))
            positions.append(moved)
            takes_part.append(inside)
            image.append(index * num_steps + step)
            count.append(raw.shape[1])
            num_points += raw.shape[1]
    return Batch(
        positions=torch.cat(positions, 1),
        takes_part=torch.cat(takes_part),
        image=torch.repeat_interleave(
            torch.tensor(image, device=chosen_device), torch.tensor(count, device=chosen_device), output_size=num_points
        ),
        num_windows=len(windows),
        num_steps=num_steps,
        elapsed=torch.as_tensor(elapsed, device=chosen_device),
        seconds=torch.as_tensor(seconds, device=chosen_device),
        sources=tuple(sources),
        pose_flow=tuple(pose_flow),
    )


def split_results(batch: Batch, residual_flow: Tensor, cluster_id: Tensor, score: Tensor) -> List[FlowResult]:
    """Values of all points -> one result per window, for the points of its pc0.

    Args:
        batch: as made by `make_batch`.
        residual_flow: (P, 3) float64, metres, axes of ego1.
        cluster_id: (P,) int64, -1 = none.
        score: (P,) float32.

    Returns:
        B results.
    """
    results = []
    for rows, pose_flow in zip(batch.sources, batch.pose_flow):
        residual = residual_flow[rows].float()
        flow = residual + pose_flow
        results.append(FlowResult(residual, pose_flow, flow, cluster_id[rows], score[rows], batch.takes_part[rows]))
    return results


def _sources(window: Window, config: Config) -> List[Tuple[str, Sweep, int]]:
    """(name, sweep, steps to t+1) of pc0 and the history, repeated sweeps left out."""
    if len(window.pch) > config.num_history:
        raise CFlowError(
            f"the window has {len(window.pch)} history sweeps but num_history={config.num_history}: "
            "pass num_history, or fewer sweeps"
        )
    sweeps = [window.pc1, window.pc0, *window.pch]
    with_pose = [sweep.pose is not None for sweep in sweeps]
    if any(with_pose) and not all(with_pose):
        raise CFlowError(
            "some sweeps of the window have a pose and some have none: give the pose of every sweep, or of none "
            "(then all points must already lie in the frame of t+1)"
        )
    names = ["pc0", *(f"pch{i + 1}" for i in range(len(window.pch)))]
    sources: List[Tuple[str, Sweep, int]] = []
    for step, (name, sweep) in enumerate(zip(names, sweeps[1:]), 1):
        if not any(_same(sweep, other) for _, other, _ in sources):
            sources.append((name, sweep, step))
    return sources


def _same(a: Sweep, b: Sweep) -> bool:
    """Same points and same pose: harnesses repeat the first sweep of a scene where history is missing."""
    if a is b:
        return True
    if not all(isinstance(x.points, (np.ndarray, Tensor)) for x in (a, b)) or a.points.shape != b.points.shape:
        return False
    if (a.pose is None) != (b.pose is None):
        return False
    same_pose = a.pose is None or np.array_equal(_numpy(a.pose), _numpy(b.pose))
    return same_pose and np.array_equal(_numpy(a.points), _numpy(b.points), equal_nan=True)


def _elapsed(
    window: Window, sources: Sequence[Tuple[str, Sweep, int]], config: Config
) -> Sequence[Tuple[float, float]]:
    """(sweep intervals, seconds) from each source sweep to t+1, by time stamps where every sweep of the window has one."""
    stamps = [sweep.timestamp_ns for sweep in (window.pc1, window.pc0, *window.pch)]
    if any(stamp is None for stamp in stamps):
        return [(float(step), step * config.sweep_interval) for _, _, step in sources]
    gaps = [int(window.pc1.timestamp_ns) - int(sweep.timestamp_ns) for _, sweep, _ in sources]  # type: ignore[arg-type]
    intervals = [later - earlier for earlier, later in zip([0, *gaps], gaps)]
    if min(intervals) <= 0:
        raise CFlowError(
            f"time stamps of the window are out of order (nanoseconds before t+1: {gaps}): "
            "give pc1, pc0, pch1, ... from newest to oldest"
        )
    if config.use_timestamps:
        return [(gap / gaps[0], gap / 1e9) for gap in gaps]
    steps = [after - before for before, after in zip([0, *(s for _, _, s in sources)], (s for _, _, s in sources))]
    worst = max(interval / (step * gaps[0]) for interval, step in zip(intervals, steps))
    if worst > _LONGEST_GAP:
        raise CFlowError(
            f"the sweeps are unevenly spaced (nanoseconds before t+1: {gaps}; one gap is {worst:.1f} times that from t to "
            "t+1): pass use_timestamps=True, or leave out the sweeps before the gap"
        )
    return [(float(step), gap / 1e9) for (_, _, step), gap in zip(sources, gaps)]


def _check_distance(T_ego1_ego: np.ndarray, name: str) -> None:
    distance = float(np.linalg.norm(T_ego1_ego[:3, 3]))
    if distance > _FARTHEST_POSE:
        raise CFlowError(
            f"the ego vehicle moves {distance:.0f} m between {name} and pc1 (at most {_FARTHEST_POSE:.0f} m): "
            "are the poses of another log, or not in metres?"
        )


def _numpy(array: Any) -> np.ndarray:
    return array.detach().cpu().numpy() if isinstance(array, Tensor) else np.asarray(array)


def _device(windows: Sequence[Window], device: Any) -> torch.device:
    if not (isinstance(device, str) and device == "auto"):
        try:
            return torch.device(device)
        except (RuntimeError, TypeError):
            raise CFlowError(f"device={device!r}: give 'auto', 'cpu', 'cuda' or a torch.device") from None
    found = {
        array.device
        for window in windows
        for sweep in (window.pc0, window.pc1, *window.pch)
        for array in (sweep.points, sweep.is_ground)
        if isinstance(array, Tensor)
    }
    if len(found) > 1:
        names = ", ".join(sorted(str(d) for d in found))
        raise CFlowError(f"tensors lie on different devices ({names}): put them on one, or pass device=...")
    if found:
        return found.pop()
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def _positions(sweep: Sweep, name: str, device: torch.device) -> Tensor:
    """(3, N) float64 copy of the first three columns; the input is never modified."""
    points = sweep.points
    if not isinstance(points, (np.ndarray, Tensor)):
        raise CFlowError(f"{name} is {type(points).__name__}: give a NumPy array or a torch tensor of shape (N, 3+)")
    if points.ndim != 2 or points.shape[1] < 3:
        raise CFlowError(f"{name} has shape {tuple(points.shape)}: give (N, 3+), columns x, y, z in metres")
    if isinstance(points, Tensor):
        if not points.is_floating_point():
            raise CFlowError(f"{name} has dtype {points.dtype}: give floating-point metres")
        return points.detach()[:, :3].to(device).t().to(torch.float64).contiguous()
    if not np.issubdtype(points.dtype, np.floating):
        raise CFlowError(f"{name} has dtype {points.dtype}: give floating-point metres")
    return torch.from_numpy(np.array(points[:, :3].T, dtype=np.float64, order="C")).to(device)


def _ground(sweep: Sweep, name: str, num_points: int, device: torch.device) -> Tensor:
    mask = sweep.is_ground
    if not isinstance(mask, (np.ndarray, Tensor)):
        raise CFlowError(f"ground mask of {name} is {type(mask).__name__}: give a bool array or tensor of shape (N,)")
    if tuple(mask.shape) != (num_points,):
        raise CFlowError(f"ground mask of {name} has shape {tuple(mask.shape)}: give ({num_points},), one per point")
    if mask.dtype not in (torch.bool, np.bool_):
        raise CFlowError(f"ground mask of {name} has dtype {mask.dtype}: give bool, True = ground")
    if isinstance(mask, np.ndarray):
        mask = torch.from_numpy(np.array(mask))
    return mask.to(device)


def _pose_flow(raw: Tensor, moved: Tensor) -> Tensor:
    """(N, 3) float32 T p - p; 0 for points that are not finite."""
    if moved is raw:
        return torch.zeros((raw.shape[1], 3), dtype=torch.float32, device=raw.device)
    flow = (moved - raw).float()
    flow[:, ~torch.isfinite(flow).all(0)] = 0
    return flow.t().contiguous()

