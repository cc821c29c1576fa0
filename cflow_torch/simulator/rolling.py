"""Rays of a LiDAR in a rolling sweep: every column has its own time, and the vehicle and bodies move meanwhile."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from cflow_torch.simulator.raycast import ELLIPSOID, Blocks, UnitRays, cosine_of_incidence, take

_ROUNDS = 2  # of refining which column meets a solid and where the solid is then; each divides the error by 6 or more


@dataclass(frozen=True)
class MovingSolids:
    """P solids during an interval of time. Coordinates are relative to `origin`, so that float32 resolves micrometres.

    Args:
        kind: (P,) int64.
        half_size: (P, 3) float64, metres.
        albedo, is_foliage: (P,) float32, (P,) bool, as in `Solids`.
        is_own: (P,) bool, part of the recording vehicle.
        origin: (3,) float64, world metres.
        knots: (K + 1,) float64 seconds, evenly spaced, K >= 1.
        static: (P, 3, 4) float64, world to solid; only valid for static solids.
        row: (P,) int64, index of each solid in the second dimension of `dynamic`, -1 = static.
        dynamic: (K + 1, M, 3, 4) float64, world to solid at the knots; elements are interpolated in between.
    """

    kind: Tensor
    half_size: Tensor
    albedo: Tensor
    is_foliage: Tensor
    is_own: Tensor
    origin: Tensor
    knots: Tensor
    static: Tensor
    row: Tensor
    dynamic: Tensor

    def at(self, solid: Tensor, seconds: Tensor) -> tuple[Tensor, Tensor]:
        """Return the transforms from the world to E solids, each at its own time, and their derivatives.

        Args:
            solid: (E,) int64.
            seconds: (E,) float64.

        Returns:
            (E, 3, 4) float64 transforms; (E, 3, 4) float64 derivatives, per second.
        """
        transform = self.static.index_select(0, solid)
        change = torch.zeros_like(transform)
        row = take(self.row, solid)
        chosen = (row >= 0).nonzero()[:, 0]
        if len(chosen):
            transform[chosen], change[chosen] = self.dynamic_at(take(row, chosen), take(seconds, chosen))
        return transform, change

    def dynamic_at(self, row: Tensor, seconds: Tensor) -> tuple[Tensor, Tensor]:
        """Return the transforms from the world to E moving solids, and their derivatives: (E, 3, 4) float64 each.

        `row` (E,) int64 has their indices in `dynamic`, `seconds` (E,) float64 their times.
        """
        step = float(self.knots[1] - self.knots[0])
        after = seconds - self.knots[0]
        first = (after / step).floor().long().clamp(0, len(self.knots) - 2)
        index = first * self.dynamic.shape[1] + row
        flat = self.dynamic.flatten(0, 1)
        begin = flat.index_select(0, index)
        slope = (flat.index_select(0, index + self.dynamic.shape[1]) - begin) / step
        return begin + (after - first * step)[:, None, None] * slope, slope

    @cached_property
    def radius(self) -> Tensor:
        """(P,) float64 radius of the bounding spheres, metres."""
        return torch.where(self.kind == ELLIPSOID, self.half_size.amax(1), self.half_size.norm(dim=1))

    @property
    def middle(self) -> Tensor:
        """() float64 seconds, midway between the first and the last knot."""
        return 0.5 * (self.knots[0] + self.knots[-1])

    @cached_property
    def centres(self) -> tuple[Tensor, Tensor]:
        """(P, 3) float64 centres of the solids at `middle`; (P,) upper bound of the speed of their points, m/s."""
        count = len(self.kind)
        transform, _ = self.at(torch.arange(count), self.middle.expand(count))
        centre = rotate(transform[:, :, :3].transpose(1, 2), -transform[:, :, 3])
        speed = torch.zeros(count, dtype=torch.float64)
        moving = (self.row >= 0).nonzero()[:, 0]
        arm = self.half_size[moving].norm(dim=1)
        for knot in self.knots[:-1]:  # the velocity differs between intervals, because legs swing
            _, change = self.dynamic_at(self.row[moving], knot.expand(len(moving)))
            at_centre = rotate(change[:, :, :3], centre[moving]) + change[:, :, 3]
            rotation = change[:, :, :3].flatten(1).norm(dim=1) * arm
            speed[moving] = torch.maximum(speed[moving], at_centre.norm(dim=1) + rotation)
        return centre, 1.1 * speed


@dataclass(frozen=True)
class Shots:
    """The shots of one LiDAR in one sweep: C columns of B shots.

    Args:
        azimuth: (C,) float64 radians, sensor frame, in the order of time, evenly spaced.
        seconds: (C,) float64, evenly spaced.
        T_world_sensor: (C, 4, 4) float64, relative to the `origin` of the solids.
        elevation: (B,) float64 radians, ascending.
        speed: (2,) upper bounds of the LiDAR's motion, m/s and rad/s.
    """

    azimuth: Tensor
    seconds: Tensor
    T_world_sensor: Tensor
    elevation: Tensor
    speed: tuple[float, float]

    @property
    def directions(self) -> tuple[Tensor, Tensor]:
        """`level` and `up`, (3, C, 1) float32, world axes. Directions: level * cos(elevation) + up * sin(elevation)."""
        R = self.T_world_sensor[:, :3, :3]
        level = R[:, :, 0] * self.azimuth.cos()[:, None] + R[:, :, 1] * self.azimuth.sin()[:, None]
        return level.T.float()[..., None], R[:, :, 2].T.float()[..., None]


def covered_blocks(solids: MovingSolids, shots: Shots, max_range: float) -> Blocks:
    """Find the blocks of all rays that can meet a solid's bounding box (for an ellipsoid, its bounding sphere).

    Convention: a solid at the azimuth where the sweep begins and ends has a block at either end of the image.
    """
    num_columns = len(shots.azimuth)
    step = float(shots.azimuth[1] - shots.azimuth[0])
    interval = float(shots.seconds[1] - shots.seconds[0])
    revolution = 2 * math.pi / abs(step)
    # `travel`: radius of a sphere around the mid-sweep centre of a solid, which holds the solid during the sweep.
    middle = num_columns // 2
    centre, speed = solids.centres
    late = abs(float(shots.seconds[middle] - solids.middle)) + 0.5 * interval * num_columns
    travel = solids.radius + late * (speed + shots.speed[0])
    offset = centre - shots.T_world_sensor[middle, :3, 3]
    distance = offset.norm(dim=1)
    near = (distance - travel < max_range).nonzero()[:, 0]
    distance, travel = distance[near].clamp(min=1e-6), travel[near]
    x, y, z = (offset[near] @ shots.T_world_sensor[middle, :3, :3]).T
    rho = torch.hypot(x, y)
    slack = (travel / distance).clamp(max=1).asin() + late * shots.speed[1]
    height = torch.atan2(z, rho)
    is_seen = (height + slack > shots.elevation[0]) & (height - slack < shots.elevation[-1])
    column = ((torch.atan2(y, x) - shots.azimuth[0]) / step) % revolution
    # Near the sensor's axis, the azimuth of a solid is not reliable.
    slack = torch.where(rho < 2 * travel, math.pi, 2 * slack).clamp(max=math.pi) / abs(step)
    solid, guess = [], []
    for shift in (-revolution, 0, revolution):
        shifted = column + shift
        chosen = (is_seen & (shifted + slack >= 0) & (shifted - slack < num_columns)).nonzero()[:, 0]
        solid.append(near[chosen])
        guess.append(shifted[chosen])
    return _blocks_near(solids, shots, torch.cat(solid), torch.cat(guess), speed, max_range)


def _blocks_near(
    solids: MovingSolids, shots: Shots, solid: Tensor, guess: Tensor, speed: Tensor, max_range: float
) -> Blocks:
    """One block for each `solid` (E,), which the unit meets near column `guess` (E,)."""
    num_columns = len(shots.azimuth)
    step = float(shots.azimuth[1] - shots.azimuth[0])
    interval = float(shots.seconds[1] - shots.seconds[0])
    num_around = 2 * math.pi / abs(step)
    half = solids.half_size[solid]
    for _ in range(_ROUNDS):
        column = guess.round().long().clamp(0, num_columns - 1)
        T_world_sensor = shots.T_world_sensor.index_select(0, column)
        to_solid, _ = solids.at(solid, take(shots.seconds, column))
        rotation = to_solid[:, :, :3] @ T_world_sensor[:, :3, :3]  # sensor axes to the solid's
        origin = rotate(to_solid[:, :, :3], T_world_sensor[:, :3, 3]) + to_solid[..., 3]  # of the sensor
        centre = rotate(rotation.transpose(1, 2), -origin)
        azimuth = torch.atan2(centre[:, 1], centre[:, 0])
        expected = shots.azimuth[0] + step * guess
        guess = guess + torch.remainder((azimuth - expected) / step + 0.5 * num_around, num_around) - 0.5 * num_around

    rho = torch.hypot(centre[:, 0], centre[:, 1])
    spread = half.amax(1)  # horizontal radius of an ellipsoid's bounding sphere; corrected below for the rest
    low, high, side = centre[:, 2] - spread, centre[:, 2] + spread, (spread / rho.clamp(min=1e-6)).clamp(max=1).asin()
    side = torch.stack([-side, side])
    cornered = (solids.kind[solid] != ELLIPSOID).nonzero()[:, 0]
    if len(cornered):
        signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3)
        reach = (signs * half[cornered, None]) @ rotation[cornered]
        x, y, z = (reach + centre[cornered, None]).unbind(-1)  # (E', 8) each, sensor frame
        spread[cornered] = torch.hypot(reach[..., 0], reach[..., 1]).amax(1)
        low[cornered], high[cornered] = z.amin(1), z.amax(1)
        cos, sin = (centre[cornered, k, None] / rho[cornered, None].clamp(min=1e-6) for k in (0, 1))
        corner_side = torch.atan2(y * cos - x * sin, x * cos + y * sin)
        side[:, cornered] = torch.stack([corner_side.amin(1), corner_side.amax(1)])

    # While the unit scans its block, a solid moves by at most `drift` from its position in the middle of the block.
    width = (side[1] - side[0]).clamp(max=2 * math.pi)
    relative = speed[solid] + shots.speed[0] + shots.speed[1] * centre.norm(dim=1)
    drift = relative * interval * (0.6 * width / abs(step) + 2)
    nearest, farthest = (rho - spread - drift).clamp(min=1e-6), rho + spread + drift
    margin = (drift / (rho - spread).clamp(min=1e-6)).clamp(max=1).asin() + 1e-6
    around = (rho - spread <= 2 * drift) | (width + 2 * margin > math.pi)
    # Columns count along `step`, which may be negative.
    side = side if step > 0 else -side.flip(0)
    first = (guess + (side[0] - margin) / abs(step)).ceil().long()
    end = (guess + (side[1] + margin) / abs(step)).floor().long() + 1
    first = torch.where(around, 0, first).clamp(0, num_columns)
    end = torch.where(around, num_columns, end).clamp(0, num_columns)
    count = (end - first).clamp(min=0).masked_fill(nearest > max_range, 0)

    # The block of a solid around the sensor's axis has all columns, so its motion during the whole sweep counts.
    whole = torch.where(around, relative * interval * num_columns, drift)
    nearest = torch.where(around, 1e-6, nearest)
    bottom, top = low - whole, high + whole
    lowest = torch.atan2(bottom, torch.where(bottom < 0, nearest, farthest)) - 1e-6
    highest = torch.atan2(top, torch.where(top > 0, nearest, farthest)) + 1e-6
    first_beam = torch.searchsorted(shots.elevation, lowest)
    end_beam = torch.searchsorted(shots.elevation, highest, right=True)
    return Blocks(solid, first, count, first_beam, torch.maximum(first_beam, end_beam))


class RollingRays:
    """The callable `rays_at` of `raycast.nearest_hits`: rays of a column in unit coordinates of the block's solid."""

    def __init__(self, solids: MovingSolids, shots: Shots, blocks: Blocks) -> None:
        middle = blocks.first_column + blocks.num_columns // 2
        seconds = shots.seconds[middle.clamp(0, len(shots.seconds) - 1)]
        to_solid, change = solids.at(blocks.solid, seconds)
        half = solids.half_size[blocks.solid][..., None]
        # Within a block, the velocity is constant: it takes milliseconds to scan most blocks.
        self._to_unit = (to_solid / half).flatten(1).T.float().contiguous()  # (12, E)
        self._change = (change / half).flatten(1).T.float().contiguous()
        self._moves = solids.row[blocks.solid] >= 0
        self._kind = solids.kind[blocks.solid]
        self._inverse_half = solids.half_size[blocks.solid].reciprocal().T.float().contiguous()
        self._cos_elevation, self._sin_elevation = shots.elevation.cos().float(), shots.elevation.sin().float()
        self._seconds, self._block_seconds = shots.seconds, seconds
        level, up = shots.directions
        self._columns = torch.cat([shots.T_world_sensor[:, :3, 3].T.float(), level[..., 0], up[..., 0]])  # (9, C)

    def __call__(self, block: Tensor, column: Tensor) -> UnitRays:
        matrix = take(self._to_unit, block)
        moving = take(self._moves, block).nonzero()[:, 0]
        if len(moving):
            of_moving = take(block, moving)
            lag = (take(self._seconds, take(column, moving)) - take(self._block_seconds, of_moving)).float()
            matrix.index_add_(1, moving, take(self._change, of_moving) * lag)
        matrix = matrix.view(3, 4, -1)
        columns = take(self._columns, column).view(3, 3, -1)  # origin, level, up
        origin, level, up = (
            matrix[:, 0] * column[0] + matrix[:, 1] * column[1] + matrix[:, 2] * column[2] for column in columns
        )
        return UnitRays(origin + matrix[:, 3], level, up)

    def incidence(self, block: Tensor, column: Tensor, beam: Tensor, distance: Tensor) -> Tensor:
        """Cosine of the angle between rays and the normals of the surfaces that they hit.

        Args:
            block, column, beam: (N,) int64: block of the solid that was hit, column and beam of the ray.
            distance: (N,) float32 range of the hit, metres.

        Returns:
            (N,) float32 in [0, 1].
        """
        rays, inverse_half = self(block, column), take(self._inverse_half, block)
        direction = rays.level * take(self._cos_elevation, beam) + rays.up * take(self._sin_elevation, beam)
        at = rays.origin + direction * distance
        return cosine_of_incidence(take(self._kind, block), at, direction / inverse_half, inverse_half)


def rotate(matrices: Tensor, vectors: Tensor) -> Tensor:
    """Multiply each matrix (E, 3, 3) by its vector (E, 3)."""
    return (matrices @ vectors[..., None])[..., 0]
