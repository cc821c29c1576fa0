"""VerifiedFlow: motion candidates of components at several scales, verified at the finest pixels (docs/verified.md).

Components at several pixel sizes may be what moves together. Each has motion candidates: the peak of its correlation
with every sweep, their pool, the motion of the coarser component around it, what key points say. Candidates are tested
at the finest pixels, over all sweeps and both ways, against standing still. In the tree of components those win that
explain most; what moves is then placed between the pixels, registered and turned.
"""

from __future__ import annotations

import math
from typing import List, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.model import SceneFlowModel
from cflow_torch.stages import stage
from cflow_torch.verified import keypoint_candidates, slow_motion
from cflow_torch.verified.candidates import propose
from cflow_torch.verified.component_tree import Objects, find_components, select_objects
from cflow_torch.verified.confidence import confidence_of
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.offline import best_nearby, motion_by_both_sides
from cflow_torch.verified.paired_test import VerifiedLevel, verify
from cflow_torch.verified.rigid_motion import RigidMotion, TurningMotion
from cflow_torch.verified.rigid_registration import register
from cflow_torch.verified.subpixel_shift import shift_between_pixels
from cflow_torch.verified.voxel_centroids import points_of_objects
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch

# Metres around the region that are looked at as well, so that what crosses its border is seen whole: at least the way
# of 40 m/s in a sweep.
MARGIN = 4.0


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

    def grid(self, pixel_size: float) -> Grid:
        """The BEV at a pixel size, metres: the region and its margin of whole pixels of the coarsest size."""
        x0, y0, z0, x1, y1, z1 = self.config.point_cloud_range
        wide = math.ceil(MARGIN / self.config.pixel_sizes[0]) * self.config.pixel_sizes[0]
        return Grid(pixel_size, (x0 - wide, y0 - wide, z0), (x1 + wide, y1 + wide, z1))

    def motion(self, batch: Batch) -> TurningMotion:
        """Motion of everything in a batch, by occupied pixel; ids number what moves together or stands together."""
        if self.config.num_future == 0:
            return self.estimate(batch)
        return motion_by_both_sides(batch, self.estimate)

    def estimate(self, batch: Batch) -> TurningMotion:
        """The same by all sweeps alike, before t or after t+1."""
        config, key_points = self.config, None
        levels: List[VerifiedLevel] = []
        with stage("project"):
            sweeps = HeightSlicedSweeps.of(batch, self.grid(config.pixel_sizes[-1]), config.min_height)
        if config.thorough:
            with stage("match"):
                key_points = keypoint_candidates.match_key_points(sweeps, config)
        for block, is_undilated in self.scales():
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
        with stage("register"):
            rigid = self.register(objects, motion, levels, sweeps)
        with stage("confidence"):
            confidence = confidence_of(sweeps, objects, rigid)
            is_numbered = config.thorough or config.num_future > 0
            return _by_pixel(objects, rigid, levels[-1].score, confidence, sweeps, is_numbered)

    def scales(self) -> List[Tuple[int, bool]]:
        """Of each level, coarse to fine: finest pixels a side of its pixels; are its components undilated?"""
        sizes = self.config.pixel_sizes
        levels = [(round(size / sizes[-1]), False) for size in sizes]
        return [*levels, (1, True)] if self.config.thorough else levels

    def register(
        self, objects: Objects, motion: Tensor, levels: List[VerifiedLevel], sweeps: HeightSlicedSweeps
    ) -> RigidMotion:
        """Motion of G objects in metres, from (G, 2) float64 (y, x), finest pixels per sweep interval."""
        pixel_size, moves = sweeps.grid.pixel_size, motion.any(1)
        if not self.config.thorough:
            return RigidMotion.translation(motion.flip(1) * pixel_size)
        too_long = torch.cat([level.level.too_long for level in levels]).index_select(0, objects.component)
        slow = slow_motion.slow_motion(sweeps, objects, ~moves & ~too_long)
        points = points_of_objects(sweeps, objects, moves)
        is_pair = (sweeps.elapsed != 0).sum(1) == 1  # with history one of many sweeps would decide
        motion = shift_between_pixels(points.take(is_pair.index_select(0, points.window)), sweeps, motion)
        points = points.take(motion.any(1).index_select(0, points.owner))
        rigid = register(points, sweeps, motion.flip(1) * pixel_size)
        return RigidMotion(torch.where(slow.any(1, keepdim=True), slow, rigid.flow), rigid.turn, rigid.centre)


def _select(levels: List[VerifiedLevel]) -> Tuple[Objects, Tensor]:
    """The objects among all components, and their motion as in `VerifiedLevel`."""
    objects = select_objects([level.level for level in levels], [level.evidence for level in levels])
    return objects, torch.cat([level.motion for level in levels]).index_select(0, objects.component)


def _by_pixel(
    objects: Objects,
    rigid: RigidMotion,
    score: Tensor,
    confidence: Tensor,
    sweeps: HeightSlicedSweeps,
    is_numbered: bool,
) -> TurningMotion:
    """The motion of G objects, (P,) scores, (P + 1,) confidence by pixel: clusters are pixels, and M is P.

    Args:
        is_numbered: whether `sweeps.number` was made; else the pixels of t are numbered, which costs less.
    """
    window = sweeps.window.index_select(0, objects.first)
    ids = torch.arange(window.numel(), device=window.device) - torch.searchsorted(window, window)
    of_pixel = F.pad(objects.of_pixel, (0, 1), value=objects.count)
    return TurningMotion(
        of_place=sweeps.number if is_numbered else sweeps.number_at_t(),
        place=torch.where(sweeps.batch.has_result, sweeps.place, sweeps.image.numel() - 1),
        flow=F.pad(rigid.flow, (0, 1, 0, 1)).index_select(0, of_pixel) + 0.0,  # + 0.0 turns -0.0 into 0.0
        cluster_id=F.pad(ids, (0, 1), value=-1).index_select(0, of_pixel),
        score=F.pad(score.masked_fill(objects.of_pixel == objects.count, 0.0), (0, 1)),
        confidence=confidence,
        turn=F.pad(rigid.turn, (0, 1)).index_select(0, of_pixel),
        centre=F.pad(rigid.centre, (0, 0, 0, 1)).index_select(0, of_pixel),
    )
