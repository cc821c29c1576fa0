"""Drives in which a bird's-eye view merges what moves with what stands: below crowns, bridges and wires, beside walls.

The vehicle is at the origin, heading along x, at the sweep that counts.
"""

from __future__ import annotations

import math
from typing import Any, List, Sequence

import numpy as np
from failure_drives import EAST, NORTH, PAIR, WEST, Staged, drive_past

from cflow_torch.simulator import objects
from cflow_torch.simulator.objects import Body, Route, Solid, box
from cflow_torch.simulator.raycast import CYLINDER

BORDERS = (51.2, 76.8)  # metres, half sides of regions
SECONDS = 0.1 * PAIR  # from the first sweep to the one that counts


def tree(seed: int) -> Staged:
    """Trees whose crowns hang over a lane, and a car below them."""
    rng = np.random.default_rng(seed)
    bodies = [objects.car(rng, _at(7 + rng.uniform(-1, 1), 4.0, WEST, 11)), objects.car(rng, _at(20, -4, EAST, 9))]
    for x in (3.5, 8.0, 12.5):
        bodies.append(objects.pole(x, 7.2, 5.0, 0.18))
        bodies += [_crown(rng, x + rng.uniform(-0.5, 0.5), y, rng.uniform(0.3, 0.9)) for y in (7.0, 5.2, 3.6)]
    return Staged(_past(bodies, seed, 5), "a car under a tree", "car, 11 m/s", [0], (-6, -7, 26, 12))


def bridge(seed: int) -> Staged:
    """A bridge of 9 m across the road, cars below it."""
    slab = [box(-4.5, 4.5, -14, 14, 4.7, 5.5, 0.5), box(-4.5, -4.2, -14, 14, 5.5, 6.4, 0.5)]
    abutments = [box(-4.5, 4.5, side * 10 - 1, side * 10 + 1, -1, 4.7, 0.5) for side in (-1, 1)]
    return _below(seed, Body([*slab, *abutments], Route(16, 0)), "cars under a bridge")


def gantry(seed: int) -> Staged:
    """A gantry with signs over the lanes, cars below it."""
    posts = [box(-0.2, 0.2, side * 9 - 0.2, side * 9 + 0.2, 0, 6.2, 0.5) for side in (-1, 1)]
    signs = [box(-0.1, 0.1, y - 1.4, y + 1.4, 4.6, 6.4, 0.8) for y in (-5.5, -2, 2, 5.5)]
    return _below(
        seed, Body([box(-0.2, 0.2, -9, 9, 5.6, 6.0, 0.5), *posts, *signs], Route(16, 0)), "cars under a gantry"
    )


def _below(seed: int, above: Body, title: str) -> Staged:
    rng = np.random.default_rng(seed)
    ways = (_at(16, 4, WEST, 16), _at(15, -3.5, EAST, 14), _at(18, 7, WEST, 22))
    cars = [objects.car(rng, way) for way in ways]
    return Staged(_past([*cars, above], seed, 12), title, "three cars, 14-22 m/s", [0, 1, 2], (-6, -16, 34, 16))


def wires(seed: int) -> Staged:
    """Wires of a tramway along two lanes and across them, cars below."""
    rng = np.random.default_rng(seed)
    along = [_wire(0, y, z, 120) for y in (3.5, -3.5) for z in (4.6, 5.4)]
    across = [_wire(x, 0, 5.0, 20, across=True) for x in (4, 9, 14, 19)]
    posts = [objects.pole(x, y, 6.0, 0.12) for x in (4, 9, 14, 19) for y in (-10, 10)]
    cars = [objects.car(rng, _at(x, y, to, speed)) for x, y, to, speed in ((8, 3.5, WEST, 8), (14, -3.5, EAST, 10))]
    drive = _past([*cars, Body([*along, *across], Route(0, 0)), *posts], seed, 5)
    return Staged(drive, "cars under wires", "two cars, 8 and 10 m/s", [0, 1], (-6, -12, 26, 12))


def walkers(seed: int, gap: float = 0.3) -> Staged:
    """Two people who walk along house fronts, one each way.

    Args:
        seed: of the people, the street and the noise.
        gap: metres from their shoulders to the wall.
    """
    rng = np.random.default_rng(seed)
    y = 6.0 - gap - 0.25
    ways = [_at(x + rng.uniform(-0.5, 0.5), y, to, speed) for x, to, speed in ((4, EAST, 1.2), (10, WEST, 1.4))]
    people = [objects.pedestrian(rng, way) for way in ways]
    fronts = [objects.wall(x, 10, 9.7, 8, rng.uniform(5, 9)) for x in (-24, -14, -4, 6, 16, 26)]
    pipes = [objects.pole(x, 5.95, 5, 0.05) for x in (-19, -9, 1, 11, 21)]
    drive = _past([*people, *fronts, *pipes], seed, 3)
    return Staged(drive, f"walkers {gap:g} m from a wall", "two people, 1.2 and 1.4 m/s", [0, 1], (-6, -4, 20, 12))


def train(seed: int) -> Staged:
    """Three cars of 20 m with doors that lie 0.15 m back."""
    solids = [box(x - 10, x + 10, -1.15, 1.15, 0.3, 3.4, 0.6) for x in (-20.4, 0.0, 20.4)]
    # Between the doors the sides stand out.
    panels = [x + of_door for x in (-20.4, 0.0, 20.4) for of_door in (-7.5, -2.5, 2.5, 7.5)]
    solids += [box(x - 1.6, x + 1.6, -1.3, 1.3, 0.3, 3.4, 0.6) for x in panels]
    long = Body(solids, _at(4, 7, EAST, 12), "BUS", (60.8, 2.6, 3.4))
    rng = np.random.default_rng(seed)
    fixed = [objects.wall(5, 11, 60, 3, 0.9), objects.wall(5, -9, 60, 0.5, 3)]  # a platform behind it, a wall
    drive = _past([long, objects.car(rng, _at(14, -4, WEST, 9)), *fixed], seed, 6)
    return Staged(drive, "a train", "train of 61 m, 12 m/s", [0], (-32, -10, 44, 16))


def abreast(seed: int) -> Staged:
    """Two cars side by side at different speeds, and one close along a wall."""
    rng = np.random.default_rng(seed)
    ways = (_at(8, 3.2, EAST, 9), _at(9, 5.2, EAST, 13), _at(12, -4.0, WEST, 10))
    drive = _past([*(objects.car(rng, way) for way in ways), objects.wall(10, -5.4, 50, 0.5, 2.5)], seed, 6)
    return Staged(drive, "cars abreast, a car along a wall", "three cars, 9-13 m/s", [0, 1, 2], (-6, -8, 26, 10))


def border(seed: int) -> Staged:
    """What stands on the borders of two regions, and what crosses them: cars, a bus, a wall."""
    rng = np.random.default_rng(seed)
    movers, fixed = [], []
    for edge in BORDERS:
        out, back, aside, *at_edge = rng.uniform(0, 1, 6).tolist()
        # The side that is seen lies within a metre of the border: 2.2 m off a car's middle, 6 m off a bus's.
        movers += [
            objects.car(rng, _at(edge + 2.2 - out, 3, EAST, 14)),
            objects.bus(_at(2, edge + 6 - aside, NORTH, 9)),
        ]
        movers += [
            objects.car(rng, _at(edge + 2.2 + back, -3, WEST, 12)),
            objects.car(rng, _at(-edge - 1.7, -3, WEST, 10)),
        ]
        fixed += [objects.car(rng, Route(-edge - 2.7 + x, y)) for x, y in zip(at_edge, (6, 9))]
        fixed += [objects.wall(edge, 8, 12, 0.3, 3), objects.car(rng, Route(7, -edge - 1.4 + at_edge[2]))]
    drive = _past([*movers, *fixed], seed, 5)
    return Staged(drive, "the region's border", "cars and buses", list(range(len(movers))), (-82, -82, 82, 82))


def facade(seed: int, step: float = 0.55, profile: str = "av2") -> Staged:
    """Houses along the road behind parked cars, whose shadows glide over the fronts as the vehicle passes.

    Args:
        seed: of the street and of the noise.
        step: metres that the vehicle drives in a sweep of 0.1 s.
        profile: of the sensors.
    """
    rng = np.random.default_rng(seed)
    bodies = [objects.car(rng, _at(22, 3.2, WEST, 8)), objects.car(rng, _at(13, 0, EAST, 8))]
    for kerb, front in ((-4.3, -7.0), (7.5, 10.2)):
        side, x = math.copysign(1.0, kerb), -45.0
        while x < 60:
            make = objects.van if rng.uniform() < 0.25 else objects.car
            bodies.append(make(rng, Route(x, kerb - side * rng.uniform(1.0, 1.1), rng.uniform(-0.02, 0.02))))
            x += rng.uniform(6.2, 9.5)
        bodies += _fronts(rng, front)
    drive = _past(bodies, seed, 10 * step, profile=profile)
    return Staged(drive, "a façade behind parked cars", "two cars, 8 m/s", [0, 1], (-20, -12, 30, 14))


def _fronts(rng: np.random.Generator, front: float) -> List[Body]:
    """House after house along y = `front`: with pilasters, window sills, doorsteps and drain pipes."""
    houses, begin, side = [], -50.0, math.copysign(1.0, front)
    while begin < 65:
        width, back, pitch = rng.uniform(8, 14), rng.choice((0.0, 0.0, 0.3)), rng.uniform(1.8, 2.6)
        y, height = front + side * back, rng.uniform(6, 11)
        houses.append(objects.wall(begin + width / 2, y + side * 4, width, 8, height, rng.uniform(0.3, 0.6)))
        for x in np.arange(begin + 0.9, begin + width - 0.6, pitch).tolist():
            if rng.uniform() < 0.15:
                parts = [box(-0.6, 0.6, -0.4, 0.4, -0.1, 0.35, 0.5)]  # a doorstep
            else:
                parts = [box(-0.55, 0.55, -0.12, 0.12, z, z + 0.12, 0.5) for z in (0.9, 3.7)]  # sills of two windows
            houses.append(Body([*parts, box(0.75, 0.95, -0.08, 0.08, 0.0, 5.0, 0.5)], Route(x, y)))  # and a pilaster
        houses.append(objects.pole(begin, front - side * 0.1, 6, 0.06))
        begin += width + (rng.uniform(1, 3) if rng.uniform() < 0.2 else 0.0)
    return houses


def _crown(rng: np.random.Generator, x: float, y: float, lift: float) -> Body:
    """The crown of a tree without its trunk, `lift` metres higher than it would be."""
    leaves = objects.tree(rng, x, y, 90).solids[1:]
    return Body([leaf._replace(centre=(*leaf.centre[:2], leaf.centre[2] + lift)) for leaf in leaves], Route(x, y))


def _wire(x: float, y: float, z: float, length: float, across: bool = False) -> Solid:
    turn = {"roll": math.pi / 2} if across else {"pitch": math.pi / 2}
    return Solid(CYLINDER, (x, y, z), (0.02, 0.02, length / 2), albedo=0.4, **turn)


def _at(x: float, y: float, heading: float, speed: float) -> Route:
    """Straight on through a place at the sweep that counts."""
    return Route(x, y, heading, start=-speed * SECONDS, speed=speed)


def _past(bodies: Sequence[Body], seed: int, speed: float, **more: Any) -> Any:
    return drive_past(bodies, seed, speed=speed, start=-speed * SECONDS, **more)
