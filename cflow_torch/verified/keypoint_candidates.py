"""Motion candidates of key points: matches t -> t+1 once per batch, their median in each component."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cflow_torch.config import KeypointsConfig, VerifiedConfig
from cflow_torch.keypoints.descriptors import describe
from cflow_torch.keypoints.match_candidates import match_radius
from cflow_torch.keypoints.matching import match
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.ops.segments import segment_median
from cflow_torch.verified.component_tree import Level
from cflow_torch.verified.height_slices import HeightSlicedSweeps

# Cheap key points, on pixels of 2 x 2 finest ones: they only propose.
_BLOCK = 2
_SETTINGS = KeypointsConfig(patch_size=21, ratio_threshold=1.02, gate_radius=3.0)
BYTES_PER_POINT = _SETTINGS.patch_size**2  # two copies of L^2 bytes for at most half of the points


@dataclass(frozen=True)
class KeyPointMotion:
    """Where matched key points have gone.

    Args:
        pixel: (N,) int64, positions in the list of occupied finest pixels, ascending; they are of sweep t.
        motion: (N, 2) float64, (y, x), finest pixels t -> t+1, of the key point that each lies in.
    """

    pixel: Tensor
    motion: Tensor

    def of_components(self, level: Level) -> Tensor:
        """(M, 2) float64, (y, x), finest pixels per sweep interval: the median of each axis over a component's matched
        pixels, of an even number the mean of the middle two; 0 without a match."""
        own, count = level.component.index_select(0, self.pixel), level.num_components
        return torch.stack([segment_median(values, own, count + 1)[:count] for values in self.motion.unbind(1)], 1)


def match_key_points(sweeps: HeightSlicedSweeps, config: VerifiedConfig) -> KeyPointMotion:
    """Match the key points of sweep t with those of t+1 (Sec. CorrelationFlow-Keypoints).

    Args:
        sweeps: finest images.
        config: `max_speed`, `max_memory`.

    Returns:
        The motion of every finest pixel in a matched key point.

    Convention: a coarse pixel is occupied where any slice of any of its finest pixels is.

    Cost: that of the key-point variant at that pixel size.
    """
    settings = _SETTINGS.replace(max_speed=config.max_speed, max_memory=config.max_memory)
    images, column = sweeps.coarsen(_BLOCK)
    pc1, pc0 = (describe(images[:, step].bool(), settings.patch_size) for step in (0, 1))
    radius = match_radius(sweeps.batch, sweeps.grid.pixel_size * _BLOCK, settings)
    matches = match(pc0, pc1, radius, settings)
    num_matches, num_columns = matches.source.numel(), images[:, 0].numel()
    match_at = torch.full((num_columns,), num_matches, dtype=torch.int64, device=column.device)
    match_at[pc0.place.index_select(0, matches.source)] = torch.arange(num_matches, device=column.device)
    found = match_at.index_select(0, column)
    pixel = flat_nonzero((sweeps.step == 1) & (found < num_matches))
    return KeyPointMotion(pixel, matches.shift.index_select(0, found.index_select(0, pixel)).double() * _BLOCK)
