"""A car park: rows of parked cars, cars that back out or search for a bay, people on foot."""

from __future__ import annotations

import math
from typing import Iterator

import numpy as np

from cflow_torch.simulator import objects
from cflow_torch.simulator.ground import NOWHERE, Ground
from cflow_torch.simulator.objects import Body
from cflow_torch.simulator.scene import Scene
from cflow_torch.simulator.street import EAST, NORTH, SOUTH, WEST
from cflow_torch.simulator.trajectories import Route

HALF_SIZE = 55.0  # half the side of the paved square, metres
AISLES = (-34.0, -17.0, 0.0, 17.0, 34.0)  # y of the middle of each aisle, metres
ROW = 5.6  # distance of the middle of a row of cars from the middle of its aisle, metres
BAY = 2.9  # width of a bay, metres
FREE_X = (15.0, 24.0)  # x of the two edges of the lane across the rows, metres


def build_car_park(rng: np.random.Generator) -> Scene:
    """Draw a scene from `rng`."""
    bend = float(rng.choice((-1, 1)) * rng.uniform(5e-5, 2e-4))
    slope = (rng.uniform(-0.02, 0.02), rng.uniform(-0.015, 0.015))
    ground = Ground(slope, bend, kerb=0.12, half_widths=(HALF_SIZE, 1.0), crossing_x=NOWHERE)
    # Along the middle aisle, then a tight turn into the lane across the rows.
    radius = 5.5
    ego = Route(sum(FREE_X) / 2 + 1.5 - radius, -1.2, EAST, -7.0, rng.uniform(2.5, 4), radius, math.pi / 2)
    bodies = (*_cars(rng), *_people(rng), *_fixed(rng))
    return Scene(ground, ego, bodies)


def _cars(rng: np.random.Generator) -> Iterator[Body]:
    """Rows of cars parked nose or tail first, with a fifth of the bays empty, and cars that back out or drive."""
    for number, aisle in enumerate(AISLES):
        driver = rng.uniform(-30, 5)
        for side, heading in ((-1, NORTH), (1, SOUTH)):
            y = aisle + side * ROW
            bays = [x for x in np.arange(-50, 52, BAY).tolist() if not FREE_X[0] - 1.5 < x < FREE_X[1] + 1.5]
            backing = rng.choice(len(bays), size=2, replace=False)
            for bay, x in enumerate(bays):
                yaw = heading + rng.uniform(-0.04, 0.04) + (math.pi if rng.uniform() < 0.3 else 0.0)
                would_collide = -20 < x < 36 if aisle == 0.0 else abs(x - driver) < 15
                if bay in backing and not would_collide:
                    route = Route(x, y + side * 0.3, heading + math.pi, speed=-rng.uniform(0.8, 1.5))
                    yield objects.car(rng, route)
                elif rng.uniform() < 0.8:
                    yield objects.car(rng, Route(x + rng.uniform(-0.1, 0.1), y + rng.uniform(-0.2, 0.2), yaw))
        if aisle != 0.0:
            towards, lane = (EAST, -1.0) if number % 2 else (WEST, 1.0)
            route = Route(driver, aisle + lane, towards, speed=rng.uniform(2, 6))
            yield objects.car(rng, route)
    yield objects.car(rng, Route(32.0, 1.2, WEST, speed=4.0, acceleration=-1.3))
    yield objects.van(rng, Route(-16.0, -1.0, EAST, speed=3.0))
    yield objects.car(rng, Route(-30.0, -18.2 + 17.0, EAST, start=-6.0, speed=3.0, radius=5.0, angle=-math.pi / 2))
    yield objects.cyclist(rng, Route(FREE_X[0] + 1.0, -25.0, NORTH, speed=4.0))


def _people(rng: np.random.Generator) -> Iterator[Body]:
    """People between the cars, in the aisles, and along the wall of the shop."""
    for x in rng.uniform(-35, 45, size=8).tolist():
        y = float(rng.choice(AISLES)) + rng.uniform(2.4, 2.5) * (1 if 0 < x < 20 else rng.choice((-1, 1)))
        yield objects.pedestrian(rng, Route(x, y, float(rng.choice((EAST, WEST))), speed=rng.uniform(0.9, 1.6)))
    for x in rng.uniform(-30, 40, size=6).tolist():  # between two neighbouring cars of a row
        between = BAY * (round((x + 50) / BAY) + 0.5) - 50
        y = float(rng.choice(AISLES)) + ROW
        yield objects.pedestrian(rng, Route(between, y, float(rng.choice((NORTH, SOUTH))), speed=rng.uniform(0.5, 1.0)))
    for x in rng.uniform(-30, 40, size=5).tolist():
        speed = float(rng.choice((0.0, 1.2)))
        yield objects.pedestrian(rng, Route(x, HALF_SIZE + rng.uniform(2, 4.5), EAST, speed=speed))


def _fixed(rng: np.random.Generator) -> Iterator[Body]:
    """The shop, a fence, lamps, shelters for trolleys, bushes and trees."""
    yield objects.wall(0.0, HALF_SIZE + 11.0, 90.0, 12.0, 7.0, albedo=0.6)
    for x in np.arange(-100, 100, 10.0).tolist():
        yield objects.wall(x, -HALF_SIZE - 1.0, 10.0, 0.08, 1.6)
        if rng.uniform() < 0.4:
            yield objects.tree(rng, x, -HALF_SIZE - rng.uniform(4, 9), num_leaves=70)
    for aisle in AISLES[1:]:
        for x in (-40.0, -5.0, 35.0):
            yield objects.pole(x, aisle - 8.5, 6.0, 0.1)
    for x in (-60.0, 60.0):
        for y in np.arange(-50, 50, 8.0).tolist():
            if rng.uniform() < 0.5:
                yield objects.bush(rng, x, y, num_leaves=30)
    for y in (-25.5, 8.5):  # two posts and a roof
        shelter = [objects.box(-1.2, 1.2, -1.0, 1.0, 2.2, 2.3, 0.6)]
        shelter += [objects.box(at - 0.04, at + 0.04, -0.9, 0.9, 0.0, 2.2, 0.3) for at in (-1.1, 1.1)]
        yield Body(shelter, Route(FREE_X[1] + 3.0 - 25.0, y))
