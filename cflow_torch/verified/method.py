"""VerifiedFlow: draw, find changed pixels, build a tree, propose, verify, select, refine (docs/verified.md).

Connected components at several pixel sizes are hypotheses for rigid objects. Each one gets motion candidates: its
correlation peak with every sweep, the median of these peaks, and the medians of the coarser components around it. The
paired test compares the candidates with "static" at the finest pixels of all sweeps, and selects the best one. In the
tree of components, a component wins if its motion has more evidence than its children together. Refinement corrects
the winning motions to centimetres.
"""

from __future__ import annotations

import math

from cflow_torch.model import SceneFlowModel
from cflow_torch.ops.indices import lookup
from cflow_torch.stages import stage
from cflow_torch.verified import subpixel_motion
from cflow_torch.verified.candidates import propose
from cflow_torch.verified.changed_pixels import find_changed
from cflow_torch.verified.component_tree import find_components, movable_nodes, select_objects
from cflow_torch.verified.confidence import confidence_of, motion_margin
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.offline import best_nearby, choose_side
from cflow_torch.verified.overhangs import add_overhung
from cflow_torch.verified.paired_test import add_unchanged, verify
from cflow_torch.verified.refinement import refine
from cflow_torch.verified.rigid_motion import RotatingMotion, motion_by_pixel
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch

# We also process a margin of this many metres around the region, so that objects at its border are complete. An object
# at 40 m/s covers 4 m in a sweep.
_MARGIN = 4.0


class VerifiedFlow(SceneFlowModel):
    """Estimate flow by verified motion candidates: the presets `default` and `offline`. It has no weights.

    Args:
        config: a `VerifiedConfig`; `VerifiedFlow.from_preset` makes it from a preset.

    Examples:
        >>> import torch
        >>> from cflow_torch import Sweep, VerifiedFlow, Window
        >>> model = VerifiedFlow.from_preset("default")
        >>> car = 0.1 * torch.cartesian_prod(torch.arange(45.0), torch.arange(18.0), torch.arange(15.0)) + 5.05
        >>> window = Window(pc0=Sweep(car), pc1=Sweep(car + torch.tensor([0.5, 0.0, 0.0])))
        >>> (result,) = model([window])
        >>> result.residual_flow[0]
        tensor([0.5000, 0.0000, 0.0000])
    """

    method = "verified"
    num_axes = 3
    needs_ground = True
    needs_times = True

    @property
    def bytes_per_point(self) -> int:  # type: ignore[override]
        """Bytes of working memory per point if every point has its own pixel. Sub-pixel motion needs most of them."""
        return int(super().bytes_per_point) + 170 + subpixel_motion.BYTES_PER_POINT

    def grid(self, pixel_size: float) -> Grid:
        """Return the BEV grid of a pixel size in metres: the region and a margin of whole coarsest pixels around it."""
        x0, y0, z0, x1, y1, z1 = self.config.point_cloud_range
        margin = math.ceil(_MARGIN / self.config.pixel_sizes[0]) * self.config.pixel_sizes[0]
        return Grid(pixel_size, (x0 - margin, y0 - margin, z0), (x1 + margin, y1 + margin, z1))

    def motion(self, batch: Batch) -> RotatingMotion:
        """Return the motion of all points of a batch. Each occupied pixel is a cluster with the id of its object."""
        config = self.config
        blocks = [round(size / config.pixel_sizes[-1]) for size in config.pixel_sizes]
        with stage("draw"):
            sweeps = HeightSlicedSweeps.of(batch, self.grid(config.pixel_sizes[-1]), config.min_height)
        with stage("change"):
            change = find_changed(sweeps)
        with stage("tree"):
            components = find_components(sweeps, change, blocks)
            nodes = movable_nodes(sweeps, components, config.max_object_length)
            sweeps, nodes = add_overhung(sweeps, components, nodes)
        with stage("propose"):
            candidates = propose(nodes, components, sweeps, config)
        with stage("verify"):
            motion, evidence = verify(sweeps, nodes, candidates.motion, components.num_levels, config.significance)
            nodes = add_unchanged(sweeps, nodes, motion, components.num_levels)
        with stage("select"):
            objects, node = select_objects(nodes, components, evidence, sweeps.num_pixels)
            motion = lookup(motion, node)
            if config.num_future > 0:
                motion = best_nearby(sweeps, objects, motion, config.significance)
        with stage("refine"):
            rigid, apparent = refine(sweeps, components, objects, motion, config.max_object_length)
            margin = motion_margin(sweeps, objects, apparent)
        with stage("confidence"):
            confidence = confidence_of(sweeps, objects, apparent, margin.z)
        score, is_changed = lookup(candidates.score, node), lookup(nodes.level == components.num_levels, node)
        result = motion_by_pixel(sweeps, objects, rigid.only(margin.is_dynamic), score, confidence, is_changed)
        return choose_side(batch, result) if config.num_future > 0 else result
