"""Alignment: correct the ego motion where poses are off by centimetres or tenths of a degree.

Such poses move the whole static world, differently in each sweep. So right after drawing, we register every other sweep
with t+1 as if it were one object. If a sweep then matches clearly better, we correct its ego motion:

    align               up to three times, while a sweep matches better
        corrections
            register        some structure of all sweeps. If a sweep matches better, we register more structure
            Votes           blocks of 5 m vote
        corrected           moves the points, the origins of the sweeps and the pose flow
        draw                the moved points

If no sweep matches better, every number stays the same.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Callable, NamedTuple

import torch
from torch import Tensor

from cflow_torch.ops.groups import Groups
from cflow_torch.ops.indices import floor_divide, take_columns
from cflow_torch.verified.columns import count_slices
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.refinement import Registration
from cflow_torch.verified.rigid_motion import RigidMotion
from cflow_torch.verified.voxel_centroids import ObjectPoints, Voxels, points_of_pixels
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch

_TALL = 2  # height slices of a pixel of structure, at least
_SAMPLED = 0.8  # metres, side of the blocks that we take or leave out, so that all sweeps show the same surfaces
_FEW, _MORE = 600, 3000  # pixels of structure, about, in all sweeps but t+1
_FEW_ITERATIONS, _MORE_ITERATIONS = 1, 6
_MOST_ROUNDS = 3  # a round corrects points by up to about 0.2 m
# What a voxel must gain on average, as a share of a perfect match, and what all of them gain together, in standard
# deviations of noise. Real drives with good poses gain 0.012 at most. With a noise of 2 cm and 0.1 degrees, they gain
# 0.02 to 0.28.
_LEAST_GAIN, _GAIN_Z = 0.01, 3.0
# Blocks whose gain exceeds its noise vote. Those that gain must outnumber those that lose by two standard deviations,
# and be ten at least, so that a single vehicle does not become the world.
_VOTING = 5.0  # metres, side of a block
_VOTE_Z, _FEWEST_BETTER = 2.0, 10


def align(sweeps: HeightSlicedSweeps, draw: Callable[[Batch], HeightSlicedSweeps]) -> HeightSlicedSweeps:
    """Return the sweeps, drawn again by `draw` if we correct the ego motion of some of them.

    Cost: the registration of a few hundred pixels. With corrections, several times the cost of drawing.
    """
    for _ in range(_MOST_ROUNDS):
        motion = corrections(sweeps)
        if motion is None:
            break
        sweeps = draw(corrected(sweeps.batch, motion, sweeps.grid))
    return sweeps


def corrections(sweeps: HeightSlicedSweeps) -> RigidMotion | None:
    """Return the motion that brings each sweep from where the poses have it to where it matches t+1.

    The B S motions are those of the images of the batch (`Batch.image`). None = no sweep matches clearly better.
    """
    first = Gains.of(*_register(sweeps, _FEW, _FEW_ITERATIONS))
    is_likely = first.are_large().view(sweeps.batch.num_windows, -1).any(1)  # of each window
    if not bool(is_likely.any()):
        return None
    registration, motion = _register(sweeps, _MORE, _MORE_ITERATIONS)
    gains = Gains.of(registration, motion)
    is_clear = gains.are_large() & Votes.of(sweeps, registration, gains.of_voxel).agree()
    motion = motion.only(is_likely.repeat_interleave(sweeps.num_steps) & is_clear)
    return _alike_at_t(motion, sweeps.batch) if bool(motion.flow.any()) else None


def _alike_at_t(motion: RigidMotion, batch: Batch) -> RigidMotion:
    """Give sweep t of the windows of later sweeps (`Batch`) the motion that it has in those of earlier ones."""
    window = torch.arange(batch.num_windows, device=motion.flow.device)
    image = torch.arange(len(motion.flow), device=window.device).view(batch.num_windows, -1)
    image[:, 1] = (window % len(batch.rows)) * batch.num_steps + 1
    flow, rotation, centre = (values[image.view(-1)] for values in (motion.flow, motion.rotation, motion.centre))
    return RigidMotion(flow, rotation, centre)


class Gains(NamedTuple):
    """What the voxels of B S sweeps gain by a motion."""

    of_voxel: Tensor  # (K,) float64, see `Registration.gains`
    mean: Tensor  # (B S,) float64, of the voxels of each sweep; NaN without any
    z: Tensor  # (B S,) float64, their sum over the root of the sum of their squares

    @classmethod
    def of(cls, registration: Registration, motion: RigidMotion) -> Gains:
        """Compare a motion with none."""
        by_image = registration.source.by_object
        gain = registration.gains(motion, registration.source)
        total, square = by_image.sum(torch.stack((gain, gain.square())))
        return cls(gain, total / by_image.size(), total / square.sqrt())

    def are_large(self) -> Tensor:
        """Tell which sweeps gain enough, (B S,) bool."""
        return (self.mean >= _LEAST_GAIN) & (self.z >= _GAIN_Z)


class Votes(NamedTuple):
    """The blocks of 5 m of B S sweeps whose gain or loss exceeds its noise."""

    better: Tensor  # (B S,) int64, number of blocks that gain
    worse: Tensor  # (B S,) int64, number of blocks that lose

    @classmethod
    def of(cls, sweeps: HeightSlicedSweeps, registration: Registration, gain: Tensor) -> Votes:
        """Add up the gains of the K voxels of the source, (K,) float64, in the blocks of their sweeps."""
        source = registration.source
        side = sweeps.grid.whole_pixels(_VOTING)
        lattice = sweeps.grid.lattice(side)
        row, col = floor_divide(take_columns(registration.voxels.place[2:], source.voxel), side)
        count = source.by_object.count
        blocks = Groups(lattice.cell(source.by_object.of_item, row, col), count * lattice.area)
        total, square = blocks.sum(torch.stack((gain, gain.square()))).view(2, count, -1)
        noise = square.sqrt()
        return cls((total > noise).sum(1), (total < -noise).sum(1))

    def agree(self) -> Tensor:
        """Tell in which sweeps enough blocks gain, and most, (B S,) bool."""
        noise = (self.better + self.worse).double().sqrt()
        return (self.better - self.worse > _VOTE_Z * noise) & (self.better >= _FEWEST_BETTER)


def _register(sweeps: HeightSlicedSweeps, most: int, num_iterations: int) -> tuple[Registration, RigidMotion]:
    """Register every sweep with t+1, by about `most` pixels of structure. Sweeps t+1 stay."""
    voxels = Voxels.of(_structure(sweeps, most), sweeps)
    count = sweeps.batch.num_windows * sweeps.num_steps
    image = voxels.window * sweeps.num_steps + voxels.step
    by_image = Groups(torch.where(voxels.window < 0, count, image), count)
    origin = sweeps.elapsed.new_zeros((2, count))  # sweeps rotate about it
    # Each sweep has its own motion, so its age does not matter.
    registration = Registration(voxels, by_image, origin, torch.ones_like(sweeps.elapsed))
    return registration, registration.align(origin.t(), num_iterations)


def _structure(sweeps: HeightSlicedSweeps, most: int) -> ObjectPoints:
    """Return the points of some tall pixels. Their object is their window.

    Convention: if a window has n pixels of two or more slices in all sweeps but t+1, it takes every (n / `most`)-th
        block, along diagonal lines.
    """
    pixels = sweeps.pixels
    windows = Groups(pixels.window, sweeps.batch.num_windows)
    is_tall = count_slices(pixels.slices) >= _TALL
    every = (windows.where(is_tall & (pixels.step > 0)).size() // most).clamp(min=1)
    row, col = floor_divide(pixels.row_col, sweeps.grid.whole_pixels(_SAMPLED))
    is_taken = (5 * row + 3 * col) % windows.spread(every) == 0
    return points_of_pixels(sweeps, is_tall & is_taken, pixels.window)


def corrected(batch: Batch, motion: RigidMotion, grid: Grid) -> Batch:
    """Return a batch with other ego motion.

    Args:
        motion: of the B S images. Heights stay, and so do the ground and the directions of the coverage.
        grid: of the images. Points that leave it are not active.
    """
    positions = batch.positions.clone()
    for points, _, _ in batch.chunks:
        positions[:2, points] += motion.flow_at(batch.image[points].long(), positions[:2, points]).t()
    origin = batch.origin.clone().view(-1, 3)
    image = torch.arange(len(origin), device=origin.device)
    origin[:, :2] += motion.flow_at(image, origin[:, :2].t())

    of_t = slice(batch.rows[0].start, batch.rows[-1].stop)
    moved = (positions[:2, of_t] - batch.positions[:2, of_t]).t().float()
    with torch.inference_mode(False):  # because the pose flow becomes part of the results
        pose_flow = batch.pose_flow.clone()
        pose_flow[:, :2] += moved.nan_to_num(0.0)
    return replace(
        batch,
        positions=positions,
        is_active=batch.is_active & grid.contains(positions),
        origin=origin.view_as(batch.origin),
        pose_flow=pose_flow,
    )
