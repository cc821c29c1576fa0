"""Coarse to fine (the paper's multi-scale strategy): at each scale, warp by the flow so far, project, and estimate."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cflow_torch.model import Motion, SceneFlowModel
from cflow_torch.ops.chunks import chunks
from cflow_torch.stages import stage
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch


@dataclass(frozen=True)
class ProjectedSweeps:
    """Occupancy images of all sweeps of all windows."""

    batch: Batch  # points of all windows
    grid: Grid  # pixels of the bird's-eye view
    # (A, P) float64, metres per sweep interval: flow found so far of each point; undefined at t+1. None = no flow yet.
    flow: Tensor | None
    occupancy: Tensor  # (B, S, H, W) bool; index 0 of S is sweep t+1
    pixel: Tensor  # (P,) int64, flat index into `occupancy`; B * S * H * W for ignored points

    def positions(self) -> Tensor:
        """Return the warped positions of all points, (A, P) float64, metres, frame of t+1."""
        if self.flow is None:
            return self.batch.positions
        before = slice(self.batch.num_newest, None)
        return torch.cat((self.batch.positions[:, : before.start], _warp(self.batch, self.flow, before)), 1)


def project(batch: Batch, flow: Tensor | None, grid: Grid) -> ProjectedSweeps:
    """Warp every sweep by its flow so far times its intervals to t+1, and draw it (Eq. 3d_to_bev).

    `flow` is as in `ProjectedSweeps`. At this scale, we ignore points that are warped out of the images.
    """
    num_images = batch.num_windows * batch.num_steps
    num_points = len(batch.image)
    pixel = torch.empty(num_points, dtype=torch.int64, device=batch.image.device)
    for points in chunks(0, batch.num_newest, pixel.device):
        pixel[points] = grid.pixel_of_image(batch.positions[:, points], batch.image[points], num_images)
    for points in chunks(batch.num_newest, num_points, pixel.device):
        positions = batch.positions[:, points]
        is_active = batch.is_active[points]
        if flow is not None:
            positions = _warp(batch, flow, points)
            is_active = grid.contains(positions).logical_and_(is_active)
        pixel[points] = grid.pixel_of_image(positions, batch.image[points], num_images, is_active)
    occupancy = grid.draw(pixel, num_images).unflatten(0, (batch.num_windows, batch.num_steps))
    return ProjectedSweeps(batch, grid, flow, occupancy, pixel)


def _warp(batch: Batch, flow: Tensor, points: slice) -> Tensor:
    """Move points by their flow times their sweep intervals to t+1: (A, K) float64, metres."""
    intervals = batch.elapsed.flatten().index_select(0, batch.image[points])
    return (flow[:, points] * intervals).add_(batch.positions[:, points])


class CoarseToFine(SceneFlowModel):
    """Base of the paper's two methods. A method implements `motion_at_scale`."""

    def motion(self, batch: Batch) -> Motion:
        """Add up the motion of all `pixel_sizes`, coarse to fine."""
        flow = None
        motion = None
        for pixel_size in self.config.pixel_sizes:
            if motion is not None:
                with stage("spread"):
                    flow = _flow_so_far(batch, flow, motion)
            with stage("project"):
                sweeps = project(batch, flow, self.grid(pixel_size))
            motion = self.motion_at_scale(sweeps)
        assert motion is not None  # there is at least one pixel size
        return replace(motion, before=flow)

    def motion_at_scale(self, sweeps: ProjectedSweeps) -> Motion:
        """Estimate the motion that remains after the sweeps were warped by the flow so far."""
        raise NotImplementedError


def _flow_so_far(batch: Batch, flow: Tensor | None, motion: Motion) -> Tensor:
    """Add the flow of a scale to the flow of the coarser ones: `ProjectedSweeps.flow`. `flow` is overwritten."""
    total = torch.empty_like(batch.positions) if flow is None else flow
    for points in chunks(batch.num_newest, len(batch.image), batch.image.device):
        flow_of_chunk = total[:, points]
        cluster = motion.cluster(points)
        if flow is None:
            motion.flow_of(cluster, out=flow_of_chunk)
        else:
            flow_of_chunk += motion.flow_of(cluster, out=torch.empty_like(flow_of_chunk))
    return total
