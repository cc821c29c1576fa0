"""A highway: three lanes a side, speeds up to 35 m/s, guard rails, a bridge, trees."""

from __future__ import annotations

from typing import Iterator

import numpy as np

from cflow_torch.simulator import objects
from cflow_torch.simulator.ground import NOWHERE, Ground
from cflow_torch.simulator.objects import Body
from cflow_torch.simulator.scene import Scene
from cflow_torch.simulator.street import EAST, WEST
from cflow_torch.simulator.trajectories import Route

LANES = (2.9, 6.6, 10.3)  # distance of each lane's middle from the median, fast lane first, metres
EDGE = 13.5  # distance of the grass from the median, metres
ROAD_END = 420.0  # rails, signs and trees stand at |x| up to this, metres


def build_highway(rng: np.random.Generator) -> Scene:
    """Draw a scene from `rng`."""
    bend = float(rng.choice((-1, 1)) * rng.uniform(1e-5, 4e-5))
    slope = (rng.uniform(-0.02, 0.02), rng.uniform(-0.015, 0.015))
    ground = Ground(slope, bend, kerb=0.08, half_widths=(EDGE, 1.0), crossing_x=NOWHERE)
    speed = rng.uniform(22, 30)
    ego = Route(0.0, -LANES[1], EAST, speed=speed)
    bodies = (*_traffic(rng, speed), *_fixed(rng))
    return Scene(ground, ego, bodies)


def _traffic(rng: np.random.Generator, ego_speed: float) -> Iterator[Body]:
    """Lanes of constant speed, a broken-down car on the shoulder, and cars that brake and accelerate on a ramp."""
    for side, heading in ((-1, EAST), (1, WEST)):
        for lane, (low, high) in zip(LANES, ((29, 35), (23, 29))):
            is_ego_lane = side < 0 and lane == LANES[1]
            speed = ego_speed if is_ego_lane else rng.uniform(low, high)
            for x in _positions(rng, 28, 70):
                if not (is_ego_lane and abs(x) < 20):
                    yield objects.car(rng, Route(x, side * lane + rng.uniform(-0.2, 0.2), heading, speed=speed))
        speed = rng.uniform(21, 24)
        for number, x in enumerate(_positions(rng, 45, 80)):
            route = Route(x, side * LANES[2], heading, speed=speed)
            if number % 3 == 0:
                yield from objects.articulated_truck(route)
            else:
                yield (objects.bus(route) if number % 7 == 1 else objects.van(rng, route))
    # On the shoulder: a car that has broken down, and its driver behind the rail.
    x = rng.uniform(40, 90)
    yield objects.car(rng, Route(x, -EDGE + 0.9 - 0.4, EAST))
    yield objects.pedestrian(rng, Route(x - 6, -EDGE - 1.6, EAST, speed=1.2))
    # On a ramp beyond the rail: one car brakes, one accelerates.
    yield objects.car(rng, Route(rng.uniform(15, 40), -EDGE - 5.0, EAST, speed=26, acceleration=-4.0))
    yield objects.car(rng, Route(rng.uniform(-60, -30), -EDGE - 5.0, EAST, speed=12, acceleration=2.5))


def _positions(rng: np.random.Generator, low: float, high: float) -> Iterator[float]:
    """x of the vehicles of a lane, `low` to `high` metres from middle to middle."""
    x = -220 + rng.uniform(0, high)
    while x < 300:
        yield float(x)
        x += rng.uniform(low, high)


def _fixed(rng: np.random.Generator) -> Iterator[Body]:
    """Rails (short pieces that follow the road up and down), posts, signs, a bridge, noise walls, trees."""
    for x in np.arange(-ROAD_END, ROAD_END, 20.0).tolist():
        for y in (-EDGE - 0.5, -0.7, 0.7, EDGE + 0.5):
            yield _rail(x, y)
        if rng.uniform() < 0.5:
            side = float(rng.choice((-1, 1)))
            yield objects.tree(rng, x + rng.uniform(0, 20), side * rng.uniform(EDGE + 10, EDGE + 25), num_leaves=60)
        if rng.uniform() < 0.5:
            yield objects.bush(rng, x + rng.uniform(0, 20), rng.uniform(EDGE + 2, EDGE + 6), num_leaves=25)
    for x in np.arange(-ROAD_END, ROAD_END, 60.0).tolist():
        yield objects.pole(x, float(rng.choice((-1, 1))) * (EDGE + 1.2), 2.5, 0.05, sign=0.8)
    begin = rng.uniform(-120, 0)
    for x in np.arange(begin, begin + 160, 20.0).tolist():
        yield objects.wall(x, EDGE + 7.5, 20.0, 0.3, 4.0)
    yield from _bridge(rng.uniform(60, 160))


def _rail(x: float, y: float) -> Body:
    """Twenty metres of guard rail on five posts."""
    solids = [objects.box(-10, 10, -0.04, 0.04, 0.45, 0.76, 0.6)]
    solids += [objects.box(at - 0.05, at + 0.05, -0.03, 0.03, -0.3, 0.45, 0.5) for at in (-8, -4, 0, 4, 8)]
    return Body(solids, Route(x, y))


def _bridge(x: float) -> tuple[Body, ...]:
    """A road that crosses overhead, on piers."""
    deck = Body([objects.box(-4, 4, -45, 45, 5.6, 6.8, 0.5)], Route(x, 0.0))
    return (deck, *(objects.wall(x, y, 1.2, 0.6, 6.0) for y in (-EDGE - 2.0, 0.0, EDGE + 2.0)))
