"""The aperture problem: static lines seem to slide along themselves, and long vehicles really do.

A moving sensor samples walls, hedges and guard rails at positions that move with it, so they seem to slide along
themselves. Such a line is static if the other sweeps have most of it at its position in t+1. The side of a car is a
line as well, but its front reaches a new position. A low line of 7 m or more is a guard rail, which is always static.

Both ends of a bus or a tram move, although most of it is covered. If a wall seems to move, one of its ends stays, or
its ends are only the limits of the view. The ends of a guard rail or a noise barrier may keep pace with the ego
vehicle, because the beams hit it at positions that are fixed in the frame of the vehicle. However, no vehicle is as low
as a guard rail, or as long as a noise barrier. A component longer than `max_object_length` moves only if both of its
ends move.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from cflow_torch.ops.groups import Groups
from cflow_torch.ops.indices import constant, flat_nonzero
from cflow_torch.verified.columns import Pixels, count_slices
from cflow_torch.verified.comparisons import count_in_place
from cflow_torch.verified.height_slices import HeightSlicedSweeps

_THIN = 0.3  # metres, largest standard deviation of a line across it
_LONG = 1.0  # metres, smallest standard deviation along it
_COVERED = 65  # per cent of the slices of a line
_ALONG = 0.04  # squared sine of the largest angle between a line and a motion along it
_LEAST_TRAVEL = 1.2  # metres, of the ends of a long vehicle
_ALIKE = 0.1  # the displacements of two ends that move together differ by at most this share of their sum
_LONGEST = 60.0  # metres; no road vehicle is longer. The ends of a longer noise barrier are only the limits of the view
# A guard rail has fewer than 2 height slices per pixel at t+1 on average, and a standard deviation of at least 2 m
# along it. No vehicle is as low and as long. Where a rail crosses the border of a slice, its pixels have two slices.
_TALL = 2
_RAIL = 2.0


def slides_along_itself(sweeps: HeightSlicedSweeps, pixels: Pixels, groups: Groups, candidates: Tensor) -> Tensor:
    """Find the motions that a static line would seem to have.

    Args:
        pixels: K pixels.
        groups: A groups of these pixels.
        candidates: (A, C, 2) float64 (y, x), fine pixels per sweep interval.

    Returns:
        (A, C) bool. True if the pixels of the component at t+1 form a line, the motion points along it, and the line is
        a rail or is covered. With history, a covered line does not slide if both of its ends move.

    Convention:
        Moments are sums of integers; all else is elementwise float64 in the written order. The pixels of a line have a
        standard deviation of at most 0.3 m across it and at least 1 m along it. A rail is a line with at least 2 m
        along it, and fewer than two slices per pixel on average.

    Cost: some passes over the pixels.
    """
    pixel_size = sweeps.grid.pixel_size
    newest = flat_nonzero(pixels.step == 0)
    newest_pixels = pixels[newest]
    at_newest = groups[newest]
    lines = principal_axes(at_newest, newest_pixels.row_col, pixel_size)
    # The window of each component; components without pixels at t+1 are not lines.
    window = at_newest.max(newest_pixels.window, empty=0)
    of_line = flat_nonzero(groups.spread(lines.is_line))  # few pixels
    of_newest_line = flat_nonzero(at_newest.spread(lines.is_line))
    is_covered = are_covered(sweeps, newest_pixels[of_newest_line], at_newest[of_newest_line])
    # In a pair, a wall that is visible between two occluders has such ends. With history, the static test excludes it.
    travels = both_ends_move(sweeps, pixels[of_line], groups[of_line]) & sweeps.has_history[window]
    num_more = at_newest.sum(count_slices(newest_pixels.slices) - _TALL)
    is_rail = (num_more < 0) & (lines.variance >= (_RAIL / pixel_size) ** 2)
    slides = lines.is_line & (is_rail | is_covered & ~travels)
    return slides[:, None] & lines.are_along(candidates)


def are_covered(sweeps: HeightSlicedSweeps, newest: Pixels, groups: Groups) -> Tensor:
    """Tell which of M groups of K pixels of t+1 were at the same position before, (M,) bool.

    A group is covered if the other sweeps have 65 % of its slices within the reach (`Spacing`) of the same position.
    """
    near = count_in_place(sweeps, newest, groups, is_near=True)
    return (near.compared > 0) & (near.found * 100 >= near.compared * _COVERED)


class Lines(NamedTuple):
    """The principal axes of A components, and which of them are lines."""

    is_line: Tensor  # (A,) bool
    variance: Tensor  # (A,) float64, square pixels, the largest of all directions
    axis: Tensor  # (A, 2) float64, (y, x), a vector in that direction, of any length

    def are_along(self, motions: Tensor) -> Tensor:
        """Tell which motions of each component, (A, C, 2) float64, (y, x), point along its axis: (A, C) bool."""
        y, x = self.axis[:, None].unbind(2)
        across = y * motions[..., 1] - x * motions[..., 0]
        return across.square() <= _ALONG * motions.square().sum(2) * self.axis.square().sum(1)[:, None]


def principal_axes(groups: Groups, row_col: Tensor, pixel_size: float) -> Lines:
    """Return the principal axes of A components from their pixels at t+1; `row_col` is (2, Q) int64."""
    covariance = _covariance(groups, row_col)  # [2, 2, A]
    var_y = covariance[0, 0]
    var_x = covariance[1, 1]
    cov = covariance[0, 1]
    # Eigenvalues of the 2 x 2 matrix.
    mean = (var_y + var_x) / 2
    half = (var_y - var_x) / 2
    root = torch.sqrt(half * half + cov * cov)
    largest = mean + root
    is_line = (mean - root <= (_THIN / pixel_size) ** 2) & (largest >= (_LONG / pixel_size) ** 2)
    # Of the two forms of the eigenvector, we take the one that does not vanish.
    wide = torch.stack((cov, largest - var_y), 1)
    high = torch.stack((largest - var_x, cov), 1)
    return Lines(is_line, largest, torch.where((var_y < var_x)[:, None], wide, high))


def _covariance(groups: Groups, row_col: Tensor) -> Tensor:
    """Return the covariance of row and column of the pixels of A groups, (2, 2, A) float64, square pixels."""
    one_y_x = torch.cat((torch.ones_like(row_col[:1]), row_col))  # `F.pad` of torch 2.0 fails without pixels
    moments = groups.sum((one_y_x[:, None] * one_y_x).view(9, -1)).reshape(3, 3, -1)
    count = moments[0, 0]
    sums = moments[0, 1:]
    # Differences of large products are exact in integers.
    return (count * moments[1:, 1:] - sums[:, None] * sums) / (count * count).clamp(min=1).double()


def both_ends_move(sweeps: HeightSlicedSweeps, pixels: Pixels, groups: Groups) -> Tensor:
    """Find the components whose two ends both move.

    Args:
        pixels: K pixels.
        groups: A groups of these pixels; each pixel is in a group.

    Returns:
        (A,) bool. True if, between t+1 and the sweep farthest in time, the ends moved at least 1.2 m on average in one
        direction along the component, and their displacements differ by at most a tenth of their sum. At t+1, the
        component is at most 60 m long and has two or more slices per pixel.

    Convention:
        The direction of a component is y, x or one of the diagonals: the one in which its pixels at t+1 reach farthest.
        Its ends are the first and the last pixel in this direction. Ties: the first direction, and the first of sweeps
        equally far in time. A component without pixels in that sweep or at t+1 does not move.

    Cost: some passes over the pixels.
    """
    farthest = sweeps.elapsed.abs().argmax(1).index_select(0, pixels.window)  # [K]
    compared = flat_nonzero((pixels.step == 0) | (pixels.step == farthest))
    pixels = pixels[compared]
    # The components at t+1, then those in the farthest sweep.
    in_both = Groups(groups.of_item[compared] + groups.count * (pixels.step != 0), 2 * groups.count)
    is_tall = in_both.sum(count_slices(pixels.slices) - _TALL)[: groups.count] >= 0
    ends = _ends(in_both, pixels, sweeps.grid.pixel_size)
    return is_tall & (ends.length <= _LONGEST) & ends.move_alike()


class _Ends(NamedTuple):
    """The two ends of L components along their direction, (L,) float64 each, metres."""

    length: Tensor  # from one end to the other at t+1
    # Displacement of each end from the farthest sweep to t+1, towards the other end; infinite or NaN without pixels.
    first: Tensor
    last: Tensor

    def move_alike(self) -> Tensor:
        """Tell which components have two ends that move far enough in one direction, and equally far, (L,) bool."""
        both = (self.first - self.last).abs()
        return (both >= 2 * _LEAST_TRAVEL) & ((self.first + self.last).abs() <= _ALIKE * both)


def _ends(in_both: Groups, pixels: Pixels, pixel_size: float) -> _Ends:
    """Find the ends of L components, and their displacement; the pixels are in 2 L groups, those of t+1 first."""
    device = pixels.slices.device
    # The first pixel in each direction, y, x and the diagonals, and in each opposite direction.
    directions = ((1, 0), (0, 1), (1, 1), (1, -1), (-1, 0), (0, -1), (-1, -1), (-1, 1))
    along = constant(directions, torch.float64, device) @ pixels.row_col.double()
    newest, farthest = in_both.min(along, math.inf).reshape(2, 4, 2, -1).unbind(2)  # [2, 4, L] each
    metres = tuple(scale * pixel_size for scale in (1.0, 1.0, math.sqrt(0.5), math.sqrt(0.5)))
    unit = constant(metres, torch.float64, device)[:, None]  # [4, 1]
    length, direction = (newest.sum(0) * -unit).max(0)
    first, last = ((newest - farthest) * unit).gather(1, direction.expand(2, 1, -1))[:, 0]
    return _Ends(length, first, last)
