"""CorrelationFlow-Keypoints (Sec. CorrelationFlow-Keypoints): project, detect, describe, match, densify."""

from __future__ import annotations

from typing import Optional

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.profiler import record_function

from cflow_torch.keypoints.densify import densify
from cflow_torch.keypoints.descriptors import describe, detect
from cflow_torch.keypoints.match_candidates import gate
from cflow_torch.keypoints.matching import match
from cflow_torch.model import CoarseToFine, Motion, project
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch


class CorrelationFlowKeypoints(CoarseToFine):
    """The paper's key-point variant: windows of one pair of sweeps in, flow out. No parameters, no buffers, no state.

    Args:
        config: settings with `method="keypoints"`; `CorrelationFlowKeypoints.from_preset` makes them from a preset.

    Convention:
        The paper matches one pair of sweeps at one scale. Several `pixel_sizes` work as in the dense method (an
        extension); history does not, and `Config` refuses it.

    Example:
        >>> from cflow_torch import CorrelationFlowKeypoints, Sweep, Window
        >>> model = CorrelationFlowKeypoints.from_preset("paper")
        >>> car = 0.1 * torch.cartesian_prod(torch.arange(45.0), torch.arange(18.0), torch.arange(15.0)) + 5.05
        >>> window = Window(pc0=Sweep(car), pc1=Sweep(car + torch.tensor([0.5, 0.0, 0.0])))
        >>> (result,) = model([window])
        >>> result.residual_flow[0]
        tensor([0.5000, 0.0000, 0.0000])
    """

    method = "keypoints"

    def motion_at_scale(self, batch: Batch, flow: Optional[Tensor], grid: Grid) -> Motion:
        """Sec. CorrelationFlow-Keypoints at one pixel size, over points warped by the flow so far."""
        config = self.config
        occupancy, pixel = project(batch, flow, grid)
        with record_function("describe"):
            is_key_point = detect(occupancy)
            _, pc1 = describe(occupancy[:, 0], is_key_point[:, 0], config.patch_size)
            place0, pc0 = describe(occupancy[:, 1], is_key_point[:, 1], config.patch_size)
        with record_function("match"):
            matches = match(pc0, pc1, gate(batch, grid.pixel_size, config), config)
        with record_function("densify"):
            place = place0.index_select(0, matches.source)
            dense = densify(occupancy[:, 1], place, matches, grid.pixel_size, config)
            num_groups = len(dense.shift)
            of_pixel = torch.full((occupancy.numel() + 1,), num_groups, dtype=torch.int32, device=pixel.device)
            image_size = grid.height * grid.width
            # Image b of sweep t is image 2 b + 1 of the occupancy.
            in_occupancy = dense.pixel + (dense.pixel // image_size + 1) * image_size
            of_pixel.scatter_(0, in_occupancy, dense.group.int())
            return Motion(
                of_place=of_pixel,
                place=pixel,
                flow=F.pad(dense.shift.flip(1) * grid.pixel_size + 0.0, (0, 1, 0, 1)),  # (dy, dx) -> (x, y, 0); no -0.0
                cluster_id=F.pad(dense.number, (0, 1), value=-1),
                score=F.pad(dense.score.float(), (0, 1)),
            )
