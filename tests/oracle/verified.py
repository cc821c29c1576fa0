"""The verified method: a tree of components at several pixel sizes, motion candidates, the paired test, refinement.

Order of reading: verified_flow -> estimate -> `height_slices`, `changed_pixels`, `component_tree`, `overhangs`;
verify -> `candidates`, `paired_test`, `aperture`; settle -> `subpixel_motion`, `registration`, `confidence`.
"""

from __future__ import annotations

import math
from itertools import product
from typing import NamedTuple, Sequence

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.aperture import slides_along_itself
from oracle.candidates import propose
from oracle.changed_pixels import find_changed
from oracle.component_tree import Node, grow, length, select_objects
from oracle.confidence import TABLE, confidences, margin
from oracle.height_slices import (
    Pixel,
    SlicedSweeps,
    SweepPoint,
    Vector,
    empty_sweeps,
    ground_heights,
    ground_slope,
    is_residue,
)
from oracle.overhangs import find_overhung
from oracle.paired_test import best_candidate, count_wins, evidence_of
from oracle.pixels import in_range
from oracle.registration import LAYER_HEIGHT, NUM_LAYERS, RigidMotion, register, register_deskewed
from oracle.subpixel_motion import subpixel_motion
from oracle.sweeps import Cloud, PointMotion
from oracle.voxels import points_of_objects

CHANGED_Z = 4.0  # standard deviations for what moves by its changed pixels alone


class Part(NamedTuple):
    """What is found of the pixels of a window, or of its copies of what lies under something.

    Attributes:
        sweeps: the pixels.
        object_of: object of each pixel that has one.
        rigid, scores: of each object.
        is_weak: of each object, whether it is that of changed pixels.
        confidence: of each pixel of t.
    """

    sweeps: SlicedSweeps
    object_of: dict[Pixel, int]
    rigid: list[RigidMotion]
    scores: list[float]
    is_weak: list[bool]
    confidence: dict[Pixel, float]

    def moves(self, pixel: Pixel, surely: bool = False) -> bool:
        """Has it an object that moves, surely = and that is not weak?"""
        number = self.object_of.get(pixel)
        if number is None or (surely and self.is_weak[number]):
            return False
        return any(self.rigid[number].flow) or self.rigid[number].rotation != 0


class Found(NamedTuple):
    """What is found of the points by the sweeps of one side.

    Attributes:
        parts: the window and its copies.
        drawn: of each sweep (N,) bool, points that are drawn.
        which: of each sweep, part and pixel of each point that is drawn.
    """

    parts: tuple[Part, Part]
    drawn: list[np.ndarray]
    which: list[list[tuple[int, Pixel]]]


def verified_flow(
    clouds: Sequence[Cloud], cloud1: Cloud, ground: Sequence[np.ndarray], config: VerifiedConfig
) -> PointMotion:
    """The motion of every point of sweep t.

    Args:
        clouds: sweeps m = t, t-1, ... nearest first, then t+2, t+3, ...
        cloud1: sweep t+1.
        ground: (N, 3) float64, metres, frame of t+1, ground points of t where they are known.

    Convention: where sweeps after t+1 may be given, points go by them if they show their object more than twice as
        often as those before t do. Ids: objects of both windows, then of both copies.
    """
    is_inside = in_range(clouds[0].points, config)
    wide = math.ceil(4.0 / config.pixel_sizes[0]) * config.pixel_sizes[0]
    x0, y0, z0, x1, y1, z1 = config.point_cloud_range
    config = config.replace(point_cloud_range=(x0 - wide, y0 - wide, z0, x1 + wide, y1 + wide, z1))
    past = [cloud for cloud in clouds if cloud.intervals > 0]
    sides = [estimate([cloud1, *past], ground, config)]
    if config.num_future > 0:
        future = [cloud for cloud in clouds if cloud.intervals < 0]
        sides.append(estimate([cloud1, clouds[0], *future], ground, config))
    before, after = sides[0], sides[-1]
    shown = [number_shown(side) for side in sides]
    first_id, start = {}, 0
    for part in (0, 1):
        for side in range(len(sides)):
            first_id[side, part] = start
            start += len(sides[side].parts[part].rigid)

    num_points, slopes = len(is_inside), {}  # type: ignore[var-annotated]
    flow, ids = np.zeros((num_points, 3)), np.full(num_points, -1, dtype=np.int64)
    scores, confidence = np.zeros(num_points), np.full(num_points, TABLE["probabilities"][0])
    for row, i in enumerate(np.flatnonzero(before.drawn[1]).tolist()):
        if is_inside[i]:
            side = int(after is not before and shown[-1][row] > 2 * shown[0][row])
            which, pixel = sides[side].which[1][row]
            part = sides[side].parts[which]
            number = part.object_of.get(pixel)
            confidence[i] = part.confidence[pixel]
            if number is not None:
                x, y = part.rigid[number].flow_at(*clouds[0].points[i, :2].tolist())
                centre = part.rigid[number].centre
                if (x or y) and centre not in slopes:
                    slopes[centre] = ground_slope(ground, centre, config)
                slope_x, slope_y = slopes.get(centre, (0.0, 0.0))
                flow[i] = x, y, slope_x * x + slope_y * y
                ids[i], scores[i] = first_id[side, which] + number, part.scores[number]
    return PointMotion([flow], ids, scores, confidence)


def number_shown(found: Found) -> list[int]:
    """Of each point of t that is drawn, how many sweeps beside t and t+1 show its object; 0 without one."""
    objects = [[(part, found.parts[part].object_of.get(pixel)) for part, pixel in of_sweep] for of_sweep in found.which]
    shows = [set(of_sweep) for of_sweep in objects[2:]]
    return [sum(own in of_sweep for of_sweep in shows) if own[1] is not None else 0 for own in objects[1]]


def estimate(every: Sequence[Cloud], ground: Sequence[np.ndarray], config: VerifiedConfig) -> Found:
    """What is found by some sweeps, t+1 and t first."""
    in_sight = [cloud.is_active & in_range(cloud.points, config) for cloud in every]
    drawn = [keep.copy() for keep in in_sight]
    if config.min_height is not None:
        means = ground_heights(ground, config)
        for cloud, keep in zip(every, drawn):
            keep[keep] = ~is_residue(cloud.points[keep], means, config)
    points: list[list[SweepPoint]] = []
    for cloud, keep in zip(every, drawn):
        times = np.zeros(len(keep)) if cloud.times is None else cloud.times
        points.append([SweepPoint(*row) for row in np.column_stack([cloud.points, times])[keep].tolist()])
    elapsed, seconds = [cloud.intervals for cloud in every], [cloud.seconds for cloud in every]
    sweeps = empty_sweeps(elapsed, seconds, config).drawn(points)
    seen = [cloud.points[keep] for cloud, keep in zip(every, in_sight)]
    tree = grow(sweeps, find_changed(sweeps, seen, [cloud.origin for cloud in every]), config)
    num_levels = len(tree.levels)
    copies, overhung = find_overhung(sweeps, tree.may_move, num_levels + 1)
    nodes = [*tree.nodes, *overhung]
    candidates, scores = propose(nodes, config)
    proven = [verify(node, motions, num_levels, config) for node, motions in zip(nodes, candidates)]
    nodes = add_unchanged(sweeps, nodes, [motion for motion, _ in proven], num_levels)

    parts = []
    for of_part, plain in ((sweeps, tree.levels[-1]), (copies, [])):
        object_of, chosen = select_objects(nodes, [found[1] for found in proven], num_levels, plain, of_part)
        motions = [(0.0, 0.0) if i is None else proven[i][0] for i in chosen]
        if min(elapsed) < 0:
            motions = [best_nearby(of_part, object_of, number, *at, config) for number, at in enumerate(motions)]
        rigid, confidence = settle(of_part, object_of, motions, every[0].times is not None, config)
        of_objects = [0.0 if i is None else scores[i] for i in chosen]
        is_weak = [i is not None and nodes[i].level == num_levels for i in chosen]
        parts.append(Part(of_part, object_of, rigid, of_objects, is_weak, confidence))
    window_part, copied = parts
    which = []
    for m, of_sweep in enumerate(points):
        under = set(copies.clouds[m])
        pixels = [(point, (m, *sweeps.pixel(point.x, point.y))) for point in of_sweep]
        which.append(
            [(int(p in under and copied.moves(at) and not window_part.moves(at, True)), at) for p, at in pixels]
        )
    return Found((window_part, copied), drawn, which)


def verify(node: Node, candidates: Sequence[Vector], num_levels: int, config: VerifiedConfig) -> tuple[Vector, int]:
    """The candidate of most evidence, and its evidence. What moves by its changed pixels alone needs more standard
    deviations. All must gain two slices for each sweep besides t and t+1, or one for twelve pixels."""
    z = CHANGED_Z if node.level == num_levels else config.significance
    slides = [False] * len(candidates)
    if not node.travels:
        slides = slides_along_itself(node.sweeps, node.members, candidates)
    counts = [count_wins(node.sweeps, node.members, motion) for motion in candidates]
    evidence = [0 if slid else evidence_of(*own, z) for own, slid in zip(counts, slides)]
    least = min(16 * 2 * (len(node.sweeps.images) - 2), 16 * len(node.members) // 12)
    return best_candidate([own if own > least else 0 for own in evidence], candidates)


def add_unchanged(
    sweeps: SlicedSweeps, nodes: Sequence[Node], motions: Sequence[Vector], num_levels: int
) -> list[Node]:
    """The nodes; those of changed pixels that move, with the pixels within two rows and columns for which the motion
    wins more than it loses, in the 3 x 3 pixels there that are not of such nodes."""
    growing = [i for i, node in enumerate(nodes) if node.level == num_levels and any(motions[i])]
    free = set(sweeps.pixels()) - {pixel for i in growing for pixel in nodes[i].members}
    number: dict[Pixel, int] = {}
    for i in growing:
        for (m, r, c), (dy, dx) in product(nodes[i].members, product(range(-2, 3), repeat=2)):
            if (m, r + dy, c + dx) in free:
                number.setdefault((m, r + dy, c + dx), i)
    counts = {pixel: count_wins(sweeps, [pixel], motions[i]) for pixel, i in number.items()}
    found = list(nodes)
    for (m, r, c), i in number.items():
        around = [counts.get((m, r + dy, c + dx), (0, 0)) for dy, dx in product((-1, 0, 1), repeat=2)]
        if sum(won - lost for won, lost in around) > 0:
            found[i] = found[i]._replace(members=(*found[i].members, (m, r, c)))
    return found


def best_nearby(
    sweeps: SlicedSweeps, object_of: dict[Pixel, int], number: int, y: float, x: float, config: VerifiedConfig
) -> Vector:
    """The motion of most evidence within two pixels of that of an object; of equals the nearest, then the first."""
    offsets = sorted(product(range(-2, 3), repeat=2), key=lambda offset: offset[0] ** 2 + offset[1] ** 2)
    found = [(y + dy, x + dx) for dy, dx in offsets] if y or x else [(y, x)]
    members = [pixel for pixel, own in object_of.items() if own == number]
    counts = [count_wins(sweeps, members, motion) for motion in found]
    best, most = best_candidate([evidence_of(*of_motion, config.significance) for of_motion in counts], found)
    return best if most > 0 else (y, x)


def settle(
    sweeps: SlicedSweeps,
    object_of: dict[Pixel, int],
    motions: Sequence[Vector],
    has_times: bool,
    config: VerifiedConfig,
) -> tuple[list[RigidMotion], dict[Pixel, float]]:
    """The final motion of each object, and how far pixels of t can be trusted.

    Args:
        sweeps: the pixels.
        object_of: object of each pixel that has one.
        motions: of each object, (y, x) finest pixels per interval.
        has_times: whether points have times.
        config: settings.
    """
    size, longest = sweeps.size, config.max_object_length
    members: list[list[Pixel]] = [[] for _ in motions]
    for pixel, number in object_of.items():
        members[number].append(pixel)
    start = [(x * size, y * size) for y, x in motions]
    if len(sweeps.images) == 2:
        may_be_slow = [longest is None or length(tuple(own)) * size <= longest for own in members]
        start = subpixel_motion(sweeps, object_of, motions, may_be_slow)
    points = points_of_objects(sweeps, object_of, [any(flow) for flow in start], LAYER_HEIGHT, NUM_LAYERS)
    apparent = register(points, start, sweeps)
    rigid = register_deskewed(points, start, apparent, sweeps, config) if has_times else list(apparent)
    shown = [(motion.flow[1] / size, motion.flow[0] / size) for motion in apparent]
    margins = [margin(sweeps, own, motion) for own, motion in zip(members, apparent)]
    rigid = [
        m if is_dynamic else m._replace(flow=(0.0, 0.0), rotation=0.0) for m, (_, is_dynamic) in zip(rigid, margins)
    ]
    return rigid, confidences(sweeps, object_of, shown, [z for z, _ in margins])
