"""Motion by hypotheses and proof (docs/beyond.md): components at several pixel sizes, candidates, proof, refinement.

Order of reading: prove_motion -> judge_level -> find_peak; then settle.
"""

from __future__ import annotations

import math
from typing import Dict, List, NamedTuple, Optional, Sequence, Set, Tuple

import numpy as np

from cflow_torch.config import Config
from oracle.aperture import slides_along_itself
from oracle.candidates import Vector, candidates, inherit
from oracle.cells import slice_image
from oracle.confidence import confidences
from oracle.dense import scene_flow_in_1view
from oracle.judge import choose, paired_counts, worth
from oracle.keypoint_motion import keypoint_motion, keypoint_shifts
from oracle.levels import components_at, equals_parent
from oracle.low_columns import ground_heights, in_low_column
from oracle.nudge import nudge
from oracle.peak import parabola
from oracle.pixels import bounding_box, in_range, project_bev, search_radius
from oracle.refinement import Rigid, points_of_groups, refine, rotate
from oracle.relocation import relocate
from oracle.slow import creep
from oracle.sweeps import Cloud, Level
from oracle.tree import winners


class Judged(NamedTuple):
    """Components at one pixel size and the best motion of each.

    Attributes:
        node: per sweep (H, W) int64, component of each occupied finest pixel, -1 = none.
        motions: of each component (y, x), finest pixels per sweep interval.
        worths: of each component.
        scores: per sweep (H, W) float64, NCC of the finest component so far that was looked for.
        too_long: of each component, whether it is longer than `max_object`.
    """

    node: List[np.ndarray]
    motions: List[Vector]
    worths: List[int]
    scores: List[np.ndarray]
    too_long: List[bool]


def prove_motion(clouds: Sequence[Cloud], cloud1: Cloud, ground: Sequence[np.ndarray], config: Config) -> Level:
    """The motion of every point of sweep t.

    Args:
        clouds: sweeps m = t, t-1, ... nearest first.
        cloud1: sweep t+1.
        ground: (N, 3) float64, metres, frame of t+1, ground points of t and t+1 where they are known.
        config: settings.

    Returns:
        Flow, number of the group, score and confidence, of sweep t only.
    """
    sweeps, size = [cloud1, *clouds], config.pixel_sizes[-1]
    inside = [cloud.takes_part & in_range(cloud.points, config) for cloud in sweeps]
    if config.clearance is not None:
        means = ground_heights(ground, config)
        for cloud, keep in zip(sweeps, inside):
            keep[keep] = ~in_low_column(cloud.points[keep], means, config.clearance, size, config)
    images = [slice_image(cloud.points[keep], config, size, config.slice_height) for cloud, keep in zip(sweeps, inside)]

    shifts = None
    if config.keypoint_block > 0:
        shifts = keypoint_shifts(images, clouds[0], config.keypoint_block, config)
    judged: List[Judged] = []
    levels = [(round(s / size), 3) for s in config.pixel_sizes] + ([(1, 1)] if config.children else [])
    for block, reach in levels:
        judged.append(judge_level(images, clouds, block, reach, judged[-1] if judged else None, shifts, config))

    # Groups, numbered by their first pixel: sweep by sweep, t+1 first, in raster order.
    pixels = [(m, r, c) for m, image in enumerate(images) for r, c in np.argwhere(image).tolist()]
    won = winners([[int(level.node[m][r, c]) for m, r, c in pixels] for level in judged], [j.worths for j in judged])
    number: Dict[Tuple[int, int], int] = {}
    for winner in won:
        if winner is not None:
            number.setdefault(winner, len(number))
    group_of = {pixel: number[winner] for pixel, winner in zip(pixels, won) if winner is not None}
    motions = [judged[level].motions[component] for level, component in number]
    rigid = settle(motions, group_of, sweeps, inside, config)
    if config.slow and len(sweeps) == 2:  # with history slow groups leave their pixels
        asked = [not any(v) and not judged[level].too_long[i] for v, (level, i) in zip(motions, number)]
        for group, slow in enumerate(creep(asked, group_of, images, sweeps, inside, config)):
            if slow is not None:
                rigid[group] = rigid[group]._replace(flow=slow)

    elapsed = [cloud.steps for cloud in sweeps]
    x0, y0 = config.point_cloud_range[:2]
    trust, of_left_out = confidences(images, group_of, [group.flow for group in rigid], elapsed, (x0, y0), size)

    num_points = len(clouds[0].points)
    confidence = np.full(num_points, of_left_out)
    flow, ids, scores = np.zeros((num_points, 3)), np.full(num_points, -1, dtype=np.int64), np.zeros(num_points)
    rows = np.flatnonzero(inside[1])
    for i, (r, c) in zip(rows.tolist(), project_bev(clouds[0].points[rows], config, size).tolist()):
        confidence[i] = trust[r, c]
        if (1, r, c) in group_of:
            ids[i], scores[i] = group_of[1, r, c], judged[-1].scores[1][r, c]
            (v_x, v_y), turn, (c_x, c_y) = rigid[ids[i]]
            x, y = clouds[0].points[i, 0] - c_x, clouds[0].points[i, 1] - c_y
            turned_x, turned_y = rotate(turn, x, y)
            flow[i, :2] = (turned_x - x) + v_x, (turned_y - y) + v_y
    return Level([flow], [ids], [scores], [confidence])


def judge_level(
    images: Sequence[np.ndarray],
    clouds: Sequence[Cloud],
    block: int,
    reach: int,
    above: Optional[Judged],
    shifts: Optional[np.ndarray],
    config: Config,
) -> Judged:
    """The best motion of every component at one pixel size.

    Args:
        images: (H, W) uint8 of sweep t+1, then of t, t-1, ..., at the finest pixels; bits are slices.
        clouds: sweeps t, t-1, ...
        block: finest pixels a side of a pixel of this size.
        reach: 3 = Alg. clustering, 1 = plain components, which are not looked for if they are all of their parent.
        above: the next coarser level.
        shifts: of key points (`keypoint_shifts`); None = they are not asked.
        config: settings.
    """
    size = config.pixel_sizes[-1]
    longest = math.inf if config.max_object is None else config.max_object
    coarse, node, too_long = components_at(images, block, reach, size, longest, config)
    wanted = [not is_long for is_long in too_long]
    if above is not None and reach == 1:
        occupied = [image > 0 for image in images]
        flat = [[int(i) for n, o in zip(nodes, occupied) for i in n[o]] for nodes in (node, above.node)]
        wanted = [one and not same for one, same in zip(wanted, equals_parent(*flat))]
    elapsed = [0.0, *(cloud.steps for cloud in clouds)]
    scores = [np.zeros(image.shape) for image in images] if above is None else [s.copy() for s in above.scores]
    motions: List[Vector] = []
    worths: List[int] = []
    for i, is_wanted in enumerate(wanted):
        members = [nodes == i for nodes in node]
        estimates: List[Optional[Vector]] = [None] * len(clouds)
        if is_wanted:
            peaks = [find_peak(coarse, members, m, clouds[m - 1], block, config) for m in range(1, len(images))]
            estimates = [None if peak is None else peak[0] for peak in peaks]
            score = [peak[1] for peak in peaks if peak is not None][0]
            for image, member in zip(scores, members):
                image[member] = score
        others = [] if above is None else [inherit(members, above.node, above.motions)]
        if shifts is not None:
            others.append(keypoint_motion(members[1], shifts))
        found = candidates(estimates, elapsed[1:], others)
        values = [0] * len(found)
        if not too_long[i]:
            values = [worth(*paired_counts(images, members, motion, elapsed), config.proof_z) for motion in found]
        if config.aperture:
            component = {m: _pixels(member) for m, member in enumerate(members)}
            everything = {m: _pixels(image > 0) for m, image in enumerate(images)}
            slides = slides_along_itself(component, everything, max(elapsed), np.array(found), size)
            values = [0 if slid else value for slid, value in zip(slides, values)]
        motion, best = choose(values, found)
        motions.append(motion)
        worths.append(best)
    return Judged(node, motions, worths, scores, list(too_long))


def find_peak(
    coarse: Sequence[np.ndarray], members: Sequence[np.ndarray], m: int, cloud: Cloud, block: int, config: Config
) -> Optional[Tuple[Vector, float]]:
    """Displacement of a component from sweep m to t+1, finest pixels, and its NCC score; None without a pixel at m.

    Args:
        coarse: per sweep (H', W') uint8, images at the size of the component.
        members: per sweep (H, W) bool, its finest pixels.
        m: which sweep, from 1.
        cloud: that sweep.
        block: finest pixels a side of a pixel of this size.
        config: settings.

    Convention: the parabola counts slices, of whatever component at t+1.
    """
    if not members[m].any():
        return None
    own: List[np.ndarray] = [np.zeros_like(image) for image in coarse]
    for member, image, drawn in zip(members, coarse, own):
        for r, c in np.argwhere(member).tolist():
            drawn[r // block, c // block] = image[r // block, c // block]
    row, col, height, width = bounding_box([np.argwhere(image) for image in own])
    template, target = (_slices(image[row : row + height, col : col + width]) for image in (own[m], own[0]))
    if config.height_slices == 0:
        template, target = (np.asarray(image.any(0)) for image in (template, target))
    radius = search_radius(config, cloud.elapsed, config.pixel_sizes[-1] * block)
    (dx, dy), score = scene_flow_in_1view(template, target, 1.0, radius)
    if dx == 0 and dy == 0:
        return (0.0, 0.0), score
    more_y, more_x = parabola(_slices(own[m]), _slices(coarse[0]), int(dy), int(dx))
    return ((dy + more_y) * block, (dx + more_x) * block), score


def settle(
    motions: Sequence[Vector],
    group_of: Dict[Tuple[int, int, int], int],
    sweeps: Sequence[Cloud],
    inside: Sequence[np.ndarray],
    config: Config,
) -> List[Rigid]:
    """Where groups have gone in metres, between the pixels.

    Args:
        motions: of each group (y, x), finest pixels per sweep interval.
        group_of: (sweep, row, col) -> group.
        sweeps: t+1, t, t-1, ...
        inside: of each sweep, the points that count.
        config: settings. Only pairs of sweeps are relocated and nudged: with history one of many sweeps would decide.
    """
    size, (x0, y0) = config.pixel_sizes[-1], config.point_cloud_range[:2]
    moves = [any(motion) for motion in motions]
    points = points_of_groups(moves, group_of, sweeps, inside, (config.slice_height, 4), config)
    if config.relocate and len(sweeps) == 2:
        motions = relocate(points, motions, (x0, y0), size)
        points = [point for point in points if any(motions[point.group])]
    if config.nudge and len(sweeps) == 2:
        motions = nudge(points, motions, sweeps[1].steps, (x0, y0), size)
    flows = [(x * size + 0.0, y * size + 0.0) for y, x in motions]
    if config.yaw:
        return refine(points, flows, [[cloud.steps for cloud in sweeps]], (x0, y0), size)
    return [Rigid(flow, 0.0, (0.0, 0.0)) for flow in flows]


def _slices(image: np.ndarray) -> np.ndarray:
    """(4, H, W) bool of an image of bits."""
    return np.stack([(image >> bit) & 1 > 0 for bit in range(4)])


def _pixels(mask: np.ndarray) -> Set[Tuple[int, int]]:
    return {(r, c) for r, c in np.argwhere(mask).tolist()}
