"""Range images of a LiDAR without noise: the first intersection of each ray with the ground or a solid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Callable

import torch
from torch import Tensor

from cflow_torch.simulator.ground import Ground
from cflow_torch.simulator.raycast import RayBlocks, Solids, nearest_hits, ray_directions, take
from cflow_torch.simulator.rolling import MovingSolids, RollingRays, Shots, covered_blocks
from cflow_torch.simulator.sensors import SpinningLidar


@dataclass(frozen=True)
class RangeImage:
    """First intersections of the C * B rays of a unit, without measurement noise. Ray index = column * B + beam.

    Args:
        rays: (3, C * B) float32 unit vectors: sensor frame in instantaneous sweeps, world axes in rolling ones.
        distance: (C * B,) float32 true range, metres, inf = no hit.
        solid: (C * B,) int64 index of the solid, -1 = the ground or no hit.
        cosine: (C * B,) float32 cosine of the angle of incidence, where the ray hits the ground.
    """

    rays: Tensor
    distance: Tensor
    solid: Tensor
    cosine: Tensor


def cast_unit(
    unit: SpinningLidar,
    phase: float,
    solids: Solids,
    T_solid_ego: Tensor,
    ground: Ground,
    T_world_ego: Tensor,
    max_range: float,
) -> RangeImage:
    """Cast the rays of one LiDAR, `unit`, in an instantaneous sweep.

    Args:
        phase: azimuth of the first column, radians.
        T_solid_ego: (P, 4, 4) float64, from the ego frame to the frame of each solid.
    """
    T_ego_sensor = torch.from_numpy(unit.T_ego_sensor)
    T_world_sensor = T_world_ego @ T_ego_sensor
    T_solid_sensor = T_solid_ego @ T_ego_sensor
    elevation = torch.tensor(unit.elevations, dtype=torch.float64).deg2rad().sort().values
    azimuth = phase + 2 * math.pi / unit.num_columns * torch.arange(unit.num_columns, dtype=torch.float64)
    rays = ray_directions(azimuth, elevation)
    distance, solid = cast_solids(solids.kind, T_solid_sensor, solids.half_size, azimuth, elevation, max_range)
    to_ground, cosine = ground.cast(T_world_sensor[:3, 3], T_world_sensor[:3, :3] @ rays)
    return RangeImage(
        rays=rays.float(),
        distance=torch.minimum(distance, to_ground.float()),
        solid=solid.masked_fill(to_ground.float() < distance, -1),
        cosine=cosine.float(),
    )


def cast_solids(
    kind: Tensor,
    T_solid_sensor: Tensor,
    half_size: Tensor,
    azimuth: Tensor,
    elevation: Tensor,
    max_range: float,
) -> tuple[Tensor, Tensor]:
    """Find the nearest solid along every ray of an instantaneous range image.

    Args:
        kind: (P,) int64, BOX, CYLINDER or ELLIPSOID.
        T_solid_sensor: (P, 4, 4) float64, rigid, from the sensor frame to the frame of each solid.
        half_size: (P, 3) float64, metres.
        azimuth: (C,) float64 radians, evenly spaced over one full revolution, ascending.
        elevation: (B,) float64 radians, ascending.
        max_range: metres; we may skip solids that are entirely beyond it.

    Returns:
        (C * B,) float32 range in metres, inf = no hit; (C * B,) int64 solid, -1 = no hit. Ray index column * B + beam.

    Convention: a solid that contains the sensor is not hit. Of solids at equal range, the first is hit.
    """
    shots = Shots.at_once(azimuth, elevation)
    solids = MovingSolids.standing(kind, T_solid_sensor[:, :3], half_size)
    blocks = covered_blocks(solids, shots, max_range)
    blocks = blocks.at(blocks.solid.argsort(stable=True))
    distance, block = nearest_hits(kind, blocks, RollingRays(solids, shots, blocks), len(azimuth), elevation)
    return distance, _solid_of(blocks, block)


def _solid_of(blocks: RayBlocks, block: Tensor) -> Tensor:
    """Return the solid of each block; -1 of block -1, which takes the last element."""
    return torch.cat([blocks.solid, torch.tensor([-1])]).take(block)


def cast_shots(
    shots: Shots, solids: MovingSolids, ground: Ground, max_range: float
) -> tuple[RangeImage, Callable[[Tensor], Tensor]]:
    """Cast the rays of one unit in a rolling sweep, in which every column has its own time.

    Returns:
        The image, with rays in world axes; a function that returns the cosines of the angles of incidence for rays (n,)
        that hit solids.
    """
    num_beams = len(shots.elevation)
    blocks = covered_blocks(solids, shots, max_range)
    rays_at = RollingRays(solids, shots, blocks)
    distance, block = nearest_hits(solids.kind, blocks, rays_at, len(shots.azimuth), shots.elevation)
    level, up = shots.directions
    directions = level * shots.elevation.cos().float() + up * shots.elevation.sin().float()  # (3, C, B)
    origin = (shots.T_world_sensor[:, :3, 3] + solids.origin).T[..., None]
    ground_distance, cosine = (values.flatten() for values in ground.cast(origin, directions))
    solid = _solid_of(blocks, block).masked_fill(ground_distance < distance, -1)
    distance = torch.minimum(distance, ground_distance)

    def cosine_at(ray: Tensor) -> Tensor:
        column = torch.div(ray, num_beams, rounding_mode="floor")
        return rays_at.incidence(take(block, ray), column, ray - column * num_beams, take(distance, ray))

    return RangeImage(directions.flatten(1), distance, solid, cosine), cosine_at
