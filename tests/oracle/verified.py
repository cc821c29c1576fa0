"""The verified method: components at several pixel sizes, motion candidates, the paired test, registration.

Order of reading: verified_flow -> verify_level -> `candidates`, `paired_test`; then settle.
"""

from __future__ import annotations

import math
from itertools import product
from typing import Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.aperture import slides_along_itself
from oracle.candidates import find_peak, keypoint_motion, keypoint_shifts, list_motions
from oracle.component_tree import Level, equals_parent, find_components, parents, winners
from oracle.confidence import confidences
from oracle.deskewing import register_deskewed
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
        clouds: sweeps m = t, t-1, ... nearest first, then t+2, t+3, ...
        cloud1: sweep t+1.
        ground: (N, 3) float64, metres, frame of t+1, ground points of t and t+1 where they are known.
    """
    is_inside = in_range(clouds[0].points, config)
    config = with_margin(config)
    past = [cloud for cloud in clouds if cloud.intervals > 0]
    first, shown = flow_by(past, cloud1, ground, is_inside, config)
    if len(past) == len(clouds):
        return first
    future = [clouds[0], *(cloud for cloud in clouds if cloud.intervals < 0)]
    return by_side(first, shown, *flow_by(future, cloud1, ground, is_inside, config))


def by_side(first: PointMotion, shown: List[int], second: PointMotion, shown_after: List[int]) -> PointMotion:
    """Each point goes by the side after t+1 if that shows its object more than twice as often as the other does.

    Args:
        first, second: by the sweeps before t, by those after t+1.
        shown, shown_after: of each point, how many sweeps of that side show its object; 0 if it has none.

    Convention: ids of the second go on after those of the first.
    """
    chosen = [(second if after > 2 * before else first) for before, after in zip(shown, shown_after)]
    ids_after = second.cluster_id + (second.cluster_id >= 0) * (first.cluster_id.max(initial=-1) + 1)
    flow, ids, scores, trust = (
        np.array([values[motion is second][i] for i, motion in enumerate(chosen)])
        for values in (
            (first.flow[0], second.flow[0]),
            (first.cluster_id, ids_after),
            (first.score, second.score),
            (first.confidence, second.confidence),
        )
    )
    return PointMotion([flow.reshape(-1, 3)], ids.astype(np.int64), scores, trust)


def flow_by(
    clouds: Sequence[Cloud],
    cloud1: Cloud,
    ground: Sequence[np.ndarray],
    is_inside: np.ndarray,
    config: VerifiedConfig,
) -> Tuple[PointMotion, List[int]]:
    """The motion of every point of sweep t by the sweeps given, and how many beside t and t+1 show its object; of those
    that are not inside, none and 0."""
    size = config.pixel_sizes[-1]
    drawn = [cloud.takes_part & in_range(cloud.points, config) for cloud in (cloud1, *clouds)]
    if config.min_height is not None:
        means = ground_heights(ground, config)
        for cloud, keep in zip((cloud1, *clouds), drawn):
            keep[keep] = ~is_residue(cloud.points[keep], means, config.min_height, config)
    points = [cloud.points[keep] for cloud, keep in zip((cloud1, *clouds), drawn)]
    times = None
    if cloud1.times is not None:
        times = [cloud.times[keep] for cloud, keep in zip((cloud1, *clouds), drawn)]  # type: ignore[index]
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
    if any(time < 0 for time in sweeps.elapsed):
        motions = [
            best_nearby(sweeps, [pixel for pixel, owner in object_of.items() if owner == i], motion, config)
            for i, motion in enumerate(motions)
        ]
    rigid, seen = settle(sweeps, motions, may_creep, object_of, points, config, times)
    trust, of_left_out = confidences(sweeps, object_of, [motion.flow for motion in seen])

    num_points, score_of = len(clouds[0].points), dict(zip(sweeps.pixels(), levels[-1].scores))
    flow, ids, scores = np.zeros((num_points, 3)), np.full(num_points, -1, dtype=np.int64), np.zeros(num_points)
    confidence, shown = np.full(num_points, of_left_out), [0] * num_points
    shown_in = [{m for (m, _, _), owner in object_of.items() if owner == i and m > 1} for i in range(len(chosen))]
    rows = np.flatnonzero(drawn[1] & is_inside)
    for i, (r, c) in zip(rows.tolist(), project_bev(clouds[0].points[rows], config, size).tolist()):
        confidence[i] = trust[1, r, c]
        if (1, r, c) in object_of:
            ids[i], scores[i] = object_of[1, r, c], score_of[1, r, c]
            flow[i, :2] = rigid[ids[i]].flow_at(*clouds[0].points[i, :2].tolist())
            shown[i] = len(shown_in[ids[i]])
    return PointMotion([flow], ids, scores, confidence), shown


def best_nearby(sweeps: SlicedSweeps, members: Sequence[Pixel], motion: Vector, config: VerifiedConfig) -> Vector:
    """The motion of most evidence within two pixels of that of an object; of equals the nearest, then the first."""
    offsets = sorted(product(range(-2, 3), repeat=2), key=lambda offset: offset[0] ** 2 + offset[1] ** 2)
    found = [(motion[0] + dy, motion[1] + dx) for dy, dx in offsets]
    if not any(motion):
        return motion
    best, most = best_candidate(
        [evidence_of(*count_wins(sweeps, members, one), config.significance) for one in found], found
    )
    return best if most > 0 else motion


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
        if config.thorough and not level.travels[i]:
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
    times: Optional[Sequence[np.ndarray]] = None,
) -> Tuple[List[RigidMotion], List[RigidMotion]]:
    """Where objects have gone in metres, between the pixels, and where the images show them to have gone.

    Args:
        sweeps: the window.
        motions: of each object (y, x), finest pixels per sweep interval.
        may_creep: of each object, whether it may move slowly if it has not moved so far.
        object_of: object of each pixel that belongs to one.
        clouds: (N, 3) float64 of t+1, t, t-1, ..., the points that are drawn.
        times: (N,) of each of them, sweep intervals; None = there are none.

    Convention: only pairs of sweeps have slow motion, as with history slow objects leave their pixels, and are shifted
        between the pixels, as with history one of many sweeps would decide.
    """
    size, is_pair = sweeps.pixel_size, len(sweeps.images) == 2
    if not config.thorough:
        moved = [RigidMotion((x * size, y * size), 0.0, (0.0, 0.0)) for y, x in motions]
        return moved, moved
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
    points = points_of_objects([any(motion) for motion in motions], object_of, clouds, config, times=times)
    if is_pair:
        motions = shift_between_pixels(points, motions, sweeps)
        points = [point for point in points if any(motions[point.owner])]
    start = [(x * size, y * size) for y, x in motions]
    found = register(points, start, sweeps)
    seen = [motion if flow is None else motion._replace(flow=flow) for motion, flow in zip(found, slow)]
    return (seen if times is None else register_deskewed(points, start, seen, sweeps, config)), seen
