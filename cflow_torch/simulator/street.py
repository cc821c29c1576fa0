"""Two streets that cross, with buildings, trees and traffic, drawn at random from one generator.

The main street runs along x (right-hand traffic, two lanes a side), the cross street along y at `crossing_x`. The ego
car comes along the main street and turns left. Vehicles do not collide during the first seconds.
"""

from __future__ import annotations

import math
from typing import Iterator

import numpy as np

from cflow_torch.simulator import objects
from cflow_torch.simulator.ground import Ground
from cflow_torch.simulator.objects import Body
from cflow_torch.simulator.scene import Scene
from cflow_torch.simulator.trajectories import Route

EAST, NORTH, WEST, SOUTH = 0.0, math.pi / 2, math.pi, -math.pi / 2
PAVEMENT = 4.0  # width, metres
ROAD_END = 110.0  # houses and trees stand up to this far along each street, metres


def build_street(rng: np.random.Generator) -> Scene:
    """Draw a scene from `rng`."""
    bend = float(rng.choice((-1, 1)) * rng.uniform(2e-4, 7e-4))
    ground = Ground(slope=(rng.uniform(-0.03, 0.03), rng.uniform(-0.02, 0.02)), curvature=bend)
    crossing = ground.crossing_x
    # From the lane at y = -1.6 into the one at x = crossing + 1.75. At time 0, the bend is a metre ahead.
    ego = Route(crossing - 16.25, -1.6, EAST, start=-1.0, speed=rng.uniform(5, 7), radius=18.0, angle=math.pi / 2)
    bodies = (*_traffic(rng, crossing), *_people(rng, crossing), *_parked(rng, ground), *_fixed(rng, ground))
    return Scene(ground, ego, bodies)


def lane(rng: np.random.Generator, y: float, heading: float, speed: float, *xs: float) -> Iterator[Body]:
    """Cars near `xs` in a lane along x, all at the same speed."""
    for x in xs:
        route = Route(x + rng.uniform(-1.2, 1.2), y + rng.uniform(-0.12, 0.12), heading, speed=speed)
        yield objects.car(rng, route)


def _traffic(rng: np.random.Generator, crossing: float) -> Iterator[Body]:
    """Cars, a bus, an articulated truck and cyclists on the road."""
    # Eastbound: fast cars far ahead, a car behind the ego car, and in the outer lane a bus with two cars behind it.
    yield from lane(rng, -1.6, EAST, rng.uniform(15, 20), crossing + 14, crossing + 29, crossing + 45)
    yield from lane(rng, -1.6, EAST, 4.5, -14)
    yield from lane(rng, -4.6, EAST, rng.uniform(9, 14), crossing + 35, crossing + 50)
    bus_speed = rng.uniform(3, 6)
    yield objects.bus(Route(-11.0, -4.6, EAST, speed=bus_speed))
    yield from lane(rng, -4.6, EAST, bus_speed, -26, -38)
    # Westbound: cars that have passed the crossing, and cars that wait before it.
    yield from lane(rng, 1.6, WEST, rng.uniform(8, 13), 5, -14, -31, -52)
    yield from lane(rng, 4.6, WEST, rng.uniform(6, 10), -6, -24, -42)
    yield from lane(rng, 1.6, WEST, 0.0, crossing + 14, crossing + 21.5, crossing + 29)
    yield from lane(rng, 4.6, WEST, 0.0, crossing + 14, crossing + 21.5)
    # From the cross street, a car turns right (to the west) and an articulated truck turns right (to the east).
    arc = {"radius": 9.0, "angle": -math.pi / 2}
    route = Route(crossing - 1.75, 4.6 + 9.0, SOUTH, start=rng.uniform(0, 4), speed=rng.uniform(4, 6), **arc)
    yield objects.car(rng, route)
    route = Route(crossing + 1.75, -4.6 - 12, NORTH, rng.uniform(5, 10), rng.uniform(3, 5), 12.0, -math.pi / 2)
    yield from objects.articulated_truck(route)
    # Cyclists keep to the edge, close to parked cars.
    for x, y, heading in ((6.0, -6.05, EAST), (crossing + 3.6, 18.0, NORTH), (crossing + 33, -6.05, EAST)):
        yield objects.cyclist(rng, Route(x, y, heading, rng.uniform(-1, 1), rng.uniform(4.5, 7)))


def _people(rng: np.random.Generator, crossing: float) -> Iterator[Body]:
    """Pedestrians along the houses, in a group, and across the street; some do not move."""
    for side in (-1, 1):
        for x in rng.uniform(-35, 65, size=7):
            if abs(x - crossing) > 8:
                heading = EAST if rng.uniform() < 0.5 else WEST
                y = side * rng.uniform(9.5, 11.8)
                yield objects.pedestrian(rng, Route(x, y, heading, speed=rng.choice((0.0, 1.0, 1.4, 1.8))))
    # One close to a wall (houses begin at y = 12.5), a group of three, and two who cross each street.
    yield objects.pedestrian(rng, Route(-4.0, 12.15, EAST, speed=1.4))
    for k in range(3):
        yield objects.pedestrian(rng, Route(crossing - 9.2 + 0.1 * k, 17 + 0.75 * k, NORTH, speed=1.3))
    yield objects.pedestrian(rng, Route(crossing + 8.6, 7.0, SOUTH, speed=rng.uniform(1.1, 1.7)))
    yield objects.pedestrian(rng, Route(crossing + 9.4, 1.5, NORTH, speed=rng.uniform(1.1, 1.7)))
    yield objects.pedestrian(rng, Route(crossing - 5.5, -10.3, EAST, speed=rng.uniform(1.1, 1.4)))
    yield objects.pedestrian(rng, Route(crossing - 3.0, -10.9, WEST, speed=rng.uniform(1.1, 1.7)))


def _parked(rng: np.random.Generator, ground: Ground) -> Iterator[Body]:
    """Cars along the kerbs."""
    (main, cross), crossing = ground.half_widths, ground.crossing_x
    for along in np.arange(-60, 85, 6.4).tolist():
        for side in (-1, 1):
            pose = (along + rng.uniform(-0.4, 0.4), side * (main - 1.05), EAST + rng.uniform(-0.02, 0.02))
            behind_hoarding = side > 0 and -36 < along < -12
            if rng.uniform() < 0.6 and abs(along - crossing) > 17 and not behind_hoarding:
                yield objects.car(rng, Route(*pose))
            pose = (crossing + side * (cross - 1.1), along + rng.uniform(-0.4, 0.4), NORTH + rng.uniform(-0.02, 0.02))
            if rng.uniform() < 0.6 and abs(along) > 19:
                yield objects.car(rng, Route(*pose))


def _fixed(rng: np.random.Generator, ground: Ground) -> Iterator[Body]:
    """Houses, walls, poles, trees, bushes."""
    yield from houses(rng, ground)
    main = ground.half_widths[0]
    crossing = ground.crossing_x
    # A hoarding 0.2-0.6 m from moving cars, and a garden wall that parked cars almost touch.
    yield objects.wall(-24.0, 5.95, 20.0, 0.1, 2.0, albedo=0.7)
    yield objects.wall(crossing + 36.0, -main - 0.1, 24.0, 0.15, 1.1)
    yield from furniture(rng, ground)


def furniture(rng: np.random.Generator, ground: Ground) -> Iterator[Body]:
    """Lamps, signs, trees and bushes on the pavements."""
    (main, cross), crossing = ground.half_widths, ground.crossing_x
    for side in (-1, 1):
        for along in np.arange(-ROAD_END, ROAD_END, 12.0).tolist():
            green = along + rng.uniform(4, 8)
            if abs(along - crossing) > cross + PAVEMENT:
                yield objects.pole(along, side * (main + 0.6), 7.0, 0.09)
            if abs(green - crossing) > cross + PAVEMENT + 2:
                if rng.uniform() < 0.7:
                    yield objects.tree(rng, green, side * (main + 1.4))
                if rng.uniform() < 0.6:
                    yield objects.bush(rng, green, side * (main + PAVEMENT - 0.7))
            if abs(along) > main + PAVEMENT:
                yield objects.pole(crossing + side * (cross + 0.6), along, 7.0, 0.09)
            if abs(green) > main + PAVEMENT + 2 and rng.uniform() < 0.6:
                yield objects.tree(rng, crossing + side * (cross + 1.4), green)
        for corner in (-1, 1):
            yield objects.pole(crossing + side * (cross + 2.2), corner * (main + 2.2), 3.2, 0.06, sign=0.7)


def houses(rng: np.random.Generator, ground: Ground) -> Iterator[Body]:
    """Rows of houses behind the pavements, with gaps and set-backs."""
    (main, cross), crossing = ground.half_widths, ground.crossing_x
    main_front = main + PAVEMENT
    cross_front = cross + PAVEMENT
    depth = 8.0

    def row(begin: float, end: float) -> Iterator[tuple[float, float, float]]:
        """(middle, width, set-back) of each house of a row."""
        while begin < end:
            width = rng.uniform(6, 12)
            if rng.uniform() < 0.85:
                yield begin + width / 2, width, rng.choice((0.0, 0.0, rng.uniform(0.3, 2.0)))
            begin += width

    for side in (-1, 1):
        for first, last in ((-ROAD_END, crossing - cross_front - 12), (crossing + cross_front, crossing + ROAD_END)):
            for middle, width, back in row(first, last):
                y = side * (main_front + back + depth / 2)
                yield objects.wall(middle, y, width, depth, rng.uniform(5, 12), rng.uniform(0.3, 0.6))
        for corner in (-1, 1):
            for middle, width, back in row(main_front, ROAD_END):
                x = crossing + side * (cross_front + back + depth / 2)
                yield objects.wall(x, corner * middle, depth, width, rng.uniform(5, 12), rng.uniform(0.3, 0.6))
