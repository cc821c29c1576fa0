"""Coarse to fine (the paper's multi-scale strategy): estimate, warp the points by the flow so far, refine."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from cflow_torch.dense.projection import ProjectedSweeps, project
from cflow_torch.model import Motion, SceneFlowModel
from cflow_torch.ops.chunks import chunks
from cflow_torch.stages import stage
from cflow_torch.windows.collation import Batch


class CoarseToFine(SceneFlowModel):
    """Base of the paper's two methods. A method implements `motion_at_scale`."""

    def motion(self, batch: Batch) -> Motion:
        """Add up the motion of all `pixel_sizes`, coarse to fine."""
        flow, motion = None, None
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
    """(A, P) float64, metres per sweep interval: sum of the flow over the scales, for every point before t+1."""
    total = torch.empty_like(batch.positions) if flow is None else flow
    for points in chunks(batch.num_newest, len(batch.image), batch.image.device):
        of_chunk, cluster = total[:, points], motion.cluster(points)
        if flow is None:
            motion.flow_of(cluster, out=of_chunk)
        else:
            of_chunk += motion.flow_of(cluster, out=torch.empty_like(of_chunk))
    return total
