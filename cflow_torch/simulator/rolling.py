"""Rays of a LiDAR in a rolling sweep: every column has its own time, and the vehicle and bodies move meanwhile."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from cflow_torch.simulator.raycast import ELLIPSOID, RayBlocks, UnitRays, cosine_of_incidence, covered_beams, take

_ROUNDS = 2  # of refining which column meets a solid and where the solid is then; each divides the error by 6 or more


class MovingTransforms(NamedTuple):
    """The transforms from the world to E solids, each at its own time."""

    to_solid: Tensor  # (E, 3, 4) float64
    change: Tensor  # (E, 3, 4) float64, derivatives, per second


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

    @classmethod
    def standing(cls, kind: Tensor, to_solid: Tensor, half_size: Tensor) -> MovingSolids:
        """Make solids that do not move, from their transforms (P, 3, 4), world to solid."""
        none = torch.zeros(len(kind))
        origin = torch.zeros(3, dtype=torch.float64)
        dynamic = to_solid.new_zeros((2, 0, 3, 4))
        return cls(kind, half_size, none, none > 0, none > 0, origin, origin[:2], to_solid, none.long() - 1, dynamic)

    def at(self, solid: Tensor, seconds: Tensor) -> MovingTransforms:
        """Return the transforms of E solids, (E,) int64, each at its own time, (E,) float64 seconds."""
        to_solid = self.static.index_select(0, solid)
        change = torch.zeros_like(to_solid)
        row = take(self.row, solid)
        chosen = (row >= 0).nonzero()[:, 0]
        if len(chosen):
            to_solid[chosen], change[chosen] = self.dynamic_at(take(row, chosen), take(seconds, chosen))
        return MovingTransforms(to_solid, change)

    def dynamic_at(self, row: Tensor, seconds: Tensor) -> MovingTransforms:
        """Return the transforms of E moving solids.

        `row` (E,) int64 has their indices in `dynamic`, `seconds` (E,) float64 their times.
        """
        step = float(self.knots[1] - self.knots[0])
        after = seconds - self.knots[0]
        first = (after / step).floor().long().clamp(0, len(self.knots) - 2)
        index = first * self.dynamic.shape[1] + row
        flat = self.dynamic.flatten(0, 1)
        begin = flat.index_select(0, index)
        slope = (flat.index_select(0, index + self.dynamic.shape[1]) - begin) / step
        return MovingTransforms(begin + (after - first * step)[:, None, None] * slope, slope)

    @cached_property
    def radius(self) -> Tensor:
        """(P,) float64 radius of the bounding spheres, metres."""
        return torch.where(self.kind == ELLIPSOID, self.half_size.amax(1), self.half_size.norm(dim=1))

    @property
    def middle(self) -> Tensor:
        """() float64 seconds, midway between the first and the last knot."""
        return 0.5 * (self.knots[0] + self.knots[-1])

    @cached_property
    def centre(self) -> Tensor:
        """(P, 3) float64 centres of the solids at `middle`."""
        count = len(self.kind)
        to_solid = self.at(torch.arange(count), self.middle.expand(count)).to_solid
        return rotate_each(to_solid[:, :, :3].transpose(1, 2), -to_solid[:, :, 3])

    @cached_property
    def speed(self) -> Tensor:
        """(P,) float64 upper bound of the speed of the points of the solids, m/s."""
        speed = torch.zeros(len(self.kind), dtype=torch.float64)
        moving = (self.row >= 0).nonzero()[:, 0]
        arm = self.half_size[moving].norm(dim=1)
        for knot in self.knots[:-1]:  # the velocity differs between intervals, because legs swing
            change = self.dynamic_at(self.row[moving], knot.expand(len(moving))).change
            at_centre = rotate_each(change[:, :, :3], self.centre[moving]) + change[:, :, 3]
            rotation = change[:, :, :3].flatten(1).norm(dim=1) * arm
            speed[moving] = torch.maximum(speed[moving], at_centre.norm(dim=1) + rotation)
        return 1.1 * speed


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

    @classmethod
    def at_once(cls, azimuth: Tensor, elevation: Tensor) -> Shots:
        """Make shots of a LiDAR at the origin of the world, all at the same time."""
        pose = torch.eye(4, dtype=torch.float64).expand(len(azimuth), 4, 4)
        return cls(azimuth, torch.zeros_like(azimuth), pose, elevation, (0.0, 0.0))

    @property
    def step(self) -> float:
        """Radians from column to column; negative if the LiDAR turns clockwise."""
        return float(self.azimuth[1] - self.azimuth[0])

    @property
    def interval(self) -> float:
        """Seconds from column to column."""
        return float(self.seconds[1] - self.seconds[0])

    @property
    def revolution(self) -> float:
        """Number of columns in a full turn."""
        return 2 * math.pi / abs(self.step)

    @property
    def middle(self) -> int:
        """Index of the column in the middle of the sweep."""
        return len(self.azimuth) // 2

    @property
    def directions(self) -> tuple[Tensor, Tensor]:
        """`level` and `up`, (3, C, 1) float32, world axes. Directions: level * cos(elevation) + up * sin(elevation)."""
        R = self.T_world_sensor[:, :3, :3]
        level = R[:, :, 0] * self.azimuth.cos()[:, None] + R[:, :, 1] * self.azimuth.sin()[:, None]
        return level.T.float()[..., None], R[:, :, 2].T.float()[..., None]


def covered_blocks(solids: MovingSolids, shots: Shots, max_range: float) -> RayBlocks:
    """Find the blocks of all rays that can meet a solid's bounding box (for an ellipsoid, its bounding sphere).

    Convention: a solid at the azimuth where the sweep begins and ends has a block at either end of the image.
    """
    spheres = _spheres(solids, shots)
    near = (spheres.distance - spheres.radius < max_range).nonzero()[:, 0]
    sector = _sector(spheres.at(near), shots)
    solid = []
    guess = []
    for shift in (-shots.revolution, 0, shots.revolution):
        column = sector.column + shift
        is_in_sweep = (column + sector.slack >= 0) & (column - sector.slack < len(shots.azimuth))
        chosen = (sector.is_seen & is_in_sweep).nonzero()[:, 0]
        solid.append(near[chosen])
        guess.append(column[chosen])
    return _blocks_near(solids, shots, torch.cat(solid), torch.cat(guess), max_range)


class _Spheres(NamedTuple):
    """Spheres that hold P solids during a sweep."""

    centre: Tensor  # (P, 3) float64, metres, from the sensor in the middle of the sweep, world axes
    distance: Tensor  # (P,) float64, metres, of the centre
    radius: Tensor  # (P,) float64, metres
    late: float  # seconds from the middle of the sweep to its ends

    def at(self, index: Tensor) -> _Spheres:
        """Select spheres by their positions in the list, (K,) int64."""
        return _Spheres(self.centre[index], self.distance[index], self.radius[index], self.late)


def _spheres(solids: MovingSolids, shots: Shots) -> _Spheres:
    """Bound the motion of all solids during the sweep."""
    late = abs(float(shots.seconds[shots.middle] - solids.middle)) + 0.5 * shots.interval * len(shots.azimuth)
    centre = solids.centre - shots.T_world_sensor[shots.middle, :3, 3]
    return _Spheres(
        centre=centre,
        distance=centre.norm(dim=1),
        radius=solids.radius + late * (solids.speed + shots.speed[0]),
        late=late,
    )


class _Sector(NamedTuple):
    """The columns that may meet K solids."""

    column: Tensor  # (K,) float64, at the azimuth of the centre, 0 ... one revolution
    slack: Tensor  # (K,) float64, columns, to either side
    is_seen: Tensor  # (K,) bool, the elevations of the LiDAR may meet the solid


def _sector(spheres: _Spheres, shots: Shots) -> _Sector:
    """Bound the azimuths and the elevations of spheres as the sensor sees them."""
    x, y, z = (spheres.centre @ shots.T_world_sensor[shots.middle, :3, :3]).T
    rho = torch.hypot(x, y)
    slack = (spheres.radius / spheres.distance.clamp(min=1e-6)).clamp(max=1).asin() + spheres.late * shots.speed[1]
    height = torch.atan2(z, rho)
    # Near the sensor's axis, the azimuth of a solid is not reliable.
    of_azimuth = torch.where(rho < 2 * spheres.radius, math.pi, 2 * slack).clamp(max=math.pi)
    return _Sector(
        column=((torch.atan2(y, x) - shots.azimuth[0]) / shots.step) % shots.revolution,
        slack=of_azimuth / abs(shots.step),
        is_seen=(height + slack > shots.elevation[0]) & (height - slack < shots.elevation[-1]),
    )


def _blocks_near(solids: MovingSolids, shots: Shots, solid: Tensor, guess: Tensor, max_range: float) -> RayBlocks:
    """One block for each `solid` (E,), which the unit meets near column `guess` (E,)."""
    view = _aim(solids, shots, solid, guess)
    outline = _outline(solids, solid, view)
    # While the unit scans its block, a solid moves by at most `drift` from its position in the middle of the block.
    width = (outline.right - outline.left).clamp(max=2 * math.pi)
    speed = solids.speed[solid] + shots.speed[0] + shots.speed[1] * view.centre.norm(dim=1)
    drift = speed * shots.interval * (0.6 * width / abs(shots.step) + 2)
    clearance = view.rho - outline.spread
    margin = (drift / clearance.clamp(min=1e-6)).clamp(max=1).asin() + 1e-6
    is_around = (clearance <= 2 * drift) | (width + 2 * margin > math.pi)
    nearest = (clearance - drift).clamp(min=1e-6)
    first, count = _columns(shots, view.column, outline, margin, is_around)
    # The block of a solid around the sensor's axis has all columns, so its motion during the whole sweep counts.
    whole = torch.where(is_around, speed * shots.interval * len(shots.azimuth), drift)
    first_beam, end_beam = covered_beams(
        bottom=outline.low - whole,
        top=outline.high + whole,
        nearest=torch.where(is_around, 1e-6, nearest),
        farthest=view.rho + outline.spread + drift,
        elevation=shots.elevation,
    )
    return RayBlocks(solid, first, count.masked_fill(nearest > max_range, 0), first_beam, end_beam)


class _View(NamedTuple):
    """E solids as the sensor meets them."""

    column: Tensor  # (E,) float64, column at the azimuth of the centre
    rotation: Tensor  # (E, 3, 3) float64, sensor axes to the solid's, at this column
    centre: Tensor  # (E, 3) float64, metres, sensor frame
    rho: Tensor  # (E,) float64, metres, horizontal distance of the centre


def _aim(solids: MovingSolids, shots: Shots, solid: Tensor, guess: Tensor) -> _View:
    """Find the column that meets the centre of each solid, from a guess, (E,)."""
    for _ in range(_ROUNDS):
        column = guess.round().long().clamp(0, len(shots.azimuth) - 1)
        T_world_sensor = shots.T_world_sensor.index_select(0, column)
        to_solid = solids.at(solid, take(shots.seconds, column)).to_solid
        rotation = to_solid[:, :, :3] @ T_world_sensor[:, :3, :3]
        origin = rotate_each(to_solid[:, :, :3], T_world_sensor[:, :3, 3]) + to_solid[..., 3]  # of the sensor
        centre = rotate_each(rotation.transpose(1, 2), -origin)
        azimuth = torch.atan2(centre[:, 1], centre[:, 0])
        late = (azimuth - (shots.azimuth[0] + shots.step * guess)) / shots.step  # columns
        guess = guess + torch.remainder(late + 0.5 * shots.revolution, shots.revolution) - 0.5 * shots.revolution
    return _View(guess, rotation, centre, torch.hypot(centre[:, 0], centre[:, 1]))


class _Outline(NamedTuple):
    """Bounds of E solids in the sensor frame, (E,) float64 each."""

    low: Tensor  # metres
    high: Tensor  # metres
    left: Tensor  # radians from the centre to the smallest azimuth
    right: Tensor  # radians from the centre to the largest azimuth
    spread: Tensor  # metres, horizontal radius


def _outline(solids: MovingSolids, solid: Tensor, view: _View) -> _Outline:
    """Bound an ellipsoid by its bounding sphere, and other solids by their corners."""
    half = solids.half_size[solid]
    spread = half.amax(1)
    side = (spread / view.rho.clamp(min=1e-6)).clamp(max=1).asin()
    outline = _Outline(view.centre[:, 2] - spread, view.centre[:, 2] + spread, -side, side, spread)
    cornered = (solids.kind[solid] != ELLIPSOID).nonzero()[:, 0]
    if len(cornered):
        of_corners = _outline_of_corners(half[cornered], *(values[cornered] for values in view[1:]))
        for values, exact in zip(outline, of_corners):
            values[cornered] = exact
    return outline


def _outline_of_corners(half: Tensor, rotation: Tensor, centre: Tensor, rho: Tensor) -> _Outline:
    """Bound boxes of half size (E, 3); the other arguments are as in `_View`."""
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3)
    arm = (signs * half[:, None]) @ rotation  # [E, 8, 3], from the centre
    x, y, z = (arm + centre[:, None]).unbind(-1)  # [E, 8] each, sensor frame
    cos, sin = (centre[:, axis, None] / rho[:, None].clamp(min=1e-6) for axis in (0, 1))
    side = torch.atan2(y * cos - x * sin, x * cos + y * sin)
    return _Outline(
        low=z.amin(1),
        high=z.amax(1),
        left=side.amin(1),
        right=side.amax(1),
        spread=torch.hypot(arm[..., 0], arm[..., 1]).amax(1),
    )


def _columns(
    shots: Shots, column: Tensor, outline: _Outline, margin: Tensor, is_around: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the first column, and the number of columns, between the two sides of each solid, (E,) int64 each."""
    num_columns = len(shots.azimuth)
    # Columns count along `step`, which may be negative.
    left = outline.left
    right = outline.right
    if shots.step < 0:
        left = -outline.right
        right = -outline.left
    first = (column + (left - margin) / abs(shots.step)).ceil().long()
    end = (column + (right + margin) / abs(shots.step)).floor().long() + 1
    first = torch.where(is_around, 0, first).clamp(0, num_columns)
    end = torch.where(is_around, num_columns, end).clamp(0, num_columns)
    return first, (end - first).clamp(min=0)


class RollingRays:
    """The callable `rays_at` of `raycast.nearest_hits`: rays of a column in unit coordinates of the block's solid."""

    def __init__(self, solids: MovingSolids, shots: Shots, blocks: RayBlocks) -> None:
        middle = blocks.first_column + blocks.num_columns // 2
        seconds = shots.seconds[middle.clamp(0, len(shots.seconds) - 1)]
        transforms = solids.at(blocks.solid, seconds)
        half = solids.half_size[blocks.solid][..., None]
        # Within a block, the velocity is constant: it takes milliseconds to scan most blocks.
        self._to_unit = (transforms.to_solid / half).flatten(1).T.float().contiguous()  # (12, E)
        self._change = (transforms.change / half).flatten(1).T.float().contiguous()
        self._moves = solids.row[blocks.solid] >= 0
        self._kind = solids.kind[blocks.solid]
        self._inverse_half = solids.half_size[blocks.solid].reciprocal().T.float().contiguous()
        self._cos_elevation = shots.elevation.cos().float()
        self._sin_elevation = shots.elevation.sin().float()
        self._seconds = shots.seconds
        self._block_seconds = seconds
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
        rays = self(block, column)
        inverse_half = take(self._inverse_half, block)
        direction = rays.level * take(self._cos_elevation, beam) + rays.up * take(self._sin_elevation, beam)
        at = rays.origin + direction * distance
        return cosine_of_incidence(take(self._kind, block), at, direction / inverse_half, inverse_half)


def rotate_each(matrices: Tensor, vectors: Tensor) -> Tensor:
    """Multiply each matrix (E, 3, 3) by its vector (E, 3)."""
    return (matrices @ vectors[..., None])[..., 0]
