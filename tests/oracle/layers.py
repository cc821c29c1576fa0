"""Layers: what stands on the ground under something else, as cells in space tell it."""

from __future__ import annotations

import math
from itertools import product
from typing import Dict, List, Sequence, Set, Tuple

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.height_slices import SLICE_HEIGHT

SIDE = 0.4  # metres, of a cell
NUM_SLICES = 4096  # from the lowest cell on; what lies higher counts as the last one
SQUARE = 10  # cells a side of a square that has one height of the ground
GAP, HIGHEST_FOOT, SMALLEST, LARGEST = 3, 2, 1, 10  # slices

Cell = Tuple[int, int, int]  # row, column, slice


def points_of_lower_layers(
    clouds: Sequence[np.ndarray], at_rest: Sequence[Sequence[bool]], config: VerifiedConfig
) -> List[np.ndarray]:
    """Which points at rest belong to something on the ground that lies under something else.

    Args:
        clouds: of each sweep of a window, (N, 3) float64, metres, frame of t+1, inside the range.
        at_rest: of each sweep (N,), which of its points are looked at.
        config: for the range.

    Returns:
        Of each sweep (N,) bool.

    Convention: components of cells that touch, corners included, all sweeps together. The next occupied cell above a
        cell of a lower layer is above it if it is of another component and two cells at least are empty between them;
        nothing of another component is the next below one. Its lowest cell over the ground and its height are those of
        something that moves on the ground.
    """
    x0, y0 = config.point_cloud_range[:2]
    cell_of: Dict[Tuple[int, int], Cell] = {}  # by sweep and row
    for m, (cloud, rest) in enumerate(zip(clouds, at_rest)):
        for i, (x, y, z) in enumerate(cloud.tolist()):
            if rest[i]:
                row, col = math.floor((y - y0) / SIDE), math.floor((x - x0) / SIDE)
                cell_of[m, i] = row, col, math.floor(min(max(z / SLICE_HEIGHT, -(2.0**40)), 2.0**40))
    lowest = min((height for _, _, height in cell_of.values()), default=0)
    cell_of = {key: (r, c, min(height - lowest, NUM_SLICES - 1)) for key, (r, c, height) in cell_of.items()}
    component = join(set(cell_of.values()))

    columns: Dict[Tuple[int, int], List[int]] = {}
    ground: Dict[Tuple[int, int], int] = {}
    for row, col, height in sorted(component):
        columns.setdefault((row, col), []).append(height)
        square = row // SQUARE, col // SQUARE
        ground[square] = min(height, ground.get(square, height))
    under, over = set(), set()
    for (row, col), heights in columns.items():
        for low, high in zip(heights, heights[1:]):
            if high - low >= GAP and component[row, col, low] != component[row, col, high]:
                under.add(component[row, col, low])
                over.add(component[row, col, high])

    wanted = set()
    for number in under - over:
        cells = [cell for cell, own in component.items() if own == number]
        heights = [height for _, _, height in cells]
        rise = min(height - _ground_around(ground, row, col) for row, col, height in cells)
        if rise <= HIGHEST_FOOT and SMALLEST <= max(heights) - min(heights) <= LARGEST:
            wanted.add(number)
    result = [np.zeros(len(cloud), dtype=bool) for cloud in clouds]
    for (m, i), cell in cell_of.items():
        result[m][i] = component[cell] in wanted
    return result


def join(cells: Set[Cell]) -> Dict[Cell, int]:
    """Components of cells and their 26 neighbours."""
    component: Dict[Cell, int] = {}
    for number, seed in enumerate(sorted(cells)):
        open_cells = [] if seed in component else [seed]
        component.setdefault(seed, number)
        while open_cells:
            cell = open_cells.pop()
            for step in product((-1, 0, 1), repeat=3):
                neighbour = cell[0] + step[0], cell[1] + step[1], cell[2] + step[2]
                if neighbour in cells and neighbour not in component:
                    component[neighbour] = number
                    open_cells.append(neighbour)
    return component


def _ground_around(ground: Dict[Tuple[int, int], int], row: int, col: int) -> int:
    """The lowest slice of the nine squares around a cell."""
    r, c = row // SQUARE, col // SQUARE
    around = [(r + dr, c + dc) for dr, dc in product((-1, 0, 1), repeat=2)]
    return min(ground[square] for square in around if square in ground)
