"""Objects under overhangs: what is on the ground under something else, by its cells in space."""

from __future__ import annotations

import math
from itertools import product

from oracle.component_tree import Node, is_linked, join
from oracle.height_slices import SLICE_HEIGHT, Cell, Pixel, SlicedSweeps, SweepPoint

SIDE = 0.4  # metres, of a cell
HIGHEST = 29  # slices from the lowest cell on; what lies higher counts as this one
SQUARE = 10  # cells a side of a square that has one height of the ground
GAP, HIGHEST_FOOT, SMALLEST, LARGEST = 3, 2, 1, 10  # slices


def find_overhung(sweeps: SlicedSweeps, may_move: set[Pixel], level: int) -> tuple[SlicedSweeps, list[Node]]:
    """Copies of the points that lie under something, drawn by themselves, and the components that they make.

    Args:
        sweeps: the window.
        may_move: pixels whose points are looked through.
        level: that the nodes are to have.

    Convention: cells of all sweeps join if they touch, corners included. The next occupied cell above a cell is over it
        if it is of another component and two empty ones at least lie between. Of two components in one pixel of a sweep
        the one whose first cell is the first has it.
    """
    points = [(m, point) for m, cloud in enumerate(sweeps.clouds) for point in cloud]
    points = [(m, point) for m, point in points if (m, *sweeps.pixel(point.x, point.y)) in may_move]
    cells = cells_of([point for _, point in points], sweeps)
    component = join(cells, 1)
    wanted = components_under(component)
    copied: list[list[SweepPoint]] = [[] for _ in sweeps.clouds]
    object_of: dict[Pixel, int] = {}
    for (m, point), cell in zip(points, cells):
        if component[cell] in wanted:
            pixel = (m, *sweeps.pixel(point.x, point.y))
            object_of[pixel] = min(component[cell], object_of.get(pixel, component[cell]))
            copied[m].append(point)
    copies = sweeps.drawn(copied)
    parts = [
        tuple(sorted(p for p, own in object_of.items() if own == number)) for number in sorted(set(object_of.values()))
    ]
    return copies, [Node(members, level, None, False, copies) for members in parts if is_linked(members)]


def cells_of(cloud: list[SweepPoint], sweeps: SlicedSweeps) -> list[tuple[int, ...]]:
    """Row and column, counted from one cell outside the region, and slice above the lowest one, of some points."""
    (x0, y0), heights = sweeps.lower, [math.floor(point.z / SLICE_HEIGHT) for point in cloud]
    lowest = min(heights, default=0)
    return [
        (math.floor((point.y - y0) / SIDE) + 1, math.floor((point.x - x0) / SIDE) + 1, min(height - lowest, HIGHEST))
        for point, height in zip(cloud, heights)
    ]


def components_under(component: dict[tuple[int, ...], int]) -> set[int]:
    """Components that lie under another one and over none, and are where and as tall as what moves on the ground."""
    ground: dict[Cell, int] = {}
    under, over = set(), set()
    cells = sorted(component)
    for row, col, height in cells:
        square = row // SQUARE, col // SQUARE
        ground[square] = min(height, ground.get(square, height))
    for low, high in zip(cells, cells[1:]):
        if low[:2] == high[:2] and high[2] - low[2] >= GAP and component[low] != component[high]:
            under.add(component[low])
            over.add(component[high])

    def ground_around(row: int, col: int) -> int:
        near = product((-1, 0, 1), repeat=2)
        return min(ground.get((row // SQUARE + dr, col // SQUARE + dc), HIGHEST) for dr, dc in near)

    result = set()
    for number in under - over:
        own = [cell for cell in cells if component[cell] == number]
        heights = [height for _, _, height in own]
        rise = min(height - ground_around(row, col) for row, col, height in own)
        if rise <= HIGHEST_FOOT and SMALLEST <= max(heights) - min(heights) <= LARGEST:
            result.add(number)
    return result
