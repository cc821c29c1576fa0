"""The verified method: a tree of components at several pixel sizes, motion candidates, the paired test, refinement.

Order of reading: verified_flow -> `height_slices`, `changed_pixels`, `component_tree`, `candidates`; verify ->
`paired_test`, `aperture`; `registration`, `confidence`. Hand-made scenes test what is not here: objects under
overhangs, slow objects of pairs, sweeps after t+1, and times of points.
"""

from __future__ import annotations

import math
from typing import Sequence

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.aperture import slides_along_itself
from oracle.candidates import propose
from oracle.changed_pixels import find_changed
from oracle.component_tree import Node, grow, select_objects
from oracle.confidence import TABLE, margin, probabilities
from oracle.height_slices import SlicedSweeps, Vector, ground_slope, is_residue, over_squares
from oracle.low_points import pixels_of_low_points
from oracle.paired_test import are_wide, count_wins, evidence_of
from oracle.pixels import in_range
from oracle.registration import register
from oracle.spacing import are_tall, reach_of_pixels, spacing_of
from oracle.sweeps import Cloud, PointMotion
from oracle.unlinked import link_unlinked

CHANGED_Z = 2.0  # times as many standard deviations for nodes of changed pixels
LEAVES = 20  # slices that a fast object must win for each one that it loses


def verified_flow(clouds: Sequence[Cloud], cloud1: Cloud, ground: np.ndarray, config: VerifiedConfig) -> PointMotion:
    """The motion of every point of sweep t. The clouds are t, t-1, ...; the ground are the known ground points of t."""
    points, is_inside = clouds[0].points, in_range(clouds[0].points, config)
    wide = math.ceil(4.0 / config.pixel_sizes[0]) * config.pixel_sizes[0]
    x0, y0, z0, x1, y1, z1 = config.point_cloud_range
    config = config.replace(point_cloud_range=(x0 - wide, y0 - wide, z0, x1 + wide, y1 + wide, z1))
    every, seen, drawn = [cloud1, *clouds], [], []
    for cloud in every:
        is_drawn = cloud.is_active & in_range(cloud.points, config)
        seen.append(cloud.points[is_drawn])
        if config.min_height is not None:
            is_drawn[is_drawn] = ~is_residue(seen[-1], ground, config)
        drawn.append(np.flatnonzero(is_drawn))
    angle, rise = spacing_of(seen[0])
    sweeps = SlicedSweeps(
        [cloud.points[rows] for cloud, rows in zip(every, drawn)],
        [cloud.intervals for cloud in every],
        [cloud.seconds for cloud in every],
        config,
        reach_of_pixels(angle, config),
        are_tall(rise, config),
    )
    change = find_changed(sweeps, seen, [cloud.origin for cloud in every])
    tree = grow(sweeps, change, config)
    tree.nodes.extend(link_unlinked(sweeps, change[2], tree))
    candidates, scores = propose(sweeps, tree.nodes)
    parents = [tree.nodes[node.parent] if node.parent >= 0 else None for node in tree.nodes]
    proven = [verify(sweeps, *given, len(tree.levels)) for given in zip(tree.nodes, parents, candidates)]
    nodes = add_unchanged(sweeps, tree.nodes, [motion for motion, _ in proven], len(tree.levels))
    motions = [motion for motion, _ in proven]
    evidence = [value for _, value in proven]
    object_of, chosen = select_objects(sweeps, tree._replace(nodes=nodes), motions, evidence, config.significance)

    motions = [proven[i][0] if i >= 0 else (0.0, 0.0) for i in chosen.tolist()]
    size, members = sweeps.size, [np.flatnonzero(object_of == i) for i in range(len(chosen))]
    rigid = register(sweeps, object_of, [(x * size, y * size) for y, x in motions])
    tested = [nodes[i].members if i >= 0 else own for i, own in zip(chosen, members)]  # all pixels of the node
    margins = [margin(sweeps, *given) for given in zip(tested, rigid)]
    bins = [number for number, _ in margins]
    of_pixels = probabilities(sweeps, object_of, rigid, bins, change[0], tree.levels[:-1][-2:])

    flow, ids = np.zeros(points.shape), np.full(len(points), -1, dtype=np.int64)
    score, confidence, moving = (
        np.full(len(points), value) for value in (0.0, TABLE["probabilities"][0], TABLE["moving"][0])
    )
    pixels = sweeps.pixel_of_point[len(drawn[0]) :][: len(drawn[1])]
    rows, pixels = drawn[1][is_inside[drawn[1]]], pixels[is_inside[drawn[1]]]
    if config.min_height is not None:
        low = np.setdiff1d(np.flatnonzero(clouds[0].is_active & is_inside), drawn[1])
        is_dynamic = np.array([*(is_moving for _, is_moving in margins), False])  # the last one is of no object
        near = pixels_of_low_points(sweeps, points[low], is_dynamic[object_of], ground, config)
        confidence[low[near == -2]], moving[low[near == -2]] = TABLE["probabilities"][1], TABLE["moving"][1]
        rows, pixels = np.append(rows, low[near >= 0]), np.append(pixels, near[near >= 0])
    confidence[rows], moving[rows] = of_pixels[:, pixels]
    ids[rows] = object_of[pixels]
    for number in np.unique(ids[ids >= 0]).tolist():
        own = ids == number
        score[own] = scores[chosen[number]] if chosen[number] >= 0 else 0.0
        if margins[number][1]:
            flow[own, :2] = rigid[number].flow_at(points[own, :2])
            flow[own, 2] = flow[own, :2] @ ground_slope(ground, rigid[number].centre, config)
    return PointMotion([flow], ids, score, confidence, moving)


def verify(
    sweeps: SlicedSweeps, node: Node, parent: Node | None, candidates: Sequence[Vector], num_levels: int
) -> tuple[Vector, int]:
    """The candidate of most evidence, and its evidence: that of the counts and, with twice as many standard deviations,
    that of the near counts. Fast objects need twice as many of both counts, nodes of changed pixels twice as many of
    each. With history, all must gain a slice for eight pixels. If there is a parent, the last candidate but one is its
    first one, and must not slide along the parent, either."""
    z = sweeps.config.significance * (CHANGED_Z if node.level == num_levels else 1)
    is_fast = node.level > num_levels
    least = 16 * len(node.members) / 8 * sweeps.has_history
    evidence = []
    for number, motion in enumerate(candidates):
        lines = [node, parent] if parent is not None and number == len(candidates) - 2 else [node]
        exact, near = (count_wins(sweeps, node.members, motion, is_near).sum(1).tolist() for is_near in (False, True))
        own = evidence_of(*exact, 2 * z if is_fast else z) + evidence_of(*near, 2 * z)
        stays = is_fast and LEAVES * exact[1] > exact[0]
        slides = any(slides_along_itself(sweeps, line.members, motion) for line in lines)
        counts = own > least and not stays and not slides
        evidence.append(own if counts else 0)
    best = evidence.index(max(evidence))  # ties: the first
    return (candidates[best] if evidence[best] > 0 else (0.0, 0.0)), evidence[best]


def add_unchanged(sweeps: SlicedSweeps, nodes: list[Node], motions: Sequence[Vector], num_levels: int) -> list[Node]:
    """The nodes; those of changed pixels that move, with the pixels within two rows and columns for which the motion
    wins more than it loses, in the 3 x 3 pixels there that are not of such nodes. Ties: the first node."""
    growing = [i for i, node in enumerate(nodes) if node.level == num_levels and any(motions[i])]
    surplus = np.zeros(sweeps.image.shape, dtype=int)
    nearest = np.full(len(sweeps.pixels), -1)
    for i in growing[::-1]:
        image = np.zeros(sweeps.image.shape, dtype=bool)
        image[tuple(sweeps.pixels[nodes[i].members].T)] = True
        nearest[over_squares(image, 2, np.logical_or)[tuple(sweeps.pixels.T)]] = i
    for i in growing:
        nearest[nodes[i].members] = -1
    for i in growing:
        near = np.flatnonzero(nearest == i)
        surplus[tuple(sweeps.pixels[near].T)] = np.subtract(
            *count_wins(sweeps, near, motions[i], False, are_wide(sweeps, near))
        )
    gains = over_squares(surplus, 1, np.add)[tuple(sweeps.pixels.T)] > 0
    found = list(nodes)
    for i in growing:
        found[i] = nodes[i]._replace(members=np.append(nodes[i].members, np.flatnonzero((nearest == i) & gains)))
    return found
