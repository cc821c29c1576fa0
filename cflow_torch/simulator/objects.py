"""Objects of a scene: shapes made of a few solids, which move along trajectories.

The origin of a body frame is on the ground below the middle of the body: x ahead, y left, z up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Sequence, Tuple

import numpy as np

from cflow_torch.simulator.raycast import BOX, CYLINDER, ELLIPSOID
from cflow_torch.simulator.trajectories import Route, Towed

Vector = Tuple[float, float, float]
HIP = 0.9  # height of the axis about which legs swing, metres


class Solid(NamedTuple):
    """One solid of a body.

    Args:
        kind: BOX, CYLINDER or ELLIPSOID.
        centre: metres, body frame.
        half: half size along the axes of the solid, metres.
        pitch, roll: rotation of the solid in the body, radians: first by roll about x, then by pitch about y.
        albedo: share of the light that is reflected.
        is_foliage: returns are lost at random (`lidar.FOLIAGE_RETURN`).
        swing: amplitude of a leg's swing about the y axis through the hip, radians; 0 = no leg.
        stride: periods of the swing per second (two steps each); phase: of the swing at time 0, radians.
    """

    kind: int
    centre: Vector
    half: Vector
    pitch: float = 0.0
    roll: float = 0.0
    albedo: float = 0.5
    is_foliage: bool = False
    swing: float = 0.0
    stride: float = 0.0
    phase: float = 0.0


@dataclass(frozen=True)
class Body:
    """An object or a piece of background.

    Args:
        solids: its shape.
        trajectory: a function of (T,) seconds that returns (T, 3) world x, y, yaw.
        category: Argoverse 2 category name. None = never labelled: background, which never moves, or the own truck.
        size: length, width and height above ground, metres.
    """

    solids: Sequence[Solid]
    trajectory: Route | Towed
    category: str | None = None
    size: Vector = (0.0, 0.0, 0.0)

    @property
    def is_static(self) -> bool:
        """True if the body never moves. A trailer counts as moving, even behind a parked tractor."""
        return isinstance(self.trajectory, Route) and self.trajectory.is_static


def box(x0: float, x1: float, y0: float, y1: float, z0: float, z1: float, albedo: float) -> Solid:
    """A box, given by the coordinates of its six faces in the body frame, metres."""
    centre = ((x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2)
    return Solid(BOX, centre, ((x1 - x0) / 2, (y1 - y0) / 2, (z1 - z0) / 2), albedo=albedo)


def _wheels(xs: Sequence[float], y: float, radius: float) -> list[Solid]:
    return [
        Solid(CYLINDER, (x, side * (y - 0.12), radius), (radius, radius, 0.12), roll=math.pi / 2, albedo=0.15)
        for x in xs
        for side in (-1, 1)
    ]


def car(rng: np.random.Generator, route: Route) -> Body:
    """A hull with ground clearance, a cabin and four wheels."""
    length = rng.uniform(3.8, 5.0)
    width = rng.uniform(1.7, 2.0)
    height = rng.uniform(1.4, 1.85)
    paint = rng.uniform(0.15, 0.9)
    half = length / 2
    rear = -half + rng.uniform(0.05, 0.7)  # from estate to saloon
    solids = [
        box(-half, half, -width / 2, width / 2, 0.25, 0.58 * height, paint),
        box(rear, half - rng.uniform(1.1, 1.5), -width / 2 + 0.12, width / 2 - 0.12, 0.58 * height, height, 0.3),
        *_wheels((-0.3 * length, 0.3 * length), width / 2, 0.33),
    ]
    return Body(solids, route, "REGULAR_VEHICLE", (length, width, height))


def bus(route: Route) -> Body:
    """A bus 12 m long."""
    solids = [box(-6, 6, -1.27, 1.27, 0.35, 3.1, 0.6), *_wheels((-3.2, 3.3), 1.27, 0.48)]
    return Body(solids, route, "BUS", (12.0, 2.54, 3.1))


def articulated_truck(route: Route) -> list[Body]:
    """A tractor and a trailer. Each is a body with its own track."""
    cab = [
        box(0.4, 2.8, -1.2, 1.2, 0.5, 3.3, 0.7),
        box(-2.8, 0.4, -0.6, 0.6, 0.6, 1.0, 0.3),
        *_wheels((-1.6, 1.9), 1.2, 0.5),
    ]
    trailer = [box(-4.25, 4.25, -1.25, 1.25, 1.15, 3.7, 0.8), *_wheels((-2.9, -1.7), 1.25, 0.5)]
    tow = Towed(route, hitch=1.4, wheelbase=6.0, middle=3.4)
    return [
        Body(cab, route, "TRUCK_CAB", (5.6, 2.4, 3.3)),
        Body(trailer, tow, "VEHICULAR_TRAILER", (8.5, 2.5, 3.7)),
    ]


def van(rng: np.random.Generator, route: Route) -> Body:
    """A delivery van: one tall box behind a short bonnet."""
    paint = rng.uniform(0.3, 0.9)
    solids = [
        box(-2.9, 1.9, -1.0, 1.0, 0.3, 2.5, paint),
        box(1.9, 2.9, -0.95, 0.95, 0.3, 1.3, paint),
        *_wheels((-1.8, 1.9), 1.0, 0.35),
    ]
    return Body(solids, route, "REGULAR_VEHICLE", (5.8, 2.0, 2.5))


def own_truck(route: Route) -> list[Body]:
    """The recording truck, a cab and a trailer. `route` is the route of the cab's rear axle."""
    cab = [box(2.6, 5.0, -1.25, 1.25, 0.4, 3.1, 0.5), box(-1.0, 2.6, -0.6, 0.6, 0.3, 0.9, 0.3)]
    trailer = [box(-6.3, 6.0, -1.25, 1.25, 1.1, 4.0, 0.7), *_wheels((-4.4, -3.1, -1.8), 1.25, 0.5)]
    return [Body(cab, route), Body(trailer, Towed(route, hitch=-0.3, wheelbase=7.6, middle=4.7))]


def pedestrian(rng: np.random.Generator, route: Route) -> Body:
    """A torso, a head, and two legs that swing if the person walks."""
    scale = rng.uniform(0.9, 1.1)
    cloth = rng.uniform(0.2, 0.8)
    swing = 0.0 if route.speed == 0 else 0.45
    phase = rng.uniform(0, 2 * math.pi)
    legs = [
        Solid(
            *(CYLINDER, (0.0, 0.1 * side, 0.46 * scale), (0.08, 0.08, 0.44 * scale)),
            albedo=cloth,
            swing=swing,
            stride=0.75 * route.speed,
            phase=phase + side * math.pi / 2,
        )
        for side in (-1, 1)
    ]
    solids = [
        Solid(ELLIPSOID, (0.0, 0.0, 1.17 * scale), (0.16, 0.25, 0.38 * scale), albedo=cloth),
        Solid(ELLIPSOID, (0.0, 0.0, 1.63 * scale), (0.11, 0.09, 0.13), albedo=0.5),
        *legs,
    ]
    return Body(solids, route, "PEDESTRIAN", (0.95, 0.55, 1.76 * scale))


def cyclist(rng: np.random.Generator, route: Route) -> Body:
    """Two wheels, a frame, and a rider who leans forward and pedals."""
    cloth = rng.uniform(0.3, 0.8)
    phase = rng.uniform(0, 2 * math.pi)
    solids = [
        *[Solid(CYLINDER, (x, 0.0, 0.34), (0.34, 0.34, 0.025), roll=math.pi / 2, albedo=0.2) for x in (-0.52, 0.52)],
        box(-0.5, 0.45, -0.03, 0.03, 0.35, 0.8, 0.4),
        box(0.4, 0.5, -0.28, 0.28, 0.95, 1.05, 0.4),
        Solid(ELLIPSOID, (-0.05, 0.0, 1.22), (0.15, 0.22, 0.36), pitch=0.5, albedo=cloth),
        Solid(ELLIPSOID, (0.2, 0.0, 1.66), (0.11, 0.09, 0.13), albedo=0.5),
        *[
            Solid(
                *(CYLINDER, (0.05, 0.12 * side, 0.6), (0.07, 0.07, 0.3)),
                albedo=cloth,
                swing=0.35,
                stride=1.2,
                phase=phase + side * math.pi / 2,
            )
            for side in (-1, 1)
        ],
    ]
    return Body(solids, route, "BICYCLIST", (1.75, 0.6, 1.8))


def wall(x: float, y: float, length: float, depth: float, height: float, albedo: float = 0.45) -> Body:
    """A building, garden wall or hoarding: a box along the world axes that reaches a metre into the ground."""
    return Body([box(-length / 2, length / 2, -depth / 2, depth / 2, -1.0, height, albedo)], Route(x, y))


def pole(x: float, y: float, height: float, radius: float, sign: float = 0.0) -> Body:
    """A lamp post, or with `sign` > 0 a sign post: its top has a square plate with sides of `sign` metres."""
    solids = [Solid(CYLINDER, (0, 0, height / 2), (radius, radius, height / 2), albedo=0.4)]
    if sign:
        solids.append(box(-0.03, 0.03, -sign / 2, sign / 2, height - sign, height, 0.9))
    return Body(solids, Route(x, y))


def tree(rng: np.random.Generator, x: float, y: float, num_leaves: int = 110) -> Body:
    """A trunk, and a crown of leaves (ellipsoids)."""
    spread = rng.uniform(1.3, 2.1)
    bottom = rng.uniform(2.0, 2.8)
    trunk = Solid(CYLINDER, (0, 0, bottom / 2 + 0.5), (0.14, 0.14, bottom / 2 + 0.5), albedo=0.3)
    crown = _foliage(rng, (spread, spread, 1.3 * spread), bottom + 1.2 * spread, num_leaves, (0.12, 0.35))
    return Body([trunk, *crown], Route(x, y))


def bush(rng: np.random.Generator, x: float, y: float, num_leaves: int = 40) -> Body:
    """A bush: leaves (ellipsoids) from the ground up."""
    size = (rng.uniform(0.5, 1.4), rng.uniform(0.4, 0.7), rng.uniform(0.4, 0.8))
    return Body(_foliage(rng, size, size[2], num_leaves, (0.08, 0.2)), Route(x, y))


def _foliage(
    rng: np.random.Generator, radii: Vector, height: float, number: int, leaf: tuple[float, float]
) -> list[Solid]:
    """`number` small ellipsoids at random positions inside a large one, whose middle is at `height`."""
    offsets = rng.normal(size=(number, 3))
    offsets *= rng.uniform(size=(number, 1)) ** (1 / 3) / np.linalg.norm(offsets, axis=1, keepdims=True)
    centres = offsets * radii + (0, 0, height)
    sizes = rng.uniform(*leaf, size=number)
    return [
        Solid(ELLIPSOID, (cx, cy, cz), (r, r, 0.7 * r), albedo=0.35, is_foliage=True)
        for (cx, cy, cz), r in zip(centres.tolist(), sizes.tolist())
    ]
