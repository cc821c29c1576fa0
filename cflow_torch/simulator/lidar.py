"""Multi-beam LiDARs: ray casting, range noise and lost returns."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Callable

import torch
from torch import Tensor

from cflow_torch.simulator.ground import Ground
from cflow_torch.simulator.range_image import RangeImage, cast_shots, cast_unit
from cflow_torch.simulator.raycast import Solids, incidence
from cflow_torch.simulator.rolling import MovingSolids, Shots
from cflow_torch.simulator.sensors import LidarProfile, SpinningLidar

GROUND_ALBEDO = 0.25
FOLIAGE_RETURN = 0.75  # share of the shots at foliage that return, because leaves flutter


@dataclass(frozen=True)
class Returns:
    """The N returns of the LiDARs (*units*) of a vehicle in one sweep, one unit after the other.

    Args:
        points: (N, 3) float32, metres, ego frame; motion-compensated if `LidarProfile.is_deskewed`.
        solid: (N,) int64, index of the solid that was hit; -1 = the ground.
        intensity: (N,) uint8.
        laser_number: (N,) uint8, counted through all units, modulo 256.
        offset_ns: (N,) int32, time from the time stamp to the shot; 0 in instantaneous sweeps.
        unit: (N,) int64, index of the unit; ascending.
        local: (N, 3) float32, metres, the same points in the frame of their unit.
        ring: (N,) int32, index of the beam, lowest first.
        column: (N,) int32, index of the azimuth step, counted in the direction of rotation.

    Convention: the rows of a unit are sorted by time in rolling profiles, and by azimuth in others. Rows of the same
    column are sorted from the lowest beam up.
    """

    points: Tensor
    solid: Tensor
    intensity: Tensor
    laser_number: Tensor
    offset_ns: Tensor
    unit: Tensor
    local: Tensor
    ring: Tensor
    column: Tensor


def scan(
    profile: LidarProfile, solids: Solids, ground: Ground, T_world_ego: Tensor, generator: torch.Generator
) -> Returns:
    """Simulate an instantaneous sweep: all LiDARs (units) of a vehicle fire all shots at the same time.

    Args:
        profile: the units and their quality.
        solids: everything in the world except the ground.
        ground: height of the ground in the world.
        T_world_ego: (4, 4) float64.
        generator: source of the noise, the lost returns and the azimuth of the first column.
    """
    of_units = []
    T_solid_ego = torch.linalg.inv(solids.pose) @ T_world_ego
    for number, unit in enumerate(profile.units):
        step = 2 * math.pi / unit.num_columns
        phase = step * torch.rand((), generator=generator, dtype=torch.float64).item()
        image = cast_unit(unit, phase, solids, T_solid_ego, ground, T_world_ego, profile.max_range)
        T_solid_sensor = T_solid_ego @ torch.from_numpy(unit.T_ego_sensor)

        def cosine_at(ray: Tensor, image: RangeImage = image, T_solid_sensor: Tensor = T_solid_sensor) -> Tensor:
            rays = image.rays.index_select(1, ray)
            distance = image.distance[ray]
            solid = image.solid[ray]
            return incidence(solids, T_solid_sensor, solid, rays, distance)

        hit, distance, reflected = _measure(image, unit, profile, solids, cosine_at, generator)
        local = image.rays.index_select(1, hit) * distance
        T_ego_sensor = torch.from_numpy(unit.T_ego_sensor).float()
        points = T_ego_sensor[:3, :3] @ local + T_ego_sensor[:3, 3:]
        column = hit // len(unit.elevations)
        column = column if unit.span > 0 else unit.num_columns - 1 - column
        offset_ns = torch.zeros_like(column)
        of_units.append(_returns(points, local, image, hit, reflected, profile, number, column, offset_ns))
    return _concatenate(of_units)


def scan_rolling(
    profile: LidarProfile,
    solids: MovingSolids,
    ground: Ground,
    T_world_ego: Tensor,
    shots_of: Callable[[SpinningLidar, float], Shots],
    generator: torch.Generator,
) -> Returns:
    """Simulate a rolling sweep of all units of a vehicle: every column of shots has its own time and ego pose.

    Args:
        T_world_ego: (4, 4) float64, at the time stamp.
        shots_of: function that returns the shots of a unit from the phase of its columns, 0 ... 1.
    """
    of_units = []
    for number, unit in enumerate(profile.units):
        phase = torch.rand((), generator=generator, dtype=torch.float64).item() if unit.has_jitter else 0.5
        shots = shots_of(unit, phase)
        image, cosine_at = cast_shots(
            shots, solids, ground, min(unit.max_range or profile.max_range, profile.max_range)
        )
        hit, distance, reflected = _measure(image, unit, profile, solids, cosine_at, generator)
        if profile.is_deskewed and not unit.is_virtual:
            points, local = _deskewed_points(shots, image, hit, distance, unit, T_world_ego, solids.origin)
        else:
            points, local = _points_at_shots(shots, hit, distance, unit)
        first, _ = unit.active_columns or (0, unit.num_columns)
        column = hit // len(unit.elevations) + first
        interval_ns = profile.sweep_interval_ns / unit.num_columns
        offset_ns = (column.double() * interval_ns - profile.reference * profile.sweep_interval_ns).round()
        image_column = column % unit.num_columns
        of_units.append(_returns(points, local, image, hit, reflected, profile, number, image_column, offset_ns))
    return _concatenate(of_units)


def _deskewed_points(
    shots: Shots,
    image: RangeImage,
    hit: Tensor,
    distance: Tensor,
    unit: SpinningLidar,
    T_world_ego: Tensor,
    origin: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return the points that were hit, (3, N) float32, in the ego frame at the time stamp, and in that of the unit."""
    T_ego_world = torch.linalg.inv(T_world_ego)
    T_ego_world[:3, 3] += T_ego_world[:3, :3] @ origin
    column = hit // len(unit.elevations)
    sensor = shots.T_world_sensor[:, :3, 3].T.float().contiguous().index_select(1, column)
    world = sensor + image.rays.index_select(1, hit) * distance
    points = T_ego_world[:3, :3].float() @ world + T_ego_world[:3, 3:].float()
    T_ego_sensor = torch.from_numpy(unit.T_ego_sensor).float()
    return points, T_ego_sensor[:3, :3].T @ (points - T_ego_sensor[:3, 3:])


def _points_at_shots(shots: Shots, hit: Tensor, distance: Tensor, unit: SpinningLidar) -> tuple[Tensor, Tensor]:
    """Return the points that were hit, (3, N) float32, in the ego frame and that of the unit when it fired."""
    azimuth = shots.azimuth.float()[hit // len(unit.elevations)]
    elevation = shots.elevation.float()[hit % len(unit.elevations)]
    level = elevation.cos() * distance
    local = torch.stack([azimuth.cos() * level, azimuth.sin() * level, elevation.sin() * distance])
    T_ego_sensor = torch.from_numpy(unit.T_ego_sensor).float()
    return T_ego_sensor[:3, :3] @ local + T_ego_sensor[:3, 3:], local


def _measure(
    image: RangeImage,
    unit: SpinningLidar,
    profile: LidarProfile,
    solids: Solids | MovingSolids,
    cosine_at: Callable[[Tensor], Tensor],
    generator: torch.Generator,
) -> tuple[Tensor, Tensor, Tensor]:
    """Add noise along the ray, and drop returns that are too near, too far, too weak, or lost at random.

    Args:
        cosine_at: maps rays (n,) that hit solids to the cosines of their angles of incidence.

    Returns:
        (N,) int64 rays that returned; (N,) float32 measured range; (N,) float32 reflected share of the light.
    """
    max_range = min(unit.max_range or profile.max_range, profile.max_range)
    hit = ((image.distance > profile.min_range) & (image.distance < max_range)).nonzero()[:, 0]
    noise = profile.range_noise * torch.randn(len(hit), generator=generator)
    luck = torch.rand(len(hit), generator=generator)
    dropout = profile.dropout if unit.dropout is None else unit.dropout
    lucky = (luck < 1 - dropout).nonzero()[:, 0]
    hit = hit.index_select(0, lucky)
    noise = noise.index_select(0, lucky)
    luck = luck.index_select(0, lucky)

    distance, solid, cosine = (values.index_select(0, hit) for values in (image.distance, image.solid, image.cosine))
    on_solid = (solid >= 0).nonzero()[:, 0]
    cosine[on_solid] = cosine_at(hit.index_select(0, on_solid))
    # The ground has index -1, which takes the last element.
    albedo = torch.cat([solids.albedo, torch.tensor([GROUND_ALBEDO])]).take(solid)
    is_foliage = torch.cat([solids.is_foliage, torch.tensor([False])]).take(solid)
    reflected = cosine * albedo
    # The received light decreases with 1 / range^2. The detection threshold is soft.
    margin = reflected * ((unit.reach or profile.reach) / distance) ** 2
    if profile.extinction:
        margin = margin * torch.exp(-2 * profile.extinction * distance)
    chance = (1 - dropout) * torch.sigmoid(4 * margin.clamp(min=1e-12).log())
    chance = torch.where(is_foliage, FOLIAGE_RETURN * chance, chance)
    is_own = torch.cat([solids.is_own, torch.tensor([False])]).take(solid)
    chance = chance.masked_fill(is_own, 0.0)
    kept = (luck < chance).nonzero()[:, 0]
    return hit[kept], (distance + noise)[kept], reflected[kept]


def _returns(
    points: Tensor,
    local: Tensor,
    image: RangeImage,
    hit: Tensor,
    reflected: Tensor,
    profile: LidarProfile,
    number: int,
    column: Tensor,
    offset_ns: Tensor,
) -> Returns:
    """Returns of unit `number`."""
    unit = profile.units[number]
    first_laser = sum(len(before.elevations) for before in profile.units[:number])
    laser = torch.tensor(unit.elevations, dtype=torch.float64).sort().indices
    beam = hit % len(unit.elevations)
    return Returns(
        points=points.T.contiguous(),
        solid=image.solid.index_select(0, hit),
        intensity=(255 * reflected).clamp(0, 255).to(torch.uint8),
        laser_number=((first_laser + laser[beam]) % 256).to(torch.uint8),
        offset_ns=offset_ns.to(torch.int32),
        unit=torch.full((len(hit),), number),
        local=local.T.contiguous(),
        ring=beam.to(torch.int32),
        column=column.to(torch.int32),
    )


def _concatenate(of_units: list[Returns]) -> Returns:
    return Returns(*(torch.cat([getattr(returns, column.name) for returns in of_units]) for column in fields(Returns)))
