"""Motion by hypotheses and proof, in one pass at the finest pixels (docs/beyond.md): the page to read first.

Components at several pixel sizes are hypotheses of what moves together. Each has candidate motions: the peak of its
correlation with every sweep, their pool, the motion of the coarser component around it, what key points say.
Candidates are judged at the finest pixels, over all sweeps and both ways, against no motion. In the tree of components
the grouping that explains most wins; what moves is then placed between the pixels, refined and turned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import List, Optional, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.profiler import record_function

from cflow_torch.config import Config
from cflow_torch.model import Motion
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.verified.aperture import slides_along_itself
from cflow_torch.verified.candidates import inherit, make_candidates
from cflow_torch.verified.component_tree import Groups, choose_groups
from cflow_torch.verified.confidence import confidence
from cflow_torch.verified.height_slices import Cells, make_cells
from cflow_torch.verified.keypoint_motion import KeyPointMotion, match_key_points
from cflow_torch.verified.levels import Level, equals_parent, make_level, parents
from cflow_torch.verified.moving import moving_points
from cflow_torch.verified.nudge import nudge
from cflow_torch.verified.paired_test import choose, judge, worth
from cflow_torch.verified.peaks import find_peaks
from cflow_torch.verified.rigid import RigidMotion
from cflow_torch.verified.rigid_registration import refine
from cflow_torch.verified.slow import slow_motion
from cflow_torch.verified.subpixel_shift import relocate
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch


def prove_motion(batch: Batch, grid: Grid, config: Config) -> Motion:
    """Motion of everything in a batch.

    Args:
        batch: points of all windows, with three axes.
        grid: the finest BEV.
        config: all but `subpixel` and `zero_test`; `max_object` and `max_speed` count, settings of key points where
            `keypoint_block` is given.

    Returns:
        The motion, by occupied pixel; ids number the groups that move together or stand still together.
    """
    with record_function("project"):
        cells, place = make_cells(batch, grid, config.slice_height, config.clearance)
    key_points = None
    if config.keypoint_block > 0:
        with record_function("match"):
            key_points = match_key_points(cells, batch, config.keypoint_block, config)
    judged: List[_Judged] = []
    for block, reach in _levels(config):
        judged.append(_judge_level(cells, block, reach, judged[-1] if judged else None, key_points, batch, config))
    with record_function("tree"):
        groups = choose_groups([one.level.node for one in judged], [one.worth for one in judged])
        motion = torch.cat([one.motion for one in judged]).index_select(0, groups.component)
    with record_function("refine"):
        needs_all = config.relocate or config.nudge or config.yaw or config.slow
        number = cells.number() if needs_all else cells.number_at_t()
        rigid = _settle(motion, groups, cells, place, number, batch, config)
    if config.slow:
        with record_function("slow"):
            too_long = torch.cat([one.level.too_long for one in judged]).index_select(0, groups.component)
            rigid = _creep(rigid, ~motion.any(1) & ~too_long, groups, cells, place, number, batch)
    with record_function("confidence"):
        trust = confidence(cells, groups, rigid, batch.elapsed)
    return _by_pixel(rigid, groups, judged[-1].score, trust, cells, place, number)


def _levels(config: Config) -> List[Tuple[int, int]]:
    """Of each level, coarse to fine: finest pixels a side of its pixels, and the reach of its components."""
    levels = [(round(size / config.pixel_sizes[-1]), 3) for size in config.pixel_sizes]
    return [*levels, (1, 1)] if config.children else levels


@dataclass(frozen=True)
class _Judged:
    """A level and the best motion of each of its M components.

    Args:
        level: the components.
        motion: (M, 2) float64, (y, x), finest pixels per sweep interval; 0 = none is proved.
        worth: (M,) int64.
        score: (P,) float32 of each finest pixel: NCC of the finest component so far that was looked for.
    """

    level: Level
    motion: Tensor
    worth: Tensor
    score: Tensor


def _judge_level(
    cells: Cells,
    block: int,
    reach: int,
    above: Optional[_Judged],
    key_points: Optional[KeyPointMotion],
    batch: Batch,
    config: Config,
) -> _Judged:
    """Candidates of the components at one pixel size, and which of them is proved best."""
    with record_function("cluster"):
        level = make_level(cells, block, reach, math.inf if config.max_object is None else config.max_object, config)
        node, num_nodes = level.node, level.clusters.window.numel()
        wanted, others = ~level.too_long, []
        if above is not None:
            others.append(inherit(node, num_nodes, above.level.node, above.motion))
            if reach == 1:  # what has not fallen apart is known
                held_by = (above.level.node, len(above.motion))
                wanted &= ~equals_parent(node, num_nodes, *held_by, parents(node, num_nodes, *held_by))
        if key_points is not None:
            others.append(key_points.of_components(node, num_nodes))
    with record_function("correlate"):
        estimates, scores, available = find_peaks(level, wanted, batch, cells.grid.pixel_size, config)
    with record_function("judge"):
        intervals = batch.elapsed[level.clusters.window, 1:]
        candidates = make_candidates(estimates, available, intervals, others)
        is_judged = (candidates != 0).any(2).any(1) & ~level.too_long
        worths = worth(*judge(cells, node, candidates, is_judged, batch.elapsed), config.proof_z)
        if config.aperture:
            owner = torch.where(F.pad(is_judged, (0, 1)).index_select(0, node), node, num_nodes)
            worths = worths.masked_fill(slides_along_itself(cells, batch.elapsed, owner, candidates), 0)
        motion, best = choose(worths, candidates)
    newest = available.int().argmax(1, keepdim=True)
    score = F.pad(scores.gather(1, newest)[:, 0], (0, 1)).index_select(0, node)
    if above is not None:
        score = torch.where(F.pad(wanted, (0, 1)).index_select(0, node), score, above.score)
    return _Judged(level, motion, best, score)


def _settle(
    motion: Tensor, groups: Groups, cells: Cells, place: Tensor, number: Tensor, batch: Batch, config: Config
) -> RigidMotion:
    """Motion of G groups, metres, from (G, 2) float64 (y, x), finest pixels per sweep interval.

    Args:
        place: of every point.
        number: of the pixel at every place, `Cells.number` if anything is to be done.
    """
    grid, num_groups = cells.grid, len(motion)
    still = torch.zeros_like(motion)
    moves = F.pad(motion.any(1), (0, 1))
    if (config.relocate or config.nudge or config.yaw) and bool(moves.any()):
        num_pixels = cells.pixel.numel()
        of_pixel = torch.where(moves.index_select(0, groups.of_pixel), groups.of_pixel, num_groups)
        points = moving_points(batch, place, number, of_pixel, num_groups, config.slice_height)
        is_pair = (batch.elapsed > 0).sum(1) == 1  # with history one of many sweeps would decide
        pairs = points.take(flat_nonzero(is_pair.index_select(0, points.window)))
        if config.relocate:
            motion = relocate(pairs, grid, batch.num_windows, motion)
            pairs, points = (of.take(flat_nonzero(motion.any(1).index_select(0, of.group))) for of in (pairs, points))
        if config.nudge:
            motion = nudge(pairs, number, num_pixels, grid, batch.elapsed, motion)
        if config.yaw:
            flow = motion.flip(1) * grid.pixel_size + 0.0
            return refine(points, number, num_pixels, grid, batch.elapsed, flow)
    return RigidMotion(motion.flip(1) * grid.pixel_size, still[:, 0], still)


def _creep(
    rigid: RigidMotion, asked: Tensor, groups: Groups, cells: Cells, place: Tensor, number: Tensor, batch: Batch
) -> RigidMotion:
    """The motion with that of slow groups, which do not turn, among those asked, (G,) bool."""
    window = cells.window.index_select(0, groups.first)
    is_pair = (batch.elapsed > 0).sum(1) == 1  # with history slow groups leave their pixels
    asked = asked & is_pair.index_select(0, window)
    if not bool(asked.any()):
        return rigid
    elapsed = batch.elapsed[:, 1].index_select(0, window)
    slow = slow_motion(batch, place, cells, number, groups.of_pixel, asked, elapsed)
    return RigidMotion(torch.where(slow.any(1, keepdim=True), slow, rigid.flow), rigid.turn, rigid.centre)


def _by_pixel(
    rigid: RigidMotion, groups: Groups, score: Tensor, trust: Tensor, cells: Cells, place: Tensor, number: Tensor
) -> Motion:
    """The motion of G groups, (P,) scores, (P + 1,) trust, as `Motion` wants them: by pixel; its cluster M is P."""
    window = cells.window.index_select(0, groups.first)
    ids = torch.arange(window.numel(), device=window.device) - torch.searchsorted(window, window)
    group = F.pad(groups.of_pixel, (0, 1), value=window.numel())
    flow = F.pad(rigid.flow, (0, 1, 0, 1)).index_select(0, group) + 0.0  # + 0.0 turns -0.0 into 0.0
    turn, centre = F.pad(rigid.turn, (0, 1)), F.pad(rigid.centre, (0, 0, 0, 1))
    return Motion(
        of_place=number,
        place=place,
        flow=flow,
        cluster_id=F.pad(ids, (0, 1), value=-1).index_select(0, group),
        score=F.pad(score.masked_fill(groups.of_pixel == window.numel(), 0.0), (0, 1)),
        rigid=RigidMotion(flow[:, :2], turn.index_select(0, group), centre.index_select(0, group)),
        confidence=trust,
    )
