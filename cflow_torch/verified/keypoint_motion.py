"""Key points as witnesses of motion: matches t -> t+1 once per batch, their median in each component of the proof."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.keypoints.descriptors import describe, detect
from cflow_torch.keypoints.match_candidates import gate
from cflow_torch.keypoints.matching import match
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.ops.segments import segment_median
from cflow_torch.verified.height_slices import Cells
from cflow_torch.verified.levels import coarsen
from cflow_torch.windows.collation import Batch


@dataclass(frozen=True)
class KeyPointMotion:
    """Where matched key points have gone.

    Args:
        pixel: (N,) int64, positions in the list of occupied finest pixels, ascending; they are of sweep t.
        motion: (N, 2) float64, (y, x), finest pixels t -> t+1, of the key point that each lies in.
    """

    pixel: Tensor
    motion: Tensor

    def of_components(self, node: Tensor, num_nodes: int) -> Tensor:
        """What the matches say of each component.

        Args:
            node: (P,) int64, component of each occupied finest pixel, M = none.
            num_nodes: M.

        Returns:
            (M, 2) float64, (y, x), finest pixels per sweep interval: the median of each axis over the component's
            matched pixels, of an even number the mean of the middle two; 0 without a match.

        Cost: four sorts of the matched pixels.
        """
        owner = node.index_select(0, self.pixel)
        medians = (segment_median(values, owner, num_nodes + 1)[:num_nodes] for values in self.motion.unbind(1))
        return torch.stack(tuple(medians), 1)


def match_key_points(cells: Cells, batch: Batch, block: int, config: Config) -> KeyPointMotion:
    """Match the key points of sweep t with those of t+1 (Sec. CorrelationFlow-Keypoints).

    Args:
        cells: finest images of all sweeps.
        batch: for the time from t to t+1.
        block: finest pixels a side of a pixel that can be a key point.
        config: `patch_size`, `ratio_threshold`, `gate_radius`, `max_speed`, `mutual_check`, `second_best_distance`,
            `max_memory`.

    Returns:
        The motion of every finest pixel in a matched key point.

    Convention: a coarse pixel is occupied where any slice of any of its finest pixels is.

    Cost: that of the key-point variant at that pixel size.
    """
    height, width = -(-cells.grid.height // block), -(-cells.grid.width // block)
    image, column = coarsen(cells, block, height, width)
    occupancy = image[:-1].bool().view(cells.num_windows, cells.num_steps, height, width)
    newest, at_t = occupancy[:, 0], occupancy[:, 1]
    _, pc1 = describe(newest, detect(newest), config.patch_size)
    _, pc0 = describe(at_t, detect(at_t), config.patch_size)
    matches = match(pc0, pc1, gate(batch, cells.grid.pixel_size * block, config), config)
    window, row, col = (values.index_select(0, matches.source) for values in (pc0.window, pc0.row, pc0.col))
    num_matches = matches.source.numel()
    match_at = torch.full((cells.num_windows * height * width,), num_matches, dtype=torch.int64, device=image.device)
    match_at[(window * height + row) * width + col] = torch.arange(num_matches, device=image.device)
    found = match_at.index_select(0, column)
    pixel = flat_nonzero((cells.step == 1) & (found < num_matches))
    return KeyPointMotion(pixel, matches.shift.index_select(0, found.index_select(0, pixel)).double() * block)
