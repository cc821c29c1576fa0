"""The verified method: components at several pixel sizes, motion candidates, the paired test, registration.

Order of reading: verified_flow -> estimate -> look -> verify_level -> `candidates`, `paired_test`; then `refinement`.
"""

from __future__ import annotations

import math
from typing import Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.aperture import slides_along_itself
from oracle.candidates import find_peak, keypoint_motion, keypoint_shifts, list_motions
from oracle.component_tree import Level, equals_parent, find_components, parents, winners
from oracle.confidence import confidences, margin
from oracle.ground_residue import ground_heights, is_residue
from oracle.height_slices import Pixel, SlicedSweeps, Vector, slice_image
from oracle.layers import points_of_lower_layers
from oracle.local_motion import find_local_motion
from oracle.offline import Estimate, best_nearby, by_side
from oracle.paired_test import best_candidate, count_wins, evidence_of, is_found_where_it_stands
from oracle.pixels import in_range, project_bev
from oracle.refinement import settle
from oracle.relinking import relink
from oracle.rigid_registration import RigidMotion
from oracle.sweeps import Cloud, PointMotion


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


class Found(NamedTuple):
    """What a look at some points finds.

    Attributes:
        owners: of each sweep, t+1 first, (N,) int64, object of each point, -1 = none.
        rigid: motion of each object.
        scores: of sweep t, (N,) float64, as in `VerifiedLevel`; 0 without an object.
        confidence: of sweep t, (N,) float64.
    """

    owners: List[np.ndarray]
    rigid: List[RigidMotion]
    scores: np.ndarray
    confidence: np.ndarray

    def moves(self, m: int) -> np.ndarray:
        """(N,) bool, points of a sweep whose object moves."""
        return np.array([i >= 0 and any(self.rigid[i].flow) for i in self.owners[m].tolist()], dtype=bool)


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
    before = estimate([cloud1, *past], ground, is_inside, config)
    if len(past) == len(clouds):
        return before.motion
    future = [cloud for cloud in clouds if cloud.intervals < 0]
    return by_side(before, estimate([cloud1, clouds[0], *future], ground, is_inside, config))


def estimate(
    clouds: Sequence[Cloud], ground: Sequence[np.ndarray], is_inside: np.ndarray, config: VerifiedConfig
) -> Estimate:
    """The motion of every point of sweep t by some sweeps, t+1 first; points of t that are not inside have none.

    With thorough settings the lower layers of what is at rest are looked at once more; what that moves goes by it.

    Convention: ids of the second look go on after those of the first that points of any sweep have.
    """
    size = config.pixel_sizes[-1]
    seen = [cloud.takes_part & in_range(cloud.points, config) for cloud in clouds]
    drawn = [keep.copy() for keep in seen]
    if config.min_height is not None:
        means = ground_heights(ground, config)
        for cloud, keep in zip(clouds, drawn):
            keep[keep] = ~is_residue(cloud.points[keep], means, config.min_height, config)
    scales = [(round(s / size), False) for s in config.pixel_sizes] + [(1, True)] * config.thorough
    found = look(clouds, drawn, seen, scales, config)
    first = has_result(found, is_inside)
    owners, takes_second, second = first.owners, np.zeros(len(is_inside), dtype=bool), None
    if config.thorough:
        at_rest = [keep & ~found.moves(m) for m, keep in enumerate(drawn)]
        lower = [np.zeros_like(keep) for keep in drawn]
        of_drawn = points_of_lower_layers(
            [cloud.points[keep] for cloud, keep in zip(clouds, drawn)],
            [rest[keep].tolist() for rest, keep in zip(at_rest, drawn)],
            config,
        )
        for keep, of_sweep, wanted in zip(drawn, lower, of_drawn):
            of_sweep[keep] = wanted
        second = has_result(look(clouds, lower, None, [(1, False)], config), is_inside)
        num_ids = 1 + max(own.max(initial=-1) for own in owners)
        owners = [np.where(second.moves(m), num_ids + second.owners[m], own) for m, own in enumerate(owners)]
        takes_second = second.moves(1)

    of_t, flow = clouds[1].points, np.zeros((len(is_inside), 3))
    for i in np.flatnonzero(owners[1] >= 0).tolist():
        chosen = second if second is not None and takes_second[i] else first
        flow[i, :2] = chosen.rigid[chosen.owners[1][i]].flow_at(*of_t[i, :2].tolist())
    scores, confidence = first.scores, first.confidence
    if second is not None:
        scores = np.where(takes_second, second.scores, scores)
        confidence = np.where(takes_second, second.confidence, confidence)
    shows = [set(own.tolist()) for own in owners[2:]]
    shown = [sum(own in of_sweep for of_sweep in shows) if own >= 0 else 0 for own in owners[1].tolist()]
    ids = max(own.max(initial=-1) for own in owners[:2])
    return Estimate(PointMotion([flow], owners[1], scores, confidence), shown, 1 + int(ids))


def has_result(found: Found, is_inside: np.ndarray) -> Found:
    """The same for the points of t that are inside; the others have no object."""
    newest, of_t, *others = found.owners
    of_t = np.where(is_inside, of_t, -1)
    return found._replace(owners=[newest, of_t, *others], scores=np.where(of_t >= 0, found.scores, 0.0))


def look(
    clouds: Sequence[Cloud],
    drawn: Sequence[np.ndarray],
    seen: Optional[Sequence[np.ndarray]],
    scales: Sequence[Tuple[int, bool]],
    config: VerifiedConfig,
) -> Found:
    """What some points do, found at some scales. What could as well be displaced stands still.

    Args:
        clouds: of the sweeps, t+1 first.
        drawn: of each sweep (N,) bool, the points.
        seen: of each sweep (N,) bool, the same with the ground's residue; None = neither key points nor local motion
            are asked, as in a second look.
        scales: of each level finest pixels a side, and whether its components are undilated.
    """
    size = config.pixel_sizes[-1]
    points = [cloud.points[keep] for cloud, keep in zip(clouds, drawn)]
    times = None
    if clouds[0].times is not None:
        times = [cloud.times[keep] for cloud, keep in zip(clouds, drawn)]  # type: ignore[index]
    sweeps = SlicedSweeps(
        [slice_image(of_sweep, config) for of_sweep in points],
        [cloud.intervals for cloud in clouds],
        [cloud.seconds for cloud in clouds],
        size,
        config.point_cloud_range[:2],  # type: ignore[arg-type]
    )
    shifts = keypoint_shifts(sweeps, config) if config.thorough and seen is not None else None
    levels: List[VerifiedLevel] = []
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
    doubt: Dict[Pixel, float] = {}
    if config.thorough and seen is not None and len(clouds) > 2:  # with history nothing creeps
        in_sight = [cloud.points[keep] for cloud, keep in zip(clouds, seen)]
        origins = [cloud.origin for cloud in clouds]
        object_of, motions, doubt = find_local_motion(sweeps, object_of, motions, points, in_sight, origins, config)
        object_of, motions = relink(sweeps, object_of, motions, config)
        may_creep = [False] * len(motions)
    rigid, shown = settle(sweeps, motions, may_creep, object_of, points, config, times)
    trust, of_left_out = confidences(sweeps, object_of, [motion.flow for motion in shown], doubt)
    for i, motion in enumerate(shown if config.thorough else []):
        members = [pixel for pixel, owner in object_of.items() if owner == i]
        if not margin(sweeps, members, (motion.flow[1] / size, motion.flow[0] / size))[1]:
            rigid[i] = rigid[i]._replace(flow=(0.0, 0.0), turn=0.0)

    owners = [np.full(len(cloud.points), -1, dtype=np.int64) for cloud in clouds]
    score_of = dict(zip(sweeps.pixels(), levels[-1].scores))
    scores, confidence = np.zeros(len(owners[1])), np.full(len(owners[1]), of_left_out)
    for m, (cloud, keep) in enumerate(zip(clouds, drawn)):
        rows = np.flatnonzero(keep)
        for i, (r, c) in zip(rows.tolist(), project_bev(cloud.points[rows], config, size).tolist()):
            owners[m][i] = object_of.get((m, r, c), -1)
            if m == 1:
                scores[i], confidence[i] = score_of[1, r, c], trust[1, r, c]
    return Found(owners, rigid, scores, confidence)


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
        if is_found_where_it_stands(sweeps, members, motion):
            motion, most = (0.0, 0.0), 0
        motions.append(motion)
        evidence.append(most)
    return VerifiedLevel(level, motions, evidence, list(scores.values()))
