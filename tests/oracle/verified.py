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
from oracle.height_slices import Pixel, SlicedSweeps, SweepPoint, Vector, ground_slope, is_residue
from oracle.overhangs import find_overhung
from oracle.paired_test import best_candidate, count_wins, evidence_of
from oracle.pixels import in_range
from oracle.registration import RigidMotion, register, register_deskewed
from oracle.subpixel_motion import subpixel_motion
from oracle.sweeps import Cloud, PointMotion

CHANGED_Z = 4.0  # standard deviations for what moves by its changed pixels alone


class Found(NamedTuple):
    """What is found of the pixels of a window, or of its copies of what lies under something.

    Attributes:
        object_of: object of each pixel that has one.
        rigid, scores: of each object.
        confidence: of each pixel of t.
        moving, strong: objects that move; those of them that are not of changed pixels alone.
    """

    object_of: dict[Pixel, int]
    rigid: list[RigidMotion]
    scores: list[float]
    confidence: dict[Pixel, float]
    moving: set[int]
    strong: set[int]


class Side(NamedTuple):
    """What is found by the sweeps of one side: of the window and of its copies; of each sweep, 0 for the window or 1
    for the copies, and the pixel, of each point that is drawn; which points of t are drawn, (N,) bool."""

    found: tuple[Found, Found]
    pixels: list[list[tuple[int, Pixel]]]
    is_drawn: np.ndarray

    def object_of(self, which: int, pixel: Pixel) -> tuple[int, int] | None:
        """Of a pixel: 0 or 1, and the number of its object; None = it has none."""
        number = self.found[which].object_of.get(pixel)
        return None if number is None else (which, number)

    def times_shown(self) -> list[int]:
        """Of each point of t that is drawn, how many sweeps besides t and t+1 show its object; 0 without one."""
        shows = [{self.object_of(*at) for at in of_sweep} for of_sweep in self.pixels[2:]]
        own = [self.object_of(*at) for at in self.pixels[1]]
        return [0 if name is None else sum(name in of_sweep for of_sweep in shows) for name in own]


def verified_flow(clouds: Sequence[Cloud], cloud1: Cloud, ground: np.ndarray, config: VerifiedConfig) -> PointMotion:
    """The motion of every point of sweep t.

    Args:
        clouds: sweeps m = t, t-1, ... nearest first, then t+2, t+3, ...
        cloud1: sweep t+1.
        ground: (N, 3) float64, metres, frame of t+1, ground points of t where they are known.

    Convention: where sweeps after t+1 may be given, points go by them if they show their object more than twice as
        often as those before t do. Ids: objects of both windows, then of both copies.
    """
    points, is_inside = clouds[0].points, in_range(clouds[0].points, config)
    wide = math.ceil(4.0 / config.pixel_sizes[0]) * config.pixel_sizes[0]
    x0, y0, z0, x1, y1, z1 = config.point_cloud_range
    config = config.replace(point_cloud_range=(x0 - wide, y0 - wide, z0, x1 + wide, y1 + wide, z1))
    sides = [estimate([cloud1, *(cloud for cloud in clouds if cloud.intervals > 0)], ground, config)]
    if config.num_future > 0:
        future = [cloud for cloud in clouds if cloud.intervals < 0]
        sides.append(estimate([cloud1, clouds[0], *future], ground, config))
    shown = [side.times_shown() for side in sides]
    first_id, start = {}, 0
    for which, side in product((0, 1), range(len(sides))):
        first_id[which, side] = start
        start += len(sides[side].found[which].rigid)

    flow, ids = np.zeros(points.shape), np.full(len(points), -1, dtype=np.int64)
    scores, confidence = np.zeros(len(points)), np.full(len(points), TABLE["probabilities"][0])
    slopes: dict[Vector, Vector] = {}
    for row, i in enumerate(np.flatnonzero(sides[0].is_drawn).tolist()):
        if not is_inside[i]:
            continue
        side = int(len(sides) > 1 and shown[-1][row] > 2 * shown[0][row])
        which, pixel = sides[side].pixels[1][row]
        found = sides[side].found[which]
        confidence[i] = found.confidence[pixel]
        if pixel in found.object_of:
            number = found.object_of[pixel]
            x, y = found.rigid[number].flow_at(*points[i, :2].tolist())
            centre = found.rigid[number].centre
            if (x or y) and centre not in slopes:
                slopes[centre] = ground_slope(ground, centre, config)
            slope_x, slope_y = slopes.get(centre, (0.0, 0.0))
            flow[i] = x, y, slope_x * x + slope_y * y
            ids[i], scores[i] = first_id[which, side] + number, found.scores[number]
    return PointMotion([flow], ids, scores, confidence)


def estimate(every: Sequence[Cloud], ground: np.ndarray, config: VerifiedConfig) -> Side:
    """What is found by some sweeps, t+1 and t first."""
    seen, clouds = [], []
    for cloud in every:
        is_drawn = cloud.is_active & in_range(cloud.points, config)
        seen.append(cloud.points[is_drawn])
        if config.min_height is not None:
            is_drawn[is_drawn] = ~is_residue(seen[-1], ground, config)
        times = np.zeros(len(is_drawn)) if cloud.times is None else cloud.times
        clouds.append([SweepPoint(*row) for row in np.column_stack([cloud.points, times])[is_drawn].tolist()])
        if len(clouds) == 2:
            is_drawn_at_t = is_drawn
    sweeps = SlicedSweeps(clouds, [cloud.intervals for cloud in every], [cloud.seconds for cloud in every], config)
    tree = grow(sweeps, find_changed(sweeps, seen, [cloud.origin for cloud in every]), config)
    num_levels = len(tree.levels)
    copies, overhung = find_overhung(sweeps, tree.may_move, num_levels + 1)
    nodes = [*tree.nodes, *overhung]
    candidates, scores = propose(nodes, config)
    proven = [verify(node, motions, num_levels, config) for node, motions in zip(nodes, candidates)]
    nodes = add_unchanged(sweeps, nodes, [motion for motion, _ in proven], num_levels)

    found = []
    for drawn, plain in ((sweeps, tree.levels[-1]), (copies, [])):
        object_of, chosen = select_objects(nodes, [evidence for _, evidence in proven], num_levels, plain, drawn)
        motions = [(0.0, 0.0) if i is None else proven[i][0] for i in chosen]
        if min(sweeps.elapsed) < 0:
            motions = [best_nearby(drawn, object_of, number, *at, config) for number, at in enumerate(motions)]
        rigid, confidence = settle(drawn, object_of, motions, every[0].times is not None, config)
        of_objects = [0.0 if i is None else scores[i] for i in chosen]
        moving = {number for number, motion in enumerate(rigid) if any(motion.flow) or motion.rotation}
        weak = {number for number, i in enumerate(chosen) if i is not None and nodes[i].level == num_levels}
        found.append(Found(object_of, rigid, of_objects, confidence, moving, moving - weak))
    window, copied = found
    pixels: list[list[tuple[int, Pixel]]] = []
    for m, cloud in enumerate(clouds):
        pixels.append([])
        under = set(copies.clouds[m])
        for point in cloud:
            pixel = (m, *sweeps.cell(point.x, point.y))
            is_copy = point in under and copied.object_of.get(pixel) in copied.moving
            pixels[m].append((int(is_copy and window.object_of.get(pixel) not in window.strong), pixel))
    return Side((window, copied), pixels, is_drawn_at_t)


def verify(node: Node, candidates: Sequence[Vector], num_levels: int, config: VerifiedConfig) -> tuple[Vector, int]:
    """The candidate of most evidence, and its evidence: that of the counts and, with twice as many standard deviations,
    that of the near counts. What moves by its changed pixels alone needs more standard deviations. All must gain three
    slices for each sweep besides t and t+1, or one for eight pixels."""
    z = CHANGED_Z if node.level == num_levels else config.significance
    least = min(16 * 3 * (len(node.sweeps.images) - 2), 16 * len(node.members) // 8)
    evidence = []
    for motion in candidates:
        slides = not node.travels and slides_along_itself(node.sweeps, node.members, motion)
        own = evidence_of(*count_wins(node.sweeps, node.members, motion), z)
        own += evidence_of(*count_wins(node.sweeps, node.members, motion, is_near=True), 2 * z)
        evidence.append(own if own > least and not slides else 0)
    return best_candidate(evidence, candidates)


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
    """The motion of most evidence within two pixels of that of an object. Ties: the nearest, then the first."""
    if not (y or x):
        return y, x
    offsets = sorted(product(range(-2, 3), repeat=2), key=lambda offset: offset[0] ** 2 + offset[1] ** 2)
    found = [(y + dy, x + dx) for dy, dx in offsets]
    members = [pixel for pixel, own in object_of.items() if own == number]
    evidence = [evidence_of(*count_wins(sweeps, members, motion), config.significance) for motion in found]
    best, most = best_candidate(evidence, found)
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
        may_be_slow = [longest is None or length(own) * size <= longest for own in members]
        start = subpixel_motion(sweeps, object_of, motions, may_be_slow)
    apparent = register(sweeps, object_of, start)
    rigid = register_deskewed(sweeps, object_of, start, apparent) if has_times else apparent
    margins = [margin(sweeps, own, motion) for own, motion in zip(members, apparent)]
    static = [motion._replace(flow=(0.0, 0.0), rotation=0.0) for motion in rigid]
    rigid = [motion if is_dynamic else stays for motion, stays, (_, is_dynamic) in zip(rigid, static, margins)]
    shown = [(motion.flow[1] / size, motion.flow[0] / size) for motion in apparent]
    return rigid, confidences(sweeps, object_of, shown, [z for z, _ in margins])
