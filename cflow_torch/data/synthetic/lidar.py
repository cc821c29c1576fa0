"""A spinning multi-beam LiDAR that measures a scene: geometry from ray casting, then noise and lost returns."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from cflow_torch.data.synthetic.ground import Ground
from cflow_torch.data.synthetic.profiles import LidarProfile, SpinningLidar
from cflow_torch.data.synthetic.raycast import Solids, cast_solids, incidence, ray_directions

GROUND_ALBEDO = 0.25
FOLIAGE_RETURN = 0.75  # share of the shots at a leaf that come back: leaves flutter


@dataclass(frozen=True)
class Returns:
    """What a vehicle's LiDARs received in one sweep, N returns.

    Args:
        points: (N, 3) float32, metres, ego frame.
        solid: (N,) int64, the solid that was hit; -1 = the ground.
        intensity: (N,) uint8.
        laser_number: (N,) uint8.
        offset_ns: (N,) int32, when in the turn the laser fired (the scene itself stands still during a sweep).
    """

    points: Tensor
    solid: Tensor
    intensity: Tensor
    laser_number: Tensor
    offset_ns: Tensor


@dataclass(frozen=True)
class RangeImage:
    """What the C * B rays of a unit meet, before the sensor measures it. Ray number = column * B + beam.

    Args:
        rays: (3, C * B) float32 unit vectors, sensor frame.
        laser: (B,) int64 laser number of each beam (beams are ordered by elevation).
        distance: (C * B,) float32 true range, metres, inf = nothing.
        solid: (C * B,) int64 the solid that is met, -1 = the ground or nothing.
        cosine: (C * B,) float32 cosine of the angle of incidence, where something is met.
    """

    rays: Tensor
    laser: Tensor
    distance: Tensor
    solid: Tensor
    cosine: Tensor


def scan(
    profile: LidarProfile,
    solids: Solids,
    ground: Ground,
    T_world_ego: Tensor,
    generator: torch.Generator,
    sweep_interval_ns: int,
) -> Returns:
    """One sweep of all units of a vehicle.

    Args:
        profile: the units and their quality.
        solids: everything but the ground, in the world.
        ground: the ground, in the world.
        T_world_ego: (4, 4) float64.
        generator: noise, drop-out and the azimuth at which the turn starts are drawn from it.
        sweep_interval_ns: duration of one turn.

    Returns:
        Returns, unit by unit, in each one column after the other.
    """
    parts, first_laser = [], 0
    T_solid_ego = torch.linalg.inv(solids.pose) @ T_world_ego
    for unit in profile.units:
        step = 2 * math.pi / unit.num_columns
        phase = step * torch.rand((), generator=generator, dtype=torch.float64).item()
        image = cast_unit(unit, phase, solids, T_solid_ego, ground, T_world_ego, profile.max_range)
        parts.append(_measure(image, unit, first_laser, profile, solids, generator, sweep_interval_ns))
        first_laser += len(unit.elevations)
    columns = ("points", "solid", "intensity", "laser_number", "offset_ns")
    return Returns(*(torch.cat([getattr(part, name) for part in parts]) for name in columns))


def cast_unit(
    unit: SpinningLidar,
    phase: float,
    solids: Solids,
    T_solid_ego: Tensor,
    ground: Ground,
    T_world_ego: Tensor,
    max_range: float,
) -> RangeImage:
    """The true range image of one unit.

    Args:
        phase: azimuth of the first column, radians.
        T_solid_ego: (P, 4, 4) float64, ego coordinates to the solids'.
    """
    T_ego_sensor = torch.from_numpy(unit.T_ego_sensor)
    T_world_sensor, T_solid_sensor = T_world_ego @ T_ego_sensor, T_solid_ego @ T_ego_sensor
    elevation, laser = torch.tensor(unit.elevations, dtype=torch.float64).deg2rad().sort()
    azimuth = phase + 2 * math.pi / unit.num_columns * torch.arange(unit.num_columns, dtype=torch.float64)

    rays = ray_directions(azimuth, elevation)
    distance, solid = cast_solids(solids.kind, T_solid_sensor, solids.half_size, azimuth, elevation, max_range)
    ground_distance, cosine = ground.cast(T_world_sensor[:3, 3], T_world_sensor[:3, :3] @ rays)
    rays, ground_distance, cosine = rays.float(), ground_distance.float(), cosine.float()
    solid = solid.masked_fill(ground_distance < distance, -1)
    distance = torch.minimum(distance, ground_distance)
    on_solid = (solid >= 0).nonzero()[:, 0]
    at = solid[on_solid]
    cosine[on_solid] = incidence(solids, T_solid_sensor, at, rays.index_select(1, on_solid), distance[on_solid])
    return RangeImage(rays, laser, distance, solid, cosine)


def _measure(
    image: RangeImage,
    unit: SpinningLidar,
    first_laser: int,
    profile: LidarProfile,
    solids: Solids,
    generator: torch.Generator,
    sweep_interval_ns: int,
) -> Returns:
    """Noise along the ray; returns that are too near, too far, too weak or unlucky are lost."""
    hit = ((image.distance > profile.min_range) & (image.distance < profile.max_range)).nonzero()[:, 0]
    distance, solid, cosine = (values.index_select(0, hit) for values in (image.distance, image.solid, image.cosine))
    # Solid number -1, the ground, reads the last row.
    albedo = torch.cat([solids.albedo, torch.tensor([GROUND_ALBEDO])]).take(solid)
    is_foliage = torch.cat([solids.is_foliage, torch.tensor([False])]).take(solid)
    reflected = cosine * albedo
    # Light comes back as 1 / range^2; the threshold is soft.
    margin = reflected * (profile.reach / distance) ** 2
    chance = (1 - profile.dropout) * torch.sigmoid(4 * margin.clamp(min=1e-12).log())
    chance = torch.where(is_foliage, FOLIAGE_RETURN * chance, chance)
    distance = distance + profile.range_noise * torch.randn(len(hit), generator=generator)
    kept = (torch.rand(len(hit), generator=generator) < chance).nonzero()[:, 0]

    hit, distance = hit.index_select(0, kept), distance.index_select(0, kept)
    T_ego_sensor = torch.from_numpy(unit.T_ego_sensor).float()
    points = T_ego_sensor[:3, :3] @ (image.rays.index_select(1, hit) * distance) + T_ego_sensor[:3, 3:]
    column, beam = hit // len(image.laser), hit % len(image.laser)
    # The units turn clockwise seen from above; the azimuth of an upright one therefore falls with time.
    turned = column if unit.upside_down else unit.num_columns - 1 - column
    return Returns(
        points=points.T.contiguous(),
        solid=solid[kept],
        intensity=(255 * reflected[kept]).clamp(0, 255).to(torch.uint8),
        laser_number=(first_laser + image.laser[beam]).to(torch.uint8),
        offset_ns=(turned * (sweep_interval_ns / unit.num_columns)).to(torch.int32),
    )
