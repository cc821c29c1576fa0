"""The verified method: components at several pixel sizes, motion candidates, the paired test, registration.

Order of reading: verified_flow -> verify_level -> `candidates`, `paired_test`; then settle.
"""

from __future__ import annotations

import math
from typing import Dict, List, NamedTuple, Optional, Sequence

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.aperture import slides_along_itself
from oracle.candidates import find_peak, keypoint_motion, keypoint_shifts, list_motions
from oracle.component_tree import Level, equals_parent, find_components, parents, winners
from oracle.confidence import confidences
from oracle.ground_residue import ground_heights, is_residue
from oracle.height_slices import Pixel, SlicedSweeps, Vector, slice_image
from oracle.paired_test import best_candidate, count_wins, evidence_of
from oracle.pixels import in_range, project_bev
from oracle.rigid_registration import RigidMotion, register
from oracle.slow_motion import NUM_LAYERS, leans, slow_motion
from oracle.subpixel_shift import shift_between_pixels
from oracle.sweeps import Cloud, PointMotion
from oracle.voxel_centroids import points_of_objects


class VerifiedLevel(NamedTuple):
    """Components at one pixel size and the best motion of each.

    Attributes:
        level: the components.
        motions: of each component (y, x), finest pixels per sweep interval.
        evidence: of each component.
        scores: of each occupied pixel, NCC of the finest component so far that was looked for.
    """

    level: Level
    motions: List[Vector]
    evidence: List[int]
    scores: List[float]


def verified_flow(
    clouds: Sequence[Cloud], cloud1: Cloud, ground: Sequence[np.ndarray], config: VerifiedConfig
) -> PointMotion:
    """The motion of every point of sweep t.

    Args:
        clouds: sweeps m = t, t-1, ... nearest first.
        cloud1: sweep t+1.
        ground: (N, 3) float64, metres, frame of t+1, ground points of t and t+1 where they are known.

    """
    is_inside = in_range(clouds[0].points, config)
    config, size = with_margin(config), config.pixel_sizes[-1]
    drawn = [cloud.takes_part & in_range(cloud.points, config) for cloud in (cloud1, *clouds)]
    if config.min_height is not None:
        means = ground_heights(ground, config)
        for cloud, keep in zip((cloud1, *clouds), drawn):
            keep[keep] = ~is_residue(cloud.points[keep], means, config.min_height, config)
    points = [cloud.points[keep] for cloud, keep in zip((cloud1, *clouds), drawn)]
    sweeps = SlicedSweeps(
        [slice_image(of_sweep, config) for of_sweep in points],
        [cloud.intervals for cloud in (cloud1, *clouds)],
        [cloud.seconds for cloud in (cloud1, *clouds)],
        size,
        config.point_cloud_range[:2],  # type: ignore[arg-type]
    )
    shifts = keypoint_shifts(sweeps, config) if config.thorough else None
    levels: List[VerifiedLevel] = []
    scales = [(round(s / size), False) for s in config.pixel_sizes] + [(1, True)] * config.thorough
    for block, is_undilated in scales:
        level = find_components(sweeps, block, is_undilated, config)
        levels.append(verify_level(sweeps, level, is_undilated, levels[-1] if levels else None, shifts, config))

    # Objects, numbered by their first pixel: sweep by sweep, t+1 first, in raster order.
    won = winners([verified.level.component for verified in levels], [verified.evidence for verified in levels])
    chosen = list(dict.fromkeys(winner for winner in won if winner is not None))
    object_of = {pixel: chosen.index(winner) for pixel, winner in zip(sweeps.pixels(), won) if winner is not None}
    motions = [levels[level].motions[component] for level, component in chosen]
    may_creep = [not levels[level].level.too_long[component] for level, component in chosen]
    rigid = settle(sweeps, motions, may_creep, object_of, points, config)
    trust, of_left_out = confidences(sweeps, object_of, [motion.flow for motion in rigid])

    num_points, score_of = len(clouds[0].points), dict(zip(sweeps.pixels(), levels[-1].scores))
    flow, ids, scores = np.zeros((num_points, 3)), np.full(num_points, -1, dtype=np.int64), np.zeros(num_points)
    confidence = np.full(num_points, of_left_out)
    rows = np.flatnonzero(drawn[1] & is_inside)
    for i, (r, c) in zip(rows.tolist(), project_bev(clouds[0].points[rows], config, size).tolist()):
        confidence[i] = trust[1, r, c]
        if (1, r, c) in object_of:
            ids[i], scores[i] = object_of[1, r, c], score_of[1, r, c]
            flow[i, :2] = rigid[ids[i]].flow_at(*clouds[0].points[i, :2].tolist())
    return PointMotion([flow], ids, scores, confidence)


def with_margin(config: VerifiedConfig) -> VerifiedConfig:
    """The settings with the region that is looked at: all around larger by whole coarsest pixels, at least 4 m."""
    wide = math.ceil(4.0 / config.pixel_sizes[0]) * config.pixel_sizes[0]
    x0, y0, z0, x1, y1, z1 = config.point_cloud_range
    return config.replace(point_cloud_range=(x0 - wide, y0 - wide, z0, x1 + wide, y1 + wide, z1))


def verify_level(
    sweeps: SlicedSweeps,
    level: Level,
    is_undilated: bool,
    above: Optional[VerifiedLevel],
    shifts: Optional[Dict[Pixel, Vector]],
    config: VerifiedConfig,
) -> VerifiedLevel:
    """The best motion of every component at one pixel size.

    Undilated components are not looked for if they are all of their parent `above`, at the next coarser level. `shifts`
    are those of key points, None = they are not asked.
    """
    is_known, parent = [False] * len(level.members), [-1] * len(level.members)
    if above is not None:
        parent = parents(level.component, above.level.component)
        is_known = equals_parent(level.component, above.level.component) if is_undilated else is_known
    scores = dict(zip(sweeps.pixels(), [0.0] * len(level.component) if above is None else above.scores))
    motions: List[Vector] = []
    evidence: List[int] = []
    for i, members in enumerate(level.members):
        estimates: List[Optional[Vector]] = [None] * (len(sweeps.images) - 1)
        if not level.too_long[i] and not is_known[i]:
            peaks = [find_peak(sweeps, level, members, m, config) for m in range(1, len(sweeps.images))]
            estimates = [None if peak is None else peak[0] for peak in peaks]
            newest = [score for _, score in filter(None, peaks)][0]
            scores.update(dict.fromkeys(members, newest))
        others = []
        if above is not None:
            others.append(above.motions[parent[i]] if parent[i] >= 0 else (0.0, 0.0))
        if shifts is not None:
            others.append(keypoint_motion(members, shifts))
        found = list_motions(estimates, sweeps.elapsed[1:], others)
        values = [0] * len(found)
        if not level.too_long[i]:
            values = [evidence_of(*count_wins(sweeps, members, motion), config.significance) for motion in found]
        if config.thorough:
            slides = slides_along_itself(sweeps, members, found)
            values = [0 if slid else value for slid, value in zip(slides, values)]
        motion, most = best_candidate(values, found)
        motions.append(motion)
        evidence.append(most)
    return VerifiedLevel(level, motions, evidence, list(scores.values()))


def settle(
    sweeps: SlicedSweeps,
    motions: Sequence[Vector],
    may_creep: Sequence[bool],
    object_of: Dict[Pixel, int],
    clouds: Sequence[np.ndarray],
    config: VerifiedConfig,
) -> List[RigidMotion]:
    """Where objects have gone in metres, between the pixels.

    Args:
        sweeps: the window.
        motions: of each object (y, x), finest pixels per sweep interval.
        may_creep: of each object, whether it may move slowly if it has not moved so far.
        object_of: object of each pixel that belongs to one.
        clouds: (N, 3) float64 of t+1, t, t-1, ..., the points that are drawn.

    Convention: only pairs of sweeps have slow motion, as with history slow objects leave their pixels, and are shifted
        between the pixels, as with history one of many sweeps would decide.
    """
    size, is_pair = sweeps.pixel_size, len(sweeps.images) == 2
    if not config.thorough:
        return [RigidMotion((x * size, y * size), 0.0, (0.0, 0.0)) for y, x in motions]
    slow: List[Optional[Vector]] = [None] * len(motions)
    if is_pair:
        members: List[List[Pixel]] = [[] for _ in motions]
        for pixel, owner in object_of.items():
            members[owner].append(pixel)
        asked = [
            may and not any(motion) and leans(sweeps, own) for may, motion, own in zip(may_creep, motions, members)
        ]
        cubes = points_of_objects(asked, object_of, clouds, config, size, NUM_LAYERS)
        slow = slow_motion(cubes, len(motions), sweeps)
    points = points_of_objects([any(motion) for motion in motions], object_of, clouds, config)
    if is_pair:
        motions = shift_between_pixels(points, motions, sweeps)
        points = [point for point in points if any(motions[point.owner])]
    rigid = register(points, [(x * size, y * size) for y, x in motions], sweeps)
    return [motion if flow is None else motion._replace(flow=flow) for motion, flow in zip(rigid, slow)]
