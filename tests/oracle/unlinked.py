"""Fast objects: parts of single sweeps that a constant velocity links."""

from __future__ import annotations

import math
from statistics import median

import numpy as np
from scipy import ndimage

from oracle.clustering import SQUARE
from oracle.component_tree import Node, Tree
from oracle.height_slices import SlicedSweeps
from oracle.paired_test import count_wins

GAP, LONGEST, CELL = 0.4, 8.0, 0.8  # metres: pixels of a part, length of a part, cells of the map
NEAR, REACH = 2, 8  # cells
ERROR, SHARE = 0.7, 0.05  # metres, and metres for each metre
NARROWEST = 0.4  # metres
LEAST_SIZE, LIKE = 16, 2  # in a pair: pixels times their reach of an unmatched component; ratio of numbers of pixels


def parts_of(sweeps: SlicedSweeps, may_be_fast: np.ndarray) -> list[np.ndarray]:
    """Pixels of a sweep that may be fast and touch in pixels of 0.4 m: at least two, at most 8 m long."""
    block = max(1, round(GAP / sweeps.size))
    parts = []
    for step in range(len(sweeps.elapsed)):
        own = np.flatnonzero(may_be_fast & (sweeps.pixels[:, 0] == step))
        row, col = sweeps.pixels[own, 1:].T // block
        image = np.zeros((row.max(initial=0) + 1, col.max(initial=0) + 1), dtype=bool)
        image[row, col] = True
        label = ndimage.label(image, SQUARE)[0][row, col]
        found = [own[label == name] for name in np.unique(label)]
        # In the order of the first square of two by two such pixels.
        found.sort(
            key=lambda part: min((r // (2 * block), c // (2 * block)) for _, r, c in sweeps.pixels[part].tolist())
        )
        for part in found:
            extent = np.ptp(sweeps.pixels[part, 1:], axis=0).max()
            if len(part) >= 2 and extent * sweeps.size <= LONGEST:
                parts.append(part)
    return parts


def parts_of_pair(sweeps: SlicedSweeps, component: np.ndarray) -> list[np.ndarray]:
    """Unmatched components of t and of t+1: less than an eighth of their size is matched. Each is at most 8 m long."""
    step, row, col = sweeps.pixels.T
    reach = sweeps.reach[row, col]
    parts = []
    for own, other in ((1, 0), (0, 1)):
        is_matched = (sweeps.slices & ~sweeps.around[other, row, col]) == 0
        found = [np.flatnonzero((step == own) & (component == name)) for name in np.unique(component[step == own])]
        for part in found:
            size = reach[part].sum()
            length = (np.ptp(sweeps.pixels[part, 1:], axis=0).max() + 1) * sweeps.size
            is_unmatched = 8 * reach[part[is_matched[part]]].sum() < size
            if is_unmatched and size >= LEAST_SIZE and len(part) >= 2 and length <= LONGEST:
                parts.append(part)
    return parts


def link_unlinked(sweeps: SlicedSweeps, may_be_fast: np.ndarray, tree: Tree) -> list[Node]:
    """The nodes of fast objects, of level L + 1."""
    is_pair = not sweeps.has_history
    parts = parts_of_pair(sweeps, tree.levels[:-1][-2:][0]) if is_pair else parts_of(sweeps, may_be_fast)
    step_of = [int(sweeps.pixels[part[0], 0]) for part in parts]
    centres = [sweeps.pixels[part, 1:].sum(0) / len(part) for part in parts]
    cell = max(1, round(CELL / sweeps.size))
    place = [tuple(np.floor(centre / cell).astype(int)) for centre in centres]
    at = {(step, *where): i for i, (step, where) in enumerate(zip(step_of, place))}  # the last one of a cell
    most = (np.array(sweeps.image.shape[1:]) - 1) // cell

    def around(step: int, centre: np.ndarray, reach: int) -> list[int]:
        row, col = np.clip(np.floor(centre / cell).astype(int), 0, most)
        square = range(-reach, reach + 1)
        return [at[step, row + r, col + c] for r in square for c in square if (step, row + r, col + c) in at]

    tracks = []
    since = np.array(sweeps.elapsed) - sweeps.elapsed[1]
    for other_step in (0,) if is_pair else (0, 2):
        seconds = abs(sweeps.seconds[other_step] - sweeps.seconds[1])
        farthest = (sweeps.config.max_speed or 60.0) * seconds / sweeps.size + 1
        for i in np.flatnonzero(np.array(step_of) == 1).tolist():
            for other in around(other_step, centres[i], REACH):
                distance = np.linalg.norm(centres[other] - centres[i])
                length = np.ptp(sweeps.pixels[parts[i], 1:], axis=0).max() + 1
                sizes = len(parts[i]), len(parts[other])
                if length / 2 <= distance <= farthest and (not is_pair or max(sizes) <= LIKE * min(sizes)):
                    velocity = (centres[i] - centres[other]) / since[other_step]
                    cost, track = follow(sweeps, i, velocity, centres, since, around)
                    # In a pair, all errors are 0, and the shortest way has the lowest cost.
                    tracks.append((cost + is_pair * distance, track))
    chosen = []
    for cost, track in tracks:
        rivals = [[c for c, other in tracks if other.get(step) == track.get(step)] for step in (1, 0)]
        is_best = cost < math.inf and all(cost == min(costs) for costs in rivals)
        if is_best and all(track[1] != other[1] for other in chosen):
            chosen.append(track)
    owner: dict[int, int] = {}
    for number, track in enumerate(chosen):
        for part in track.values():
            owner.setdefault(part, number)
    nodes = []
    for number, track in enumerate(chosen):
        own = [parts[part] for part in range(len(parts)) if owner.get(part) == number]
        members = np.sort(np.concatenate(own))
        shifts = [(centres[track[1]] - centres[p]) / since[step_of[p]] for p in track.values() if step_of[p] != 1]
        velocity = tuple(median(axis) for axis in np.transpose(shifts).tolist())
        speed = max(math.hypot(*velocity), 1)
        side = sweeps.pixels[members, 1:] @ (np.array([velocity[1], -velocity[0]]) / speed)
        if np.ptp(side) * sweeps.size < NARROWEST:
            continue
        won, lost = count_wins(sweeps, members, velocity, is_near=True).sum(1)
        if won > lost:
            nodes.append(Node(members, len(tree.levels) + 1, -1, velocity))
    return nodes


def follow(sweeps, i, velocity, centres, since, around) -> tuple[float, dict[int, int]]:  # type: ignore[no-untyped-def]
    """The cost of a velocity of part i, infinite if too few parts confirm it, and its part in each sweep."""
    track, cost = {1: i}, 0.0
    for step in range(len(since)):
        expected = centres[i] - velocity * since[step]
        distances = [(float(((centres[p] - expected) ** 2).sum()), p) for p in around(step, expected, NEAR)]
        square, part = min(distances, key=lambda pair: pair[0], default=(math.inf, -1))
        bound = ERROR / sweeps.size + SHARE * math.hypot(*velocity) * abs(since[step])
        if step == 1:
            continue
        if math.sqrt(square) <= bound:
            track[step] = part
        cost += min((math.sqrt(square) / bound) ** 2, 1)
    is_in_half = 2 * sum(step >= 2 for step in track) >= len(since) - 2
    return (cost if 0 in track and (2 in track or is_in_half) else math.inf), track
