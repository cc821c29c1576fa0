"""CorrelationFlow-Keypoints (Sec. CorrelationFlow-Keypoints): project, detect, describe, match, densify."""

from __future__ import annotations

from typing import Optional, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.profiler import record_function

from cflow_torch.batch import Batch
from cflow_torch.config import Config
from cflow_torch.densify import densify
from cflow_torch.grid import Grid
from cflow_torch.match import KeyPoints, match
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.ops.morphology import erode_cross
from cflow_torch.ops.patches import gather_patches
from cflow_torch.pyramid import CoarseToFine, Motion, project

# `gate_radius` is the distance that a match may cover in this time.
_GATE_SECONDS = 0.1


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
        _, occupancy, pixel = project(batch, flow, grid)
        with record_function("describe"):
            is_key_point = detect(occupancy)
            _, pc1 = describe(occupancy[:, 0], is_key_point[:, 0], config.patch_size)
            place0, pc0 = describe(occupancy[:, 1], is_key_point[:, 1], config.patch_size)
        with record_function("match"):
            matches = match(pc0, pc1, gate(batch, grid, config), config)
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
                cluster=of_pixel.index_select(0, pixel),
                flow=F.pad(dense.shift.flip(1) * grid.pixel_size + 0.0, (0, 1, 0, 1)),  # (dy, dx) -> (x, y, 0); no -0.0
                cluster_id=F.pad(dense.number, (0, 1), value=-1),
                score=F.pad(dense.score.float(), (0, 1)),
            )


def detect(occupancy: Tensor) -> Tensor:
    """Key points: occupied pixels at distance 1 from the background (Sec. Keypoints).

    Args:
        occupancy: (..., H, W) bool.

    Returns:
        (..., H, W) bool.

    Convention: the distance is Euclidean, so one of the four neighbours is free; outside the image all is free.
    """
    return occupancy & ~erode_cross(occupancy)


def describe(images: Tensor, is_key_point: Tensor, patch_size: int) -> Tuple[Tensor, KeyPoints]:
    """Key points of one sweep and their descriptors (Sec. Descriptor).

    Args:
        images: (B, H, W) bool, occupancy of the sweep of every window.
        is_key_point: (B, H, W) bool.
        patch_size: L, odd.

    Returns:
        place: (K,) int64, flat indices into `images`, ascending.
        key_points: with their L x L patches, zero outside the image.

    Cost: memory K L^2 bytes; the images are not unfolded.
    """
    _, height, width = images.shape
    place = flat_nonzero(is_key_point)
    line = place // width
    window, col = line // height, place - line * width
    row = line - window * height
    return place, KeyPoints(window, row, col, *gather_patches(images, window, row, col, patch_size))


def gate(batch: Batch, grid: Grid, config: Config) -> Tensor:
    """(B,) float64, pixels: farthest match of each window, speed times the time from t to t+1."""
    seconds = batch.seconds[:, 1]
    size = torch.full_like(seconds, grid.pixel_size)  # a GPU would multiply by the reciprocal of a plain number
    reach = config.gate_radius * (seconds / torch.full_like(seconds, _GATE_SECONDS)) / size
    if config.max_speed is not None:
        reach = torch.minimum(reach, config.max_speed * seconds / size + 1)
    return reach
