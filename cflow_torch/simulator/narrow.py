"""A narrow street: house fronts close to the road, parked cars along one kerb, people at walls and between cars."""

from __future__ import annotations

from typing import Iterator

import numpy as np

from cflow_torch.simulator import objects
from cflow_torch.simulator.ground import NOWHERE, Ground
from cflow_torch.simulator.objects import Body
from cflow_torch.simulator.scene import Scene
from cflow_torch.simulator.street import EAST, NORTH, SOUTH, WEST
from cflow_torch.simulator.trajectories import Route

HALF_WIDTH = 3.1  # of the road, metres
PAVEMENT = 1.5  # width, metres
ROAD_END = 90.0  # the houses stand at |x| up to this, metres


def build_narrow(rng: np.random.Generator) -> Scene:
    """Draw a scene from `rng`."""
    bend = float(rng.choice((-1, 1)) * rng.uniform(2e-4, 6e-4))
    slope = (rng.uniform(-0.04, 0.04), rng.uniform(-0.01, 0.01))
    ground = Ground(slope, bend, kerb=0.1, half_widths=(HALF_WIDTH, 1.0), crossing_x=NOWHERE)
    ego = Route(0.0, -1.3, EAST, speed=rng.uniform(5, 8), acceleration=-rng.uniform(0.3, 0.8))
    bodies = (*_traffic(rng), *_people(rng), *_fixed(rng))
    return Scene(ground, ego, bodies)


def _traffic(rng: np.random.Generator) -> Iterator[Body]:
    """Cars ahead and behind in the one free lane, cyclists in both directions, parked cars with gaps, a parked van."""
    yield objects.car(rng, Route(13.0, -1.3, EAST, speed=7.0, acceleration=-1.5))
    yield objects.van(rng, Route(36.0, -1.3, EAST, speed=5.0))
    yield objects.car(rng, Route(-11.0, -1.3, EAST, speed=5.0, acceleration=-0.5))
    yield objects.cyclist(rng, Route(7.0, -2.75, EAST, speed=rng.uniform(6, 7.5)))
    yield objects.cyclist(rng, Route(30.0, 0.25, WEST, speed=rng.uniform(3, 5)))
    van = int(rng.integers(3, 6))
    for number, x in enumerate(np.arange(-60, 75, 7.2).tolist()):
        route = Route(x + rng.uniform(-0.25, 0.25), HALF_WIDTH - 1.08, EAST + rng.uniform(-0.02, 0.02))
        if number % 20 == van + 8:
            yield objects.van(rng, route)
        elif rng.uniform() < 0.75:
            yield objects.car(rng, route)


def _people(rng: np.random.Generator) -> Iterator[Body]:
    """People close to the walls, and people who step into the road, three of them from behind parked cars."""
    front = HALF_WIDTH + PAVEMENT
    for side in (-1, 1):
        for x in rng.uniform(-30, 60, size=7).tolist():
            y = side * (front - rng.uniform(0.38, 0.6))
            speed = float(rng.choice((0.0, 1.0, 1.4, 1.8)))
            yield objects.pedestrian(rng, Route(x, y, float(rng.choice((EAST, WEST))), speed=speed))
    # Parked cars hide these people until they step into the road, far enough ahead of the ego car.
    for x in (15.6, 22.8, 44.4):
        yield objects.pedestrian(rng, Route(x, HALF_WIDTH + rng.uniform(0.4, 1.6), SOUTH, speed=rng.uniform(1.1, 1.8)))
    yield objects.pedestrian(rng, Route(29.0, -front + 0.7, NORTH, speed=0.7))


def _fixed(rng: np.random.Generator) -> Iterator[Body]:
    """Rows of houses with a few gateways, posts, dustbins and bushes."""
    front = HALF_WIDTH + PAVEMENT
    depth = 7.0
    for side in (-1, 1):
        x = -ROAD_END
        while x < ROAD_END:
            width = rng.uniform(5, 10)
            back = rng.choice((0.0, 0.0, rng.uniform(0.1, 0.4)))
            if rng.uniform() < 0.92:
                y = side * (front + back + depth / 2)
                yield objects.wall(x + width / 2, y, width, depth, rng.uniform(6, 14), rng.uniform(0.3, 0.6))
            x += width
        for along in np.arange(-ROAD_END, ROAD_END, 18.0).tolist():
            yield objects.pole(along, side * (HALF_WIDTH + 0.3), 5.0, 0.07)
            if rng.uniform() < 0.5:
                yield objects.wall(along + rng.uniform(2, 14), side * (front - 0.3), 0.6, 0.5, 1.1)
    for x in np.arange(-50, 70, 23.0).tolist():
        if rng.uniform() < 0.5:
            yield objects.bush(rng, x, -front + 0.35, num_leaves=25)
