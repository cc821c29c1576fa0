"""CorrelationFlow-Keypoints (Sec. CorrelationFlow-Keypoints): project, detect, describe, match, densify."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from cflow_torch.dense.coarse_to_fine import CoarseToFine, ProjectedSweeps
from cflow_torch.keypoints.densify import densify
from cflow_torch.keypoints.match_candidates import describe_keypoints, match_radius
from cflow_torch.keypoints.matching import match_keypoints
from cflow_torch.model import Motion
from cflow_torch.stages import stage


class CorrelationFlowKeypoints(CoarseToFine):
    """The paper's key-point variant: windows of two sweeps in, flow out. It has no parameters, no buffers and no state.

    Args:
        config: a `KeypointsConfig`. `CorrelationFlowKeypoints.from_preset` makes one from a preset.

    Convention:
        The paper matches one pair of sweeps at one scale. With several `pixel_sizes`, which are our extension, the
        method works coarse to fine, like the dense one.

    Examples:
        >>> from cflow_torch import CorrelationFlowKeypoints, Sweep, Window
        >>> model = CorrelationFlowKeypoints.from_preset("keypoints")
        >>> car = 0.1 * torch.cartesian_prod(torch.arange(45.0), torch.arange(18.0), torch.arange(15.0)) + 5.05
        >>> window = Window(pc0=Sweep(car), pc1=Sweep(car + torch.tensor([0.5, 0.0, 0.0])))
        >>> (result,) = model([window])
        >>> result.residual_flow[0]
        tensor([0.5000, 0.0000, 0.0000])
    """

    method = "keypoints"

    @property
    def bytes_per_point(self) -> int:  # type: ignore[override]
        """Working memory per point. At most half of the points are key points: 8 L bytes, and L^2 at t+1."""
        size = int(self.config.patch_size)
        return int(super().bytes_per_point) + 4 * size + size**2 // 4

    def motion_at_scale(self, sweeps: ProjectedSweeps) -> Motion:
        """Match the key points of t and t+1 at one pixel size and spread the matches to all points of t."""
        config = self.config
        occupancy = sweeps.occupancy
        pixel_size = sweeps.grid.pixel_size
        with stage("describe"):
            pc1 = describe_keypoints(occupancy[:, 0], config.patch_size)
            pc0 = describe_keypoints(occupancy[:, 1], config.patch_size)
        with stage("match"):
            matches = match_keypoints(pc0, pc1, match_radius(sweeps.batch, pixel_size, config), config)
        with stage("densify"):
            dense = densify(occupancy[:, 1], pc0.pixel.index_select(0, matches.source), matches, pixel_size, config)
            size = occupancy.numel() + 1
            cluster_of_cell = torch.full((size,), len(dense.shift), dtype=torch.int32, device=occupancy.device)
            # Sweep t of window b is image 2 b + 1 of the occupancy.
            image_size = occupancy[0, 0].numel()
            in_occupancy = dense.pixel + (dense.pixel // image_size + 1) * image_size
            return Motion(
                cluster_of_cell=cluster_of_cell.scatter_(0, in_occupancy, dense.group.int()),
                cell_of_point=sweeps.pixel,
                flow=F.pad(dense.shift.flip(1) * pixel_size, (0, 1, 0, 1)),  # (dy, dx) -> (x, y, 0)
                cluster_id=F.pad(dense.id_in_window, (0, 1), value=-1),
                score=F.pad(dense.score.float(), (0, 1)),
            )
