"""Ray casting: intersect all rays of a range image with all solids of a scene, without a Python loop over either.

A solid is an affine image of a *unit solid*: a cube, cylinder or ball. Its *unit coordinates* are those in which it is
the unit solid. Seen from the sensor, a solid covers a block of columns (azimuth) and beams (elevation) of the range
image. We test only the rays of this block. Of the hits of a ray, the nearest counts, so solids occlude each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Callable, NamedTuple

import torch
from torch import Tensor

BOX, CYLINDER, ELLIPSOID = 0, 1, 2  # |x|, |y|, |z| <= 1; x^2 + y^2 <= 1, |z| <= 1; x^2 + y^2 + z^2 <= 1

_MAX_CANDIDATES = 1 << 15  # (ray, solid) tests at once; their few MB stay in the cache of the CPU
_NO_HIT = torch.iinfo(torch.int64).max


@dataclass(frozen=True)
class Solids:
    """P solids.

    Args:
        kind: (P,) int64, BOX, CYLINDER or ELLIPSOID.
        pose: (P, 4, 4) float64, solid to world.
        half_size: (P, 3) float64, metres, by which the axes of the unit solid are scaled.
        albedo: (P,) float32 in (0, 1], share of the light that is reflected.
        is_foliage: (P,) bool.
        is_own: (P,) bool, part of the recording vehicle.
    """

    kind: Tensor
    pose: Tensor
    half_size: Tensor
    albedo: Tensor
    is_foliage: Tensor
    is_own: Tensor


class RayBlocks(NamedTuple):
    """E blocks of a range image. Each holds all rays that can meet one solid; a solid may have several blocks.

    Args:
        solid: (E,) int64.
        first_column, num_columns: (E,) int64, columns [first, first + number), modulo the width of the image.
        first_beam, end_beam: (E,) int64, beams [first, end).
    """

    solid: Tensor
    first_column: Tensor
    num_columns: Tensor
    first_beam: Tensor
    end_beam: Tensor

    def at(self, index: Tensor) -> RayBlocks:
        """Select blocks by their positions in the list, (K,) int64."""
        return RayBlocks(*(values[index] for values in self))


class UnitRays(NamedTuple):
    """M columns of rays, each in unit coordinates of a solid. All fields are (3, M) float32.

    The direction of a ray is level * cos(elevation) + up * sin(elevation)."""

    origin: Tensor
    level: Tensor
    up: Tensor


def ray_directions(azimuth: Tensor, elevation: Tensor) -> Tensor:
    """Unit vectors of a range image, sensor frame: (3, C * B), ray index column * B + beam."""
    horizontal = elevation.cos()
    vertical = elevation.sin()
    x = azimuth.cos()[:, None] * horizontal
    y = azimuth.sin()[:, None] * horizontal
    return torch.stack([x, y, vertical.expand_as(x)]).flatten(1)


def nearest_hits(
    kind: Tensor,
    blocks: RayBlocks,
    rays_at: Callable[[Tensor, Tensor], UnitRays],
    num_columns: int,
    elevation: Tensor,
) -> tuple[Tensor, Tensor]:
    """Find the nearest solid along every ray of a range image, given the blocks of rays that may meet each solid.

    Args:
        kind: (P,) int64.
        blocks: E blocks.
        rays_at: maps (M,) blocks and (M,) columns to the rays of each column in unit coordinates of the block's solid.
        num_columns: C, columns of the range image.
        elevation: (B,) float64 radians, ascending.

    Returns:
        (C * B,) float32 range in metres, inf = no hit; (C * B,) int64 block of the solid that was hit, -1 = no hit. Ray
        index column * B + beam. At equal range, the first block counts.
    """
    best = torch.full((num_columns * len(elevation),), _NO_HIT, device=elevation.device)
    sweep = _Rays(rays_at, num_columns, elevation.cos().float(), elevation.sin().float())
    size = blocks.num_columns * (blocks.end_beam - blocks.first_beam)
    kind_of_block = kind[blocks.solid]
    for this_kind, intersect in ((BOX, _hit_cube), (CYLINDER, _hit_cylinder), (ELLIPSOID, _hit_ball)):
        visible = ((kind_of_block == this_kind) & (size > 0)).nonzero()[:, 0]
        if len(visible):
            chunk = (size[visible].cumsum(0) - 1) // _MAX_CANDIDATES
            for chosen in visible.split(chunk.unique_consecutive(return_counts=True)[1].tolist()):
                ray, key = _hits(blocks, chosen, sweep, intersect)
                best.scatter_reduce_(0, ray, key, "amin")
    missed = best == _NO_HIT
    distance = (best >> 32).to(torch.int32).view(torch.float32).masked_fill(missed, torch.inf)
    return distance, (best & 0xFFFFFFFF).masked_fill(missed, -1)


class _Rays(NamedTuple):
    """The rays of a range image."""

    rays_at: Callable[[Tensor, Tensor], UnitRays]
    num_columns: int
    cos_elevation: Tensor  # (B,) float32
    sin_elevation: Tensor  # (B,) float32


def _hits(
    blocks: RayBlocks, chosen: Tensor, rays: _Rays, intersect: Callable[[Tensor, Tensor], Tensor]
) -> tuple[Tensor, Tensor]:
    """Test all rays of the chosen blocks, whose solids are of one kind.

    Returns:
        (N,) int64 index of the ray of each hit, and (N,) int64 key of the hit:

        bits  0 ... 31   32 ... 63
              block      range as float32

        Range and block form one integer, so the minimum is exact in any order: positive floats sort by bits.
    """
    # (block, column) pairs, then (block, column, beam) candidates.
    pair, offset = _expand(take(blocks.num_columns, chosen))
    block = take(chosen, pair)
    column = (take(blocks.first_column, block) + offset) % rays.num_columns
    of_pair = rays.rays_at(block, column)
    candidate, offset = _expand(take(blocks.end_beam - blocks.first_beam, block))
    beam = take(blocks.first_beam, take(block, candidate)) + offset
    direction = take(of_pair.level, candidate) * take(rays.cos_elevation, beam)
    direction += take(of_pair.up, candidate) * take(rays.sin_elevation, beam)
    distance = intersect(take(of_pair.origin, candidate), direction)
    hit = (distance < torch.inf).nonzero()[:, 0]
    pair_of_hit = take(candidate, hit)
    ray = take(column * len(rays.cos_elevation), pair_of_hit) + take(beam, hit)
    return ray, (take(distance, hit).view(torch.int32).long() << 32) | take(block, pair_of_hit)


def _expand(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Repeat each row i counts[i] times. Return the row of each copy, and its number 0 ... counts[i] - 1."""
    row = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
    return row, torch.arange(len(row), device=counts.device) - take(counts.cumsum(0) - counts, row)


def take(values: Tensor, index: Tensor) -> Tensor:
    """values[..., index], but several times faster on a CPU."""
    return values.index_select(-1, index)


def covered_beams(
    bottom: Tensor, top: Tensor, nearest: Tensor, farthest: Tensor, elevation: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the first beam that can meet each solid, and the one after the last, (E,) int64 each.

    Args:
        bottom, top: (E,) float64, heights of the solids in the sensor frame, metres.
        nearest, farthest: (E,) float64, bounds of the horizontal distance of their points, metres.
        elevation: (B,) float64 radians, of the beams, ascending.
    """
    lowest = torch.atan2(bottom, torch.where(bottom < 0, nearest, farthest)) - 1e-6
    highest = torch.atan2(top, torch.where(top > 0, nearest, farthest)) + 1e-6
    first = torch.searchsorted(elevation, lowest)
    end = torch.searchsorted(elevation, highest, right=True)
    return first, torch.maximum(first, end)


def _hit_cube(origin: Tensor, direction: Tensor) -> Tensor:
    """(M,) range at which rays (3, M) enter the cube |x|, |y|, |z| <= 1, inf = no hit."""
    inverse = direction.reciprocal()
    centre = -origin * inverse
    half = inverse.abs()
    enter = (centre - half).amax(0)
    leave = (centre + half).amin(0)
    return torch.where((enter <= leave) & (enter > 0), enter, torch.inf)


def _hit_cylinder(origin: Tensor, direction: Tensor) -> Tensor:
    """(M,) range at which rays (3, M) enter the cylinder x^2 + y^2 <= 1, |z| <= 1, inf = no hit."""
    enter, leave = _chord(origin[:2], direction[:2])
    inverse = direction[2].reciprocal()
    centre = -origin[2] * inverse
    half = inverse.abs()
    enter = torch.maximum(enter, centre - half)
    leave = torch.minimum(leave, centre + half)
    return torch.where((enter <= leave) & (enter > 0), enter, torch.inf)


def _hit_ball(origin: Tensor, direction: Tensor) -> Tensor:
    """(M,) range at which rays (3, M) enter the unit ball, inf = no hit."""
    enter, _ = _chord(origin, direction)
    return torch.where(enter > 0, enter, torch.inf)


def _chord(origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Ranges at which rays enter and leave the unit circle or ball; NaN if they miss it."""
    a = (direction * direction).sum(0)
    to_nearest = -(origin * direction).sum(0) / a
    # Even for a small ball far away, the nearest point is accurate in float32. The discriminant is not.
    nearest = origin + to_nearest * direction
    half = ((1 - (nearest * nearest).sum(0)) / a).sqrt()
    return to_nearest - half, to_nearest + half


def incidence(solids: Solids, T_solid_sensor: Tensor, solid: Tensor, rays: Tensor, distance: Tensor) -> Tensor:
    """Cosine of the angle between rays and the normals of the surfaces that they hit.

    Args:
        T_solid_sensor: (P, 4, 4) float64, from the sensor frame to the frame of each solid.
        solid: (N,) int64, the solid that was hit.
        rays: (3, N) float32 unit vectors, sensor frame.
        distance: (N,) float32 range of the hit, metres.

    Returns:
        (N,) float32 in [0, 1].
    """
    per_solid = torch.cat([T_solid_sensor[:, :3].transpose(1, 2).flatten(1), solids.half_size.reciprocal()], 1)
    columns = per_solid.float().T.contiguous().index_select(1, solid).view(5, 3, -1)  # x, y, z axes, origin, 1 / half
    inverse_half = columns[4]
    direction = columns[0] * rays[0] + columns[1] * rays[1] + columns[2] * rays[2]
    at = (direction * distance + columns[3]) * inverse_half  # on the unit solid
    return cosine_of_incidence(solids.kind[solid], at, direction, inverse_half)


def cosine_of_incidence(kind: Tensor, at: Tensor, direction: Tensor, inverse_half: Tensor) -> Tensor:
    """Cosine of the angle between rays and the normals of the solids that they hit.

    Args:
        kind: (N,) int64, kind of the solid that was hit.
        at: (3, N) float32, the point that was hit, in unit coordinates of the solid.
        direction: (3, N) float32 unit vectors, axes of the solid.
        inverse_half: (3, N) float32, 1 / half size of the solid.

    Returns:
        (N,) float32 in [0, 1].
    """
    magnitude = at.abs()
    face = (magnitude == magnitude.amax(0)) * at  # normal of the cube
    is_cap = magnitude[2] * magnitude[2] > at[0] * at[0] + at[1] * at[1]
    side_or_cap = torch.stack([~is_cap, ~is_cap, is_cap]) * at
    normal = torch.where(kind == BOX, face, torch.where(kind == CYLINDER, side_or_cap, at)) * inverse_half
    return (normal * direction).sum(0).abs() / (normal * normal).sum(0).clamp(min=1e-12).sqrt()
