"""Ray casting: every ray of a range image against every solid of the scene, without a Python loop over either.

A solid is an affine image of the unit cube, the unit cylinder or the unit ball. Seen from the sensor it covers a block
of columns (azimuth) and beams (elevation) of the range image; only the rays of that block are tested against it.
Occlusion falls out: the nearest hit of a ray wins.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Tuple

import torch
from torch import Tensor

BOX, CYLINDER, ELLIPSOID = 0, 1, 2  # unit solids: |x|, |y|, |z| <= 1; x^2 + y^2 <= 1, |z| <= 1; x^2 + y^2 + z^2 <= 1

_MAX_CANDIDATES = 1 << 15  # (ray, solid) tests at once: a few MB, which stay in the cache
_NO_HIT = torch.iinfo(torch.int64).max


@dataclass(frozen=True)
class Solids:
    """P solids.

    Args:
        kind: (P,) int64, BOX, CYLINDER or ELLIPSOID.
        pose: (P, 4, 4) float64, solid to world.
        half_size: (P, 3) float64, metres: the unit solid is scaled by it.
        albedo: (P,) float32 in (0, 1], share of the light that comes back.
        is_foliage: (P,) bool.
    """

    kind: Tensor
    pose: Tensor
    half_size: Tensor
    albedo: Tensor
    is_foliage: Tensor


def ray_directions(azimuth: Tensor, elevation: Tensor) -> Tensor:
    """Unit vectors of a range image, sensor frame: (3, C * B), ray number column * B + beam."""
    horizontal, vertical = elevation.cos(), elevation.sin()
    x = azimuth.cos()[:, None] * horizontal
    y = azimuth.sin()[:, None] * horizontal
    return torch.stack([x, y, vertical.expand_as(x)]).flatten(1)


def cast_solids(
    kind: Tensor,
    T_solid_sensor: Tensor,
    half_size: Tensor,
    azimuth: Tensor,
    elevation: Tensor,
    max_range: float,
    max_candidates: int = _MAX_CANDIDATES,
) -> Tuple[Tensor, Tensor]:
    """Nearest solid along every ray of a range image.

    Args:
        kind: (P,) int64.
        T_solid_sensor: (P, 4, 4) float64, rigid, sensor coordinates to the solid's.
        half_size: (P, 3) float64, metres.
        azimuth: (C,) float64 radians, evenly spaced over one full turn, ascending.
        elevation: (B,) float64 radians, ascending.
        max_range: solids that begin beyond it may be skipped, metres.
        max_candidates: (ray, solid) pairs that are tested at once; bounds the memory.

    Returns:
        (C * B,) float32 range in metres, inf = no hit; (C * B,) int64 solid, -1 = no hit. Ray number column * B + beam.

    Convention: the sensor does not stand inside a solid (such a solid is not hit); equal ranges: the lower number wins.

    Cost: time and memory grow with the sum, over the solids, of the rays in the block that each one covers.
    """
    num_beams = len(elevation)
    best = torch.full((len(azimuth) * num_beams,), _NO_HIT, device=azimuth.device)
    first_column, num_columns, first_beam, end_beam = _covered_block(
        T_solid_sensor, half_size, azimuth, elevation, max_range
    )
    # Rays in unit coordinates of the solid: origin o, direction d = u(azimuth) cos(elevation) + w sin(elevation).
    to_unit = T_solid_sensor[:, :3] / half_size[:, :, None]
    origin, matrix = to_unit[..., 3].T.float(), to_unit[..., :3].permute(1, 2, 0).float()  # (3, P), (3, 3, P)
    cos_azimuth, sin_azimuth = azimuth.cos().float(), azimuth.sin().float()
    cos_elevation, sin_elevation = elevation.cos().float(), elevation.sin().float()

    size = num_columns * (end_beam - first_beam)
    for this_kind, intersect in ((BOX, _hit_cube), (CYLINDER, _hit_cylinder), (ELLIPSOID, _hit_ball)):
        visible = ((kind == this_kind) & (size > 0)).nonzero()[:, 0]
        chunk = (size[visible].cumsum(0) - 1) // max_candidates
        for solids in visible.split(chunk.unique_consecutive(return_counts=True)[1].tolist()) if len(visible) else ():
            # (solid, column) pairs, then (solid, column, beam) candidates.
            pair, offset = _expand(_take(num_columns, solids))
            owner = _take(solids, pair)
            column = (_take(first_column, owner) + offset) % len(azimuth)
            sideways = _take(matrix[:, 0], owner) * _take(cos_azimuth, column)
            sideways += _take(matrix[:, 1], owner) * _take(sin_azimuth, column)
            pair, offset = _expand(_take(end_beam - first_beam, owner))
            owner, column = _take(owner, pair), _take(column, pair)
            beam = _take(first_beam, owner) + offset
            direction = _take(sideways, pair) * _take(cos_elevation, beam)
            direction += _take(matrix[:, 2], owner) * _take(sin_elevation, beam)
            t = intersect(_take(origin, owner), direction)
            # Range (positive floats sort like their bits) and solid in one integer: one exact, order-free minimum.
            key = (t.view(torch.int32).long() << 32) | owner
            hit = (t < torch.inf).nonzero()[:, 0]
            best.scatter_reduce_(0, _take(column * num_beams + beam, hit), _take(key, hit), "amin")
    missed = best == _NO_HIT
    distance = (best >> 32).to(torch.int32).view(torch.float32).masked_fill(missed, torch.inf)
    return distance, (best & 0xFFFFFFFF).masked_fill(missed, -1)


def _expand(counts: Tensor) -> Tuple[Tensor, Tensor]:
    """Row i repeated counts[i] times: the row numbers, and 0 ... counts[i] - 1 within each row."""
    row = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
    return row, torch.arange(len(row), device=counts.device) - _take(counts.cumsum(0) - counts, row)


def _take(values: Tensor, index: Tensor) -> Tensor:
    """values[..., index]; `index_select` is several times faster than indexing on a CPU."""
    return values.index_select(-1, index)


def _covered_block(
    T_solid_sensor: Tensor, half_size: Tensor, azimuth: Tensor, elevation: Tensor, max_range: float
) -> Tuple[Tensor, Tensor, Tensor, Tensor]:
    """Columns [first, first + number) and beams [first, end) outside which no ray can meet the solid's bounding box."""
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64, device=azimuth.device)] * 3)
    corners = signs * half_size[:, None] - T_solid_sensor[:, None, :3, 3]
    x, y, z = (corners @ T_solid_sensor[:, :3, :3]).unbind(-1)  # (P, 8) each, sensor frame
    rho = torch.hypot(x, y)
    middle_x, middle_y = x.mean(1, keepdim=True), y.mean(1, keepdim=True)
    nearest = torch.hypot(middle_x, middle_y) - torch.hypot(x - middle_x, y - middle_y).amax(1, keepdim=True)
    nearest, farthest = nearest.clamp(min=1e-6)[:, 0], rho.amax(1)

    middle = torch.atan2(middle_y, middle_x)[:, 0]
    cos, sin = middle.cos()[:, None], middle.sin()[:, None]
    side = torch.atan2(y * cos - x * sin, x * cos + y * sin)
    step = 2 * math.pi / len(azimuth)
    low, high = (((middle + s - azimuth[0]) / step) for s in (side.amin(1), side.amax(1)))
    first_column = (low - 1e-6).ceil().long()
    num_columns = (high + 1e-6).floor().long() - first_column + 1
    # Corners spread over half a turn or more: the sensor's axis passes through the solid, all columns see it.
    around = (high - low) * step > math.pi - 1e-6
    num_columns = torch.where(around, len(azimuth), num_columns).clamp(0, len(azimuth))
    num_columns = num_columns.masked_fill(nearest > max_range, 0)

    bottom, top = z.amin(1), z.amax(1)
    lowest = torch.atan2(bottom, torch.where(bottom < 0, nearest, farthest)) - 1e-6
    highest = torch.atan2(top, torch.where(top > 0, nearest, farthest)) + 1e-6
    first_beam = torch.searchsorted(elevation, lowest)
    end_beam = torch.searchsorted(elevation, highest, right=True)
    return first_column, num_columns, first_beam, torch.maximum(first_beam, end_beam)


def _hit_cube(origin: Tensor, direction: Tensor) -> Tensor:
    """(M,) range at which rays (3, M) enter the cube |x|, |y|, |z| <= 1, inf = never."""
    inverse = direction.reciprocal()
    centre, half = -origin * inverse, inverse.abs()
    enter, leave = (centre - half).amax(0), (centre + half).amin(0)
    return torch.where((enter <= leave) & (enter > 0), enter, torch.inf)


def _hit_cylinder(origin: Tensor, direction: Tensor) -> Tensor:
    """(M,) range at which rays (3, M) enter the cylinder x^2 + y^2 <= 1, |z| <= 1, inf = never."""
    enter, leave = _chord(origin[:2], direction[:2])
    inverse = direction[2].reciprocal()
    centre, half = -origin[2] * inverse, inverse.abs()
    enter, leave = torch.maximum(enter, centre - half), torch.minimum(leave, centre + half)
    return torch.where((enter <= leave) & (enter > 0), enter, torch.inf)


def _hit_ball(origin: Tensor, direction: Tensor) -> Tensor:
    """(M,) range at which rays (3, M) enter the unit ball, inf = never."""
    enter, _ = _chord(origin, direction)
    return torch.where(enter > 0, enter, torch.inf)


def _chord(origin: Tensor, direction: Tensor) -> Tuple[Tensor, Tensor]:
    """Ranges at which rays enter and leave |x| <= 1 (circle or ball); NaN where they pass by."""
    a = (direction * direction).sum(0)
    to_nearest = -(origin * direction).sum(0) / a
    # Via the nearest point, not the discriminant: exact in float32 even for a small ball far away.
    nearest = origin + to_nearest * direction
    half = ((1 - (nearest * nearest).sum(0)) / a).sqrt()
    return to_nearest - half, to_nearest + half


def incidence(solids: Solids, T_solid_sensor: Tensor, solid: Tensor, rays: Tensor, distance: Tensor) -> Tensor:
    """Cosine of the angle between rays and the normals of what they hit.

    Args:
        T_solid_sensor: (P, 4, 4) float64, sensor coordinates to the solid's.
        solid: (N,) int64, what was hit.
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
    kind = solids.kind[solid]
    magnitude = at.abs()
    face = (magnitude == magnitude.amax(0)) * at  # normal of the cube
    is_cap = magnitude[2] * magnitude[2] > at[0] * at[0] + at[1] * at[1]
    sideways = torch.stack([~is_cap, ~is_cap, is_cap]) * at
    normal = torch.where(kind == BOX, face, torch.where(kind == CYLINDER, sideways, at)) * inverse_half
    return (normal * direction).sum(0).abs() / (normal * normal).sum(0).clamp(min=1e-12).sqrt()
