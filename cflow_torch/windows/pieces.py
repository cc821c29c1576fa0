"""Read the points of sweeps and bring them into the frame of t+1, piece by piece."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Iterator, NamedTuple, Sequence

import numpy as np
import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.ground.heights import GroundHeights
from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.indices import flat_nonzero, take_columns
from cflow_torch.tensors import read_ground, read_point_times, read_positions
from cflow_torch.types import Sweep
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.coverage import Coverage
from cflow_torch.windows.ego_motion import compensate
from cflow_torch.windows.timeline import Entry, Timeline


class Piece(NamedTuple):
    """K points of one sweep, or of all sweeps of a kind: all points of sweeps t, the active points of other sweeps."""

    step: int  # smallest step of the sweeps
    positions: Tensor  # this field and the next four are as in `Batch`
    is_active: Tensor
    has_result: Tensor
    image: Tensor
    point_times: Tensor | None
    # (K, 3) float32, metres, T_ego1_ego0 p - p of sweep t, 0 for points that are not finite; None for other sweeps.
    pose_flow: Tensor | None


def read_pieces(
    timeline: Timeline,
    config: Config,
    grid: Grid,
    device: torch.device,
    num_axes: int,
    ground: GroundHeights | None,
    coverage: Coverage | None,
) -> Iterator[Piece]:
    """Yield the pieces in the order of the timeline.

    The ground points of t are added to `ground`, and the points of sweeps with a ground mask to `coverage`. Either may
    be None.

    The other arguments are as for `make_batch`. For a CPU we read each sweep alone, in pieces that fit its cache. On a
    GPU few launches matter more, so we read all sweeps t+1 at once, then all sweeps t, then all others.
    """
    on_cpu = device.type == "cpu"
    has_times = any(entry.interval is not None for entry in timeline.entries)
    reader = _Reader(
        grid=grid,
        region=Grid(grid.pixel_size, config.point_cloud_range[:3], config.point_cloud_range[3:]),
        ego_box=config.ego_box,
        num_axes=num_axes,
        ground=ground,
        coverage=coverage,
        device=device,
    )
    for _, entries in groupby(timeline.entries, lambda entry: entry[:2] if on_cpu else min(entry.step, 2)):
        sweeps = _Sweeps.of(list(entries), timeline.table.shape[2], has_times, device)
        num_points = max(sweeps.sweeps[0].points.shape[0], 1)  # an empty sweep gives an empty piece
        for rows in chunks(0, num_points, device) if on_cpu else [slice(None)]:
            yield reader.read(sweeps, rows)


@dataclass(frozen=True)
class _Sweeps:
    """Sweeps that are read together, with N points."""

    step: int  # smallest step of the sweeps
    sweeps: list[Sweep]
    window: int | Tensor  # of all points, or (N,) int64
    image: int | Tensor  # of all points, or (N,) int32
    T_ego1_ego: Tensor | None  # (3, 4, N) or (3, 4, 1) float64; None = the points are in the frame of t+1
    is_ground: Tensor | None  # (N,) bool
    point_times: Tensor | None  # (N,)

    @classmethod
    def of(cls, group: Sequence[Entry], num_steps: int, has_times: bool, device: torch.device) -> _Sweeps:
        """Read everything but the points."""
        sweeps = [entry.sweep for entry in group]
        has_ground = any(sweep.is_ground is not None for sweep in sweeps)
        times = None
        if has_times:
            times = torch.cat([read_point_times(entry.sweep, entry.name, entry.interval, device) for entry in group])
        return cls(
            group[0].step,
            sweeps,
            *_of_points(group, num_steps, device),
            is_ground=read_ground(sweeps, device) if has_ground else None,
            point_times=times,
        )


@dataclass(frozen=True)
class _Reader:
    """Reads points and decides which of them are active."""

    grid: Grid  # of the images
    region: Grid  # where points have results
    ego_box: tuple[float, ...] | None
    num_axes: int
    ground: GroundHeights | None
    coverage: Coverage | None
    device: torch.device

    def read(self, sweeps: _Sweeps, rows: slice) -> Piece:
        """Read some points of sweeps, and move them to t+1."""
        raw = read_positions(sweeps.sweeps, self.device, rows)
        moved = raw
        if sweeps.T_ego1_ego is not None:
            num_axes = 3 if sweeps.step == 1 else max(self.num_axes, self._num_checked(sweeps))
            moved = compensate(raw, sweeps.T_ego1_ego, num_axes)
        is_active = self._is_active(sweeps, rows, raw, moved)
        if self.coverage is not None and sweeps.is_ground is not None:
            self.coverage.add(sweeps.image, raw, sweeps.T_ego1_ego, sweeps.is_ground[rows])
        if sweeps.step == 1:
            return Piece(
                step=1,
                positions=moved[: self.num_axes],
                is_active=is_active,
                has_result=is_active if self.region == self.grid else is_active & self.region.contains(moved),
                image=_of_each(sweeps.image, is_active),
                point_times=None if sweeps.point_times is None else sweeps.point_times[rows].float(),
                pose_flow=_pose_flow(raw, moved),
            )
        row = flat_nonzero(is_active)
        all_active = torch.ones_like(row, dtype=torch.bool)
        return Piece(
            step=sweeps.step,
            positions=take_columns(moved[: self.num_axes], row),
            is_active=all_active,
            has_result=all_active,
            image=_of_each(_select(sweeps.image, row), all_active),
            point_times=None if sweeps.point_times is None else _select(sweeps.point_times[rows], row).float(),
            pose_flow=None,
        )

    def _num_checked(self, sweeps: _Sweeps) -> int:
        """Return how many axes of a position we compare with the bounds of the images.

        We need not check an unbounded z after a transform, which spreads a z that is not finite to x and y.
        """
        has_bounds = not (math.isinf(self.grid.lower[2]) and math.isinf(self.grid.upper[2]))
        return 3 if sweeps.T_ego1_ego is None or has_bounds else 2

    def _is_active(self, sweeps: _Sweeps, rows: slice, raw: Tensor, moved: Tensor) -> Tensor:
        """Find the active points, (N,) bool, and add the ground points of t to `ground`."""
        is_active = self.grid.contains(moved[: self._num_checked(sweeps)])
        if sweeps.is_ground is not None:
            is_ground = sweeps.is_ground[rows]
            if self.ground is not None and sweeps.step == 1:
                row = flat_nonzero(is_active & is_ground)
                self.ground.add(_select(sweeps.window, row), take_columns(moved, row))
            is_active &= ~is_ground
        if self.ego_box is not None:
            x0, y0, x1, y1 = self.ego_box
            is_active &= (raw[0] < x0) | (raw[0] > x1) | (raw[1] < y0) | (raw[1] > y1)
        return is_active


def _of_points(
    group: Sequence[Entry], num_steps: int, device: torch.device
) -> tuple[int | Tensor, int | Tensor, Tensor | None]:
    """Return window and image of each point, (N,) or one number, and transforms, (3, 4, N), (3, 4, 1) or None."""
    transforms = _transforms(group, device)  # [3, 4, sweeps]
    if len(group) == 1:
        return group[0].window, group[0].window * num_steps + group[0].step, transforms
    sizes = [entry.sweep.points.shape[0] for entry in group]
    rows = [(e.window, e.window * num_steps + e.step, size) for e, size in zip(group, sizes)]
    window, image, count = torch.as_tensor(rows, device=device).unbind(1)
    sweep = torch.repeat_interleave(count, output_size=sum(sizes))
    if transforms is not None:
        transforms = transforms.index_select(2, sweep)
    return window.index_select(0, sweep), image.int().index_select(0, sweep), transforms


def _transforms(group: Sequence[Entry], device: torch.device) -> Tensor | None:
    """Return T_ego1_ego of sweeps, (3, 4, sweeps) float64; None if none has one."""
    if all(entry.T_ego1_ego is None for entry in group):
        return None
    matrices = [np.eye(4) if entry.T_ego1_ego is None else entry.T_ego1_ego for entry in group]
    return torch.as_tensor(np.stack(matrices, 2)[:3], device=device)  # the last row is known


def _select(values: Any, row: Tensor) -> Any:
    """Select the values of points. A number is the value of every point, and stays."""
    return values.index_select(0, row) if isinstance(values, Tensor) else values


def _of_each(image: int | Tensor, points: Tensor) -> Tensor:
    """Return the image of each point, (N,) int32, from those of all points or from the number of one image."""
    return image if isinstance(image, Tensor) else torch.full_like(points, image, dtype=torch.int32)


def _pose_flow(raw: Tensor, moved: Tensor) -> Tensor:
    """Return T p - p, (N, 3) float32; 0 for points that are not finite. Overwrite `raw`."""
    flow = torch.zeros((raw.shape[1], 3), dtype=torch.float32, device=raw.device)
    if moved is raw:
        return flow
    # Column by column, because on the CPU a transposed copy of all three takes longer.
    for of_axis, difference in zip(flow.unbind(1), torch.sub(moved, raw, out=raw).unbind(0)):
        of_axis.copy_(difference)
    # A point that is not finite has no finite coordinate after the transform.
    return flow.nan_to_num_(0.0, 0.0, 0.0)
