"""How far the flow of a point can be trusted: counts -> a bin -> a probability (docs/confidence.md)."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence, Tuple

import numpy as np

FILE = Path(__file__).parents[2] / "cflow_torch" / "verified" / "confidence.json"
TABLE: Dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))
Pixel = Tuple[int, int]
Vector = Tuple[float, float]


def neighbourhoods(image: np.ndarray, newest: np.ndarray, motion: Dict[Pixel, Vector], side: int) -> Dict[Pixel, Pixel]:
    """Of each block of sweep t with points: slices, and how many of them t+1 has where they move to.

    Args:
        image, newest: (H, W) uint8, slices of t and of t+1.
        motion: (y, x) pixels until t+1 of the pixels of t that move.
        side: pixels a side of a block.
    """
    sums: Dict[Pixel, Pixel] = {}
    for r, c in np.argwhere(image).tolist():
        dy, dx = (math.floor(way + 0.5) for way in motion.get((r, c), (0.0, 0.0)))
        number, found = sums.get((r // side, c // side), (0, 0))
        there = int(image[r, c]) & _slices(newest, r + dy, c + dx)
        sums[r // side, c // side] = number + bin(int(image[r, c])).count("1"), found + bin(there).count("1")
    return sums


def found_again(
    images: Sequence[np.ndarray], members: Sequence[Sequence[Pixel]], motion: Vector, elapsed: Sequence[float]
) -> int:
    """Slices of a group that another sweep has where the motion takes them: m looks at t+1 and t+1 at m."""
    count = 0
    for m in range(1, len(images)):
        for source, target, k in ((m, 0, elapsed[m]), (0, m, -elapsed[m])):
            dy, dx = (math.floor(f * k + 0.5) for f in motion)
            for r, c in members[source]:
                count += bin(int(images[source][r, c]) & _slices(images[target], r + dy, c + dx)).count("1")
    return count


def margin_bin(
    images: Sequence[np.ndarray],
    members: Sequence[Sequence[Pixel]],
    motion: Vector,
    elapsed: Sequence[float],
    pixel_size: float,
) -> int:
    """Bin of what a group's motion loses by being displaced by 0.4 m per interval, the best of four ways.

    Args:
        images: (H, W) uint8 of t+1, t, t-1, ...
        members: of each sweep, the pixels of the group.
        motion: (y, x) pixels per interval.
        elapsed: intervals to t+1 of each sweep.
        pixel_size: metres.
    """
    off = 0.4 / pixel_size
    found, *displaced = (
        found_again(images, members, (motion[0] + y, motion[1] + x), elapsed)
        for y, x in ((0.0, 0.0), (off, 0.0), (-off, 0.0), (0.0, off), (0.0, -off))
    )
    gain = found - max(displaced)
    return sum(gain > 0 and gain**2 >= bound**2 * found for bound in TABLE["margin"])


def table_place(kind: str, bin_of_kind: int, has_history: bool = False, is_far: bool = False) -> int:
    """Place in the table.

    Args:
        kind: "left out", "unlinked", "still" or "moving".
        bin_of_kind: from 0.
        has_history, is_far: of what moves.
    """
    sizes: List[int] = [1, 1 + len(TABLE["crowd"]), 1 + len(TABLE["share"])]
    start = sum(sizes[: ["left out", "unlinked", "still", "moving"].index(kind)])
    return start + bin_of_kind + (2 * has_history + is_far) * (1 + len(TABLE["margin"]))


def confidences(
    images: Sequence[np.ndarray],
    group_of: Dict[Tuple[int, int, int], int],
    flows: Sequence[Vector],
    elapsed: Sequence[float],
    lower: Vector,
    pixel_size: float,
) -> Tuple[np.ndarray, float]:
    """(H, W) float64 probability of every pixel of t, and that of a point whose pixel was left out.

    Args:
        images: (H, W) uint8 of t+1, t, t-1, ...
        group_of: (sweep, row, col) -> group.
        flows: (x, y) metres per interval of each group at its centre.
        elapsed: intervals to t+1 of each sweep.
        lower: x and y of the region's corner.
        pixel_size: metres.
    """
    motions = [(y / pixel_size, x / pixel_size) for x, y in flows]
    members: List[List[List[Pixel]]] = [[[] for _ in images] for _ in flows]
    for (m, r, c), group in group_of.items():
        members[group][m].append((r, c))
    margins: Dict[int, int] = {
        group: margin_bin(images, members[group], motion, elapsed, pixel_size)
        for group, motion in enumerate(motions)
        if any(motion)
    }
    side = max(1, round(1.6 / pixel_size))
    pixels: List[Pixel] = [(r, c) for r, c in np.argwhere(images[1]).tolist()]
    groups: Dict[Pixel, Optional[int]] = {(r, c): group_of.get((1, r, c)) for r, c in pixels}
    ways = {
        pixel: (motions[group][0] * elapsed[1], motions[group][1] * elapsed[1])
        for pixel, group in groups.items()
        if group is not None
    }
    blocks = neighbourhoods(images[1], images[0], ways, side)
    result = np.zeros(images[1].shape)
    for (r, c), owner in groups.items():
        number, found = blocks[r // side, c // side]
        if owner is None:
            place = table_place("unlinked", sum(number >= bound for bound in TABLE["crowd"]))
        elif owner not in margins:
            place = table_place("still", sum(10 * found >= bound * number for bound in TABLE["share"]))
        else:
            x, y = (c + 0.5) * pixel_size + lower[0], (r + 0.5) * pixel_size + lower[1]
            is_far = x * x + y * y >= TABLE["far"] ** 2
            place = table_place("moving", margins[owner], len(images) > 2, is_far)
        result[r, c] = TABLE["probabilities"][place]
    return result, TABLE["probabilities"][table_place("left out", 0)]


def _slices(image: np.ndarray, row: int, col: int) -> int:
    height, width = image.shape
    return int(image[row, col]) if 0 <= row < height and 0 <= col < width else 0
