"""VerifiedFlow: motion candidates of components at several scales, verified at the finest pixels (docs/verified.md).

Components at several pixel sizes may be what moves together. Each has motion candidates: the peak of its correlation
with every sweep, their pool, the motion of the coarser component around it, what key points say. Candidates are tested
at the finest pixels, over all sweeps and both ways, against standing still. In the tree of components those win that
explain most; what moves is then placed between the pixels, registered and turned.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import List, Tuple

import torch
from torch import Tensor

from cflow_torch.model import SceneFlowModel
from cflow_torch.stages import stage
from cflow_torch.verified import keypoint_candidates, slow_motion
from cflow_torch.verified.candidates import propose
from cflow_torch.verified.component_tree import Objects, find_components, select_objects
from cflow_torch.verified.confidence import confidence_of
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.layers import join_moving, points_at_rest, points_of_lower_layers
from cflow_torch.verified.local_motion import find_local_motion
from cflow_torch.verified.margin import margin_of
from cflow_torch.verified.offline import best_nearby, motion_by_both_sides
from cflow_torch.verified.paired_test import VerifiedLevel, verify
from cflow_torch.verified.refinement import as_found, refine
from cflow_torch.verified.relinking import relink
from cflow_torch.verified.rigid_motion import TurningMotion, motion_by_pixel
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch

# Metres around the region that are looked at as well, so that what crosses its border is seen whole: at least the way
# of 40 m/s in a sweep.
_AROUND = 4.0


class VerifiedFlow(SceneFlowModel):
    """What the presets `default`, `fast` and `offline` run: windows in, flow out. No parameters, no buffers, no state.

    Args:
        config: a `VerifiedConfig`; `VerifiedFlow.from_preset` makes it from a preset.

    Example:
        >>> from cflow_torch import Sweep, VerifiedFlow, Window
        >>> model = VerifiedFlow.from_preset("fast")
        >>> car = 0.1 * torch.cartesian_prod(torch.arange(45.0), torch.arange(18.0), torch.arange(15.0)) + 5.05
        >>> window = Window(pc0=Sweep(car), pc1=Sweep(car + torch.tensor([0.5, 0.0, 0.0])))
        >>> (result,) = model([window])
        >>> result.residual_flow[0]
        tensor([0.5000, 0.0000, 0.0000])
    """

    method = "verified"
    num_axes = 3

    @property
    def needs_ground(self) -> bool:  # type: ignore[override]
        """Whether the heights of ground points are asked for."""
        return self.config.min_height is not None

    @property
    def bytes_per_point(self) -> int:  # type: ignore[override]
        """Working memory, if every point has a pixel of its own; its largest part is that of the cubes of slow motion
        or of the descriptors of key points, one after the other."""
        most = max(keypoint_candidates.BYTES_PER_POINT, slow_motion.BYTES_PER_POINT) if self.config.thorough else 0
        return int(super().bytes_per_point) + 170 + most

    @property
    def needs_times(self) -> bool:  # type: ignore[override]
        """Whether the times of points are asked for."""
        return bool(self.config.thorough)

    def grid(self, pixel_size: float) -> Grid:
        """The BEV at a pixel size, metres: the region and whole pixels of the coarsest size around it."""
        x0, y0, z0, x1, y1, z1 = self.config.point_cloud_range
        wide = math.ceil(_AROUND / self.config.pixel_sizes[0]) * self.config.pixel_sizes[0]
        return Grid(pixel_size, (x0 - wide, y0 - wide, z0), (x1 + wide, y1 + wide, z1))

    def motion(self, batch: Batch) -> TurningMotion:
        """Motion of everything in a batch, by occupied pixel; ids number what moves together or stands together."""
        if self.config.num_future == 0:
            return self.estimate(batch)
        return motion_by_both_sides(batch, self.estimate)

    def estimate(self, batch: Batch) -> TurningMotion:
        """The same by all sweeps alike, before t or after t+1."""
        grid = self.grid(self.config.pixel_sizes[-1])
        with stage("project"):
            sweeps = HeightSlicedSweeps.of(batch, grid, self.config.min_height)
        found = self.look(sweeps, self.scales())
        if not self.config.thorough:
            return found
        with stage("layers"):
            is_lower = points_of_lower_layers(sweeps, points_at_rest(sweeps, found))
            lower = HeightSlicedSweeps.of(replace(batch, takes_part=is_lower), grid)
        return join_moving(found, self.look(lower, [(1, False)], is_first=False), batch)

    def look(self, sweeps: HeightSlicedSweeps, scales: List[Tuple[int, bool]], is_first: bool = True) -> TurningMotion:
        """What some points do, found at some scales. What could as well be displaced stands still."""
        config, key_points = self.config, None
        levels: List[VerifiedLevel] = []
        if config.thorough and is_first:
            with stage("match"):
                key_points = keypoint_candidates.match_key_points(sweeps, config)
        for block, is_undilated in scales:
            above = levels[-1] if levels else None
            with stage("cluster"):
                level = find_components(sweeps, block, is_undilated, config)
            with stage("correlate"):
                candidates = propose(level, sweeps, above, key_points, config)
            with stage("verify"):
                levels.append(verify(level, candidates.motion, candidates.score, sweeps, config))
        with stage("select"):
            objects, motion = _select(levels)
            if config.num_future > 0:
                motion = best_nearby(sweeps, objects, motion, config)
        doubt = torch.zeros_like(sweeps.row, dtype=torch.float64)
        if config.thorough and is_first:
            with stage("local"):
                objects, motion, doubt = find_local_motion(objects, motion, levels, sweeps)
            with stage("relink"):
                objects, motion = relink(objects, motion, sweeps, config)
        with stage("register"):
            rigid, seen = refine(objects, motion, levels, sweeps) if config.thorough else as_found(motion, sweeps)
        with stage("confidence"):
            margin = margin_of(sweeps, objects, seen)
            confidence = confidence_of(sweeps, objects, seen, margin.z, doubt)
            rigid = rigid.only(margin.moves) if config.thorough else rigid
            return motion_by_pixel(objects, rigid, levels[-1].score, confidence, sweeps)

    def scales(self) -> List[Tuple[int, bool]]:
        """Of each level, coarse to fine: finest pixels a side of its pixels; are its components undilated?"""
        sizes = self.config.pixel_sizes
        levels = [(round(size / sizes[-1]), False) for size in sizes]
        return [*levels, (1, True)] if self.config.thorough else levels


def _select(levels: List[VerifiedLevel]) -> Tuple[Objects, Tensor]:
    """The objects among all components, and their motion as in `VerifiedLevel`."""
    objects = select_objects([level.level for level in levels], [level.evidence for level in levels])
    return objects, torch.cat([level.motion for level in levels]).index_select(0, objects.component)
