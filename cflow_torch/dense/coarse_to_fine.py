"""Coarse to fine (the paper's multi-scale strategy): estimate, warp the points by the flow so far, repeat finer."""

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
    """What the paper's two methods share. A method writes `motion_at_scale`."""

    def motion(self, batch: Batch) -> Motion:
        """The sum of what all `pixel_sizes` find, coarse to fine."""
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
        """What one scale adds to the flow that the sweeps were warped by."""
        raise NotImplementedError


def _flow_so_far(batch: Batch, flow: Tensor | None, motion: Motion) -> Tensor:
    """(A, P) float64, metres per sweep interval: the sum over the scales, of every point before t+1."""
    total = torch.empty_like(batch.positions) if flow is None else flow
    for points in chunks(batch.num_newest, len(batch.image), batch.image.device):
        part, cluster = total[:, points], motion.cluster(points)
        if flow is None:
            motion.flow_of(cluster, out=part)
        else:
            part += motion.flow_of(cluster, out=torch.empty_like(part))
    return total
