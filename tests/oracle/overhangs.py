"""Objects under overhangs: what is on the ground under something else, by its cells in space."""

from __future__ import annotations

import math

from oracle.component_tree import Node, is_linked, join
from oracle.height_slices import NEAR, SLICE_HEIGHT, Cell, Pixel, SlicedSweeps, SweepPoint

SIDE = 0.4  # metres, of a cell
HIGHEST = 29  # slices from the lowest cell on; what lies higher counts as this one
SQUARE = 10  # cells a side of a square that has one height of the ground
GAP, HIGHEST_FOOT, SMALLEST, LARGEST = 3, 2, 1, 10  # slices


def find_overhung(sweeps: SlicedSweeps, may_move: set[Pixel], level: int) -> tuple[SlicedSweeps, list[Node]]:
    """Copies of the points that lie under something, drawn by themselves, and the components that they make.

    Args:
        sweeps: the window.
        may_move: pixels whose points are searched.
        level: that the nodes are to have.

    Convention: cells of all sweeps join if they touch, corners included. The next occupied cell above a cell is over it
        if it is of another component and two empty ones at least lie between. Of two components in one pixel of a sweep
        the one whose first cell is the first has it.
    """
    points = [(pixel, point) for pixel, point in sweeps.points() if pixel in may_move]
    (x0, y0), lowest = sweeps.lower, min((math.floor(p.z / SLICE_HEIGHT) for _, p in points), default=0)
    cells = []  # row and column, counted from one cell outside the region, and slice above the lowest one
    for _, p in points:
        height = min(math.floor(p.z / SLICE_HEIGHT) - lowest, HIGHEST)
        cells.append((math.floor((p.y - y0) / SIDE) + 1, math.floor((p.x - x0) / SIDE) + 1, height))
    component = join(cells, 1)
    wanted = components_under(component)
    copied: list[list[SweepPoint]] = [[] for _ in sweeps.clouds]
    object_of: dict[Pixel, int] = {}
    for (pixel, point), cell in zip(points, cells):
        if component[cell] in wanted:
            object_of[pixel] = min(component[cell], object_of.get(pixel, component[cell]))
            copied[pixel[0]].append(point)
    copies = sweeps.with_points(copied)
    members = [tuple(sorted(p for p, own in object_of.items() if own == number)) for number in sorted(wanted)]
    return copies, [Node(own, level, None, False, copies) for own in members if own and is_linked(own)]


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
    result = set()
    for number in under - over:
        heights, rises = [], []
        for row, col, height in (cell for cell in cells if component[cell] == number):
            heights.append(height)
            rises.append(height - min(ground.get((row // SQUARE + y, col // SQUARE + x), HIGHEST) for y, x in NEAR))
        if min(rises) <= HIGHEST_FOOT and SMALLEST <= max(heights) - min(heights) <= LARGEST:
            result.add(number)
    return result
