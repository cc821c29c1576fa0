"""A crossing without traffic lights: vehicles from all four sides turn, stop and start, and people cross."""

from __future__ import annotations

import math
from typing import Iterator

import numpy as np

from cflow_torch.simulator import objects
from cflow_torch.simulator.ground import Ground
from cflow_torch.simulator.objects import Body
from cflow_torch.simulator.scene import Scene
from cflow_torch.simulator.street import EAST, NORTH, PAVEMENT, SOUTH, WEST, furniture, houses, lane
from cflow_torch.simulator.trajectories import Route

HALF_WIDTH = 7.0  # half the width of both streets, metres
STOP = HALF_WIDTH + 5.5  # distance of the stop lines from the middle of the crossing, metres


def build_crossing(rng: np.random.Generator) -> Scene:
    """Draw a scene from `rng`."""
    bend = float(rng.choice((-1, 1)) * rng.uniform(1e-4, 4e-4))
    slope = (rng.uniform(-0.02, 0.02), rng.uniform(-0.02, 0.02))
    ground = Ground(slope, bend, half_widths=(HALF_WIDTH, HALF_WIDTH), crossing_x=0.0, corner_radius=5.0)
    right = bool(rng.uniform() < 0.5)
    if right:  # a turn to the right, then down the cross street
        speed = rng.uniform(4, 6)
        radius = 7.5
        ego = Route(-1.75 - radius, -1.75, EAST, start=-4.0, speed=speed, radius=radius, angle=-math.pi / 2)
    else:  # straight across, after a rolling stop
        ego = Route(-16.0, -1.75, EAST, speed=rng.uniform(3, 5), acceleration=rng.uniform(1.0, 2.0))
    bodies = (*_traffic(rng), *_people(rng), *_parked(rng), *houses(rng, ground), *furniture(rng, ground))
    return Scene(ground, ego, bodies)


def _traffic(rng: np.random.Generator) -> Iterator[Body]:
    """In the first seconds, vehicles in the cross street stay clear of the ego lane or wait at their stop line."""
    # Ahead of the ego car, behind it, and towards it.
    yield from lane(rng, -1.75, EAST, rng.uniform(9, 14), 14, 27, 45)
    yield objects.car(rng, Route(-27.0, -1.75, EAST, speed=6.0, acceleration=-1.2))
    yield from lane(rng, 1.75, WEST, rng.uniform(8, 12), -18, -33, -52)
    yield objects.car(rng, Route(34.0, 1.75, WEST, speed=12.0, acceleration=-3.5))
    yield objects.van(rng, Route(55.0, 1.75, WEST, speed=10.0, acceleration=-1.0))
    # A car turns left across the ego lane. A truck is parked among the houses in the north-west.
    yield objects.car(rng, Route(9.0, 5.1, WEST, rng.uniform(4, 7), rng.uniform(4, 6), 11.0, math.pi / 2))
    truck = Route(-1.75 - 12 - 3.5, HALF_WIDTH + 20.0, SOUTH, speed=0.0)
    yield from objects.articulated_truck(truck)
    # In the cross street, northbound and southbound.
    for x, heading, first in ((1.75, NORTH, 13.0), (-1.75, SOUTH, -13.0)):
        speed = rng.uniform(8, 14)
        for number in range(3):
            along = first + math.copysign(14.0 * number + rng.uniform(-1, 1), first)
            yield objects.car(rng, Route(x, along, heading, speed=speed))
        waiting = -math.copysign(STOP + rng.uniform(3.0, 4.0), first)
        yield objects.car(rng, Route(x, waiting, heading))
        coming = waiting - math.copysign(17.0, first)
        yield objects.car(rng, Route(x, coming, heading, speed=7.0, acceleration=-3.0))
    yield objects.cyclist(rng, Route(-10.0, -4.3, EAST, speed=rng.uniform(4.5, 7)))
    yield objects.cyclist(rng, Route(4.3, -20.0, NORTH, speed=rng.uniform(4.5, 7)))
    yield objects.cyclist(rng, Route(26.0, 4.3, WEST, speed=rng.uniform(4.5, 7)))


def _people(rng: np.random.Generator) -> Iterator[Body]:
    """People on the zebra crossings of the east and north arms, at the corners, and along the houses."""
    zebra = HALF_WIDTH + 2.8
    for k in range(4):
        # One on the zebra crossing of the east arm, one on that of the north arm.
        y = rng.uniform(-6, 6)
        yield objects.pedestrian(rng, Route(zebra + 0.6 * k - 1, y, rng.choice((NORTH, SOUTH)), speed=1.3))
        x = rng.uniform(3.5, 6.5) * rng.choice((-1, 1))
        yield objects.pedestrian(rng, Route(x, zebra + 0.6 * k - 1, rng.choice((EAST, WEST)), speed=1.4))
    for corner_x in (-1, 1):
        for corner_y in (-1, 1):
            x, y = corner_x * (HALF_WIDTH + 2.2), corner_y * (HALF_WIDTH + 2.2)
            for _ in range(2):
                at = (x + rng.uniform(-0.8, 0.8), y + rng.uniform(-0.8, 0.8))
                yield objects.pedestrian(rng, Route(*at, rng.uniform(0, 6), speed=float(rng.choice((0.0, 1.0)))))
    for side in (-1, 1):
        for x in rng.uniform(-50, 50, size=5).tolist():
            if abs(x) > STOP:
                y = side * (HALF_WIDTH + PAVEMENT - rng.uniform(0.35, 1.5))
                yield objects.pedestrian(rng, Route(x, y, float(rng.choice((EAST, WEST))), speed=rng.uniform(1, 1.8)))


def _parked(rng: np.random.Generator) -> Iterator[Body]:
    for along in np.arange(24, 90, 6.4).tolist():
        for arm in (-1, 1):
            for side in (-1, 1):
                if rng.uniform() < 0.6:
                    yield objects.car(rng, Route(arm * along, side * (HALF_WIDTH - 1.0)))
                if rng.uniform() < 0.6:
                    yield objects.car(rng, Route(side * (HALF_WIDTH - 1.0), arm * along, NORTH))
