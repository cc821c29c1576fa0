"""What probably moves, and how far the flow of a point can be trusted: counts -> a bin -> a probability."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Sequence

import numpy as np

import cflow_torch
from oracle.aperture import principal_axis
from oracle.height_slices import COUNT, SlicedSweeps, over_squares, value_at
from oracle.paired_test import count_wins, found_in_place
from oracle.registration import RigidMotion

FILE = Path(cflow_torch.__file__).parent / "verified" / "confidence.json"
TABLE: dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))
DISPLACEMENT, BLOCK = 0.4, 1.6  # metres per interval; metres


def margin(sweeps: SlicedSweeps, members: np.ndarray, rigid: RigidMotion) -> tuple[int, bool]:
    """The bin of an object with a motion, counted from the first one of such objects, and whether it moves.

    Members are all pixels of the node whose motion the object takes, also those that other objects took.

    The surplus of a motion is what it wins minus what it loses, by the near counts. In a pair, that of a slow motion is
    reduced by that of the best of four copies, displaced by 0.4 m per interval. The margin is this, in standard
    deviations of what it wins and loses, over the root of the number of other sweeps. If a copy explains the sweeps as
    well, to a standard deviation, a line has no margin, and with history neither has an object that is found in place
    as often as that. An object moves if its motion is at least 0.05 m, and P(moving) of its bin at least 0.05, if it is
    fast 0.15, with history 0.02 and 0.04.
    """
    if not any(rigid.flow):
        return 0, False
    speed, off = math.hypot(*rigid.flow), DISPLACEMENT / sweeps.size
    is_fast, is_far = speed >= TABLE["fast"], np.square(rigid.centre).sum() >= TABLE["far"] ** 2
    motion = np.array(rigid.flow)[::-1] / sweeps.size
    (won, lost), *copies = (
        np.sum(count_wins(sweeps, members, motion + shift, True), 1)
        for shift in ((0, 0), (off, 0), (-off, 0), (0, off), (0, -off))
    )
    noise = math.sqrt(max(won + lost, 1))
    over_copies = (won - lost - max(more - less for more, less in copies)) / noise
    value = (won - lost) / noise if sweeps.has_history or is_fast else over_copies
    is_line = principal_axis(sweeps, members[sweeps.pixels[members, 0] == 0]) is not None
    stays = sweeps.has_history and won - lost <= found_in_place(sweeps, members, sweeps.image)[:, 0].sum()
    if over_copies < 1 and (is_line or stays):
        value = 0.0
    value /= math.sqrt(len(sweeps.elapsed) - 1)
    reached = (value >= np.array(TABLE["margin"])).sum()
    number = (4 * sweeps.has_history + 2 * is_far + is_fast) * (1 + len(TABLE["margin"])) + reached
    first = len(TABLE["moving"]) - 8 * (1 + len(TABLE["margin"]))
    least = (0.04 if is_fast else 0.02) if sweeps.has_history else (0.15 if is_fast else 0.05)
    return int(number), bool(speed >= 0.05 and TABLE["moving"][first + number] >= least)


def biases(sweeps: SlicedSweeps) -> np.ndarray:
    """(P,) float32: how much the surroundings of each pixel seem to shift from t to t+1; meant for pixels of t.

    A slice of t that t+1 has only one pixel to the right, and not to the left, is a vector to the right, and so on.
    The bias is the length of the sum of these vectors, divided by the root of the sum of the squares of the vectors of
    pixels. Both sums go three times over three pixels of a row, then of a column, through pixels with one of t around.
    """
    step, row, col = sweeps.pixels.T
    of_t, newest = sweeps.image[1], np.pad(sweeps.image[0], 1)
    middle = slice(1, -1)
    vectors = []
    for behind, ahead in (
        ((slice(-2), middle), (slice(2, None), middle)),
        ((middle, slice(-2)), (middle, slice(2, None))),
    ):
        only_ahead, only_behind = (of_t & newest[a] & ~newest[b] for a, b in ((ahead, behind), (behind, ahead)))
        vectors.append(COUNT[only_ahead] - COUNT[only_behind])
    sums = np.stack((*vectors, vectors[0] ** 2 + vectors[1] ** 2))
    for axis in (2, 1) * 3:
        padded = np.pad(sums, [(0, 0)] + [(int(axis == other), int(axis == other)) for other in (1, 2)])
        windows = np.lib.stride_tricks.sliding_window_view(padded, 3, axis)
        sums = windows.sum(-1) * (sweeps.around[1] > 0)
    down, across, square = sums[:, row, col].astype(np.float32)
    return np.sqrt((down * down + across * across) / np.maximum(square, 1))


def probabilities(
    sweeps: SlicedSweeps,
    object_of: np.ndarray,
    rigid: Sequence[RigidMotion],
    bins_of_objects: Sequence[int],
    is_missing: np.ndarray,
    scales: Sequence[np.ndarray],
) -> np.ndarray:
    """(2, P): of every pixel, that its motion is right, and that it moves; undefined for those of sweeps other than t.
    Given are the object of each pixel, the motion of each object and the result of `margin`, the missing pixels, and
    the dilated component of each pixel at the second finest scale, then at the finest.

    The bins of the table: left out; unknown; static in a pair and biased; static in an unmatched component, by its
    size; static, by the share of the slices in the block around that is found; static beside an object with a motion;
    of such an object, see `margin`. Each but the first three has rows, for pairs, then with history: one if unmatched,
    two if static, not missing and missing, and four of objects, near slow, near fast, far slow, far fast. A block is
    1.6 m wide, and its slices are found if t+1 has them where they move to. A pixel is unmatched if t+1 lacks a slice
    around it. In pairs it is then missing. A component is unmatched if less than an eighth of its size is matched, the
    sum of the reach of its pixels of t. A missing pixel in one has a bin of that kind.
    """
    motion = np.array([*(each.flow[::-1] for each in rigid), (0.0, 0.0)])[object_of] / sweeps.size
    step, row, col = sweeps.pixels.T
    moves = (object_of >= 0) & motion.any(1)
    dy, dx = np.floor(motion.T * sweeps.elapsed[1] + 0.5).astype(int)
    found = COUNT[sweeps.slices & value_at(sweeps.image[0], row + dy, col + dx)]
    side, counts = max(1, round(BLOCK / sweeps.size)), np.zeros((2, *sweeps.around.shape[1:]), dtype=int)
    for of_block, of_pixel in zip(counts, (COUNT[sweeps.slices], found)):
        np.add.at(of_block, (row // side, col // side), np.where(step == 1, of_pixel, 0))
    total, found = counts[:, row // side, col // side]
    sizes, share = (np.array(TABLE[name]) for name in ("size", "share"))
    biased = 2
    unmatched = biased + len(TABLE["bias"])
    static = unmatched + 2 * (1 + len(sizes))
    beside = static + 4 * (1 + len(share))

    is_moving = np.zeros(sweeps.image.shape, dtype=bool)
    is_moving[tuple(sweeps.pixels.T)] = moves
    is_beside = over_squares(is_moving, 1, np.logical_or)[tuple(sweeps.pixels.T)]
    is_unmatched = (sweeps.slices & ~sweeps.around[0, row, col]) > 0
    if not sweeps.has_history:
        is_missing = is_unmatched
    kind = 2 * sweeps.has_history + is_missing
    bins = static + kind * (1 + len(share)) + (10 * found[:, None] >= share * total[:, None]).sum(1)
    if not sweeps.has_history:
        level = (biases(sweeps)[:, None] >= TABLE["bias"]).sum(1)
        bins = np.where(level > 0, biased - 1 + level, bins)
    bins[is_beside] = (beside + kind)[is_beside]
    for component in scales[::-1]:  # the coarse ones come last
        for name in np.unique(component[step == 1]):
            members = np.flatnonzero((component == name) & (step == 1))
            reach = sweeps.reach[row, col][members]
            if 8 * reach[~is_unmatched[members]].sum() < reach.sum():
                lost = members[is_missing[members]]
                bins[lost] = unmatched + sweeps.has_history * (1 + len(sizes)) + (reach.sum() >= sizes).sum()

    moving = beside + 4 + np.array([*bins_of_objects, 0])[object_of]
    table = np.array([TABLE["probabilities"], TABLE["moving"]])
    return table[:, np.where(moves, moving, bins)]
