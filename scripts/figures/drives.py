"""Small simulated drives that are difficult: the cases of docs/limits.md, and objects that merge in a bird's-eye view.

At sweep t of the scored pair, the vehicle is at the origin and heads along x.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple, Sequence, Tuple

import numpy as np

from cflow_torch.simulator import objects
from cflow_torch.simulator.drive import Drive
from cflow_torch.simulator.ground import Ground
from cflow_torch.simulator.objects import Body, Solid, box
from cflow_torch.simulator.profiles import PROFILES
from cflow_torch.simulator.raycast import CYLINDER
from cflow_torch.simulator.scene import Scene
from cflow_torch.simulator.trajectories import Route

PAIR, NUM_SWEEPS = 5, 11  # sweep t, so that four older ones exist, and four after t+1
FLAT = Ground((0.0, 0.0), 0.0, kerb=0.0, half_widths=(1e4, 1.0), crossing_x=1e5)
EAST, NORTH, WEST = 0.0, math.pi / 2, math.pi
BORDERS = (51.2, 76.8)  # metres, half sides of regions
SECONDS = 0.1 * PAIR  # from the first sweep to sweep t
View = Tuple[float, float, float, float]


class Staged(NamedTuple):
    """A drive, and the part of it that is scored and drawn."""

    drive: Drive  # the scored pair is (PAIR, PAIR + 1)
    title: str  # the difficulty, a line
    whose: str  # names of the scored objects
    bodies: Sequence[int]  # their indices in the scene
    view: View = (-6, -6, 20, 13)  # (x0, y0, x1, y1) metres, frame of t, region of the picture


def drive_past(
    bodies: Sequence[Body], seed: int, *, ground: Ground = FLAT, profile: str = "av2", speed: float = 5, **route: float
) -> Drive:
    """A drive past bodies, straight ahead unless `route` has other arguments of `Route`."""
    scene = Scene(ground, Route(0, 0, speed=speed, **route), tuple(bodies))
    return Drive(scene, PROFILES[profile], seed, NUM_SWEEPS, "failure")


def body_of(drive: Drive) -> np.ndarray:
    """(N,) index of the body that each point of sweep t was measured on, -1 = ground."""
    return np.append(drive.scene.body_of_solid, -1)[drive.returns(PAIR).solid.numpy()]


def hedge(seed: int) -> Staged:
    """People who walk along a hedge and are in its component."""
    rng = np.random.default_rng(seed)
    leaves = [objects.bush(rng, x, 5.5 + rng.uniform(-0.2, 0.2), 60) for x in np.arange(4, 14, 1.2).tolist()]
    people = [Route(8, 4.7, EAST, start=-0.6, speed=1.2), Route(12, 4.6, WEST, start=-0.5, speed=1.0)]
    drive = drive_past([*leaves, *(objects.pedestrian(rng, route) for route in people)], seed)
    return Staged(drive, "slow people in a hedge", "two people, 1.1 m/s", [len(leaves), len(leaves) + 1])


def crowd(seed: int) -> Staged:
    rng = np.random.default_rng(seed)
    people = [objects.pedestrian(rng, Route(8, 4.5, EAST, start=-0.5, speed=1.2))]
    for x, y in ((x, y) for x in (6.5, 7.2, 7.9, 8.6, 9.3) for y in (3.9, 5.1)):
        people.append(objects.pedestrian(rng, Route(x + rng.uniform(-0.1, 0.1), y + rng.uniform(-0.1, 0.1))))
    return Staged(drive_past(people, seed), "a person in a crowd", "one person, 1.2 m/s", [0])


def tram(seed: int) -> Staged:
    long = Body([box(-16, 16, -1.3, 1.3, 0.35, 3.3, 0.6)], Route(6, 6, EAST, speed=8), "BUS", (32.0, 2.6, 3.3))
    drive = drive_past([long, objects.car(np.random.default_rng(seed), Route(12, -4, WEST, speed=8))], seed, speed=4)
    return Staged(drive, "a long side seen in two sweeps", "tram of 32 m, 8 m/s", [0], (-14, -14, 30, 18))


def appearing(seed: int, later: int = 0) -> Staged:
    """A car that comes out from behind a van, `later` sweeps after it is first visible."""
    rng = np.random.default_rng(seed)
    hidden = objects.car(rng, Route(13.9 - 0.9 * (PAIR + later) + 4.5, 7, WEST, speed=9))
    drive = drive_past([hidden, objects.van(rng, Route(8, 3.5)), objects.wall(10, 14, 30, 0.5, 4)], seed, speed=0)
    title = f"the same, {later} sweeps later" if later else "an object that appears"
    return Staged(drive, title, "car, 9 m/s", [0], (-6, -6, 24, 16))


def rolling_shutter(seed: int, profile: str = "av2_rolling") -> Staged:
    """Oncoming traffic, measured by a LiDAR whose shots have different times."""
    rng = np.random.default_rng(seed)
    bodies = [objects.car(rng, Route(x, 4, WEST, speed=27)) for x in (18, 30)]
    bodies += [objects.car(rng, Route(x, -4, EAST, speed=27)) for x in (-20, 22)]
    drive = drive_past([*bodies, objects.wall(10, 12, 60, 0.5, 4)], seed, speed=20, profile=profile)
    title = "rolling shutter" if profile == "av2_rolling" else "the same, instantaneous sweeps"
    return Staged(drive, title, "two oncoming cars, closing at 47 m/s", [0, 1], (-30, -20, 26, 21))


def rail(seed: int) -> Staged:
    """Guard rails, whose visible part moves with the vehicle."""
    posts = [box(x - 0.05, x + 0.05, -0.03, 0.03, -0.3, 0.45, 0.5) for x in (-8, -4, 0, 4, 8)]
    beam = box(-10, 10, -0.04, 0.04, 0.45, 0.76, 0.6)
    rails = [Body([beam, *posts], Route(x, y)) for x in range(-100, 140, 20) for y in (-3.2, 9.0)]
    rng = np.random.default_rng(seed)
    cars = [objects.car(rng, Route(20, 0, speed=27)), objects.car(rng, Route(-12, 4, speed=31))]
    drive, rows = drive_past([*rails, *cars], seed, speed=27), range(len(rails))
    return Staged(drive, "guard rails at speed", "static rails", rows, (-22, -25, 30, 13))


def touching(seed: int) -> Staged:
    """A car that passes close to a parked one."""
    rng = np.random.default_rng(seed)
    bodies = [objects.car(rng, Route(6, 3.0, EAST, speed=9)), objects.car(rng, Route(11, 5.05))]
    drive = drive_past([*bodies, objects.wall(10, 8, 40, 0.5, 3)], seed)
    return Staged(drive, "two cars that touch", "both: one at 9 m/s, one parked", [0, 1], (-6, -7, 20, 12))


def turning(seed: int) -> Staged:
    bus = objects.bus(Route(14, -6, NORTH, start=4, speed=7, radius=9, angle=NORTH))
    drive = drive_past([bus], seed, speed=0)
    return Staged(drive, "an object that turns", "bus, 7 m/s, 4.5 degrees a sweep", [0], (-8, -11, 22, 11))


def vertical(seed: int) -> Staged:
    """A car that drives uphill, on a road that rises by 15 %."""
    bodies = [objects.car(np.random.default_rng(seed), Route(22, -3, EAST, speed=12)), objects.wall(25, 8, 30, 0.5, 4)]
    drive = drive_past(bodies, seed, speed=3, ground=replace(FLAT, curvature=0.006))
    return Staged(drive, "vertical motion", "car that rises by 0.18 m a sweep", [0], (10, -12, 38, 6))


def fast(seed: int) -> Staged:
    rng = np.random.default_rng(seed)
    bodies = [objects.car(rng, Route(-4, 4, EAST, speed=48)), objects.car(rng, Route(-10, -4, WEST, -20, 52))]
    drive = drive_past([*bodies, objects.wall(25, 9, 30, 0.5, 4)], seed, speed=20)
    return Staged(drive, "faster than max_speed", "two cars, 48 and 52 m/s", [0, 1], (-54, -37, 40, 32))


def oncoming(seed: int) -> Staged:
    """Oncoming cars on a motorway, whose pixels of one sweep do not touch those of the next."""
    rng = np.random.default_rng(seed)
    bodies = [objects.car(rng, Route(x, 7.0, WEST, speed=27)) for x in (62, 78, 90)]
    posts = [objects.pole(x, 3.5, 0.75, 0.05) for x in range(-20, 120, 4)]
    drive = drive_past([*bodies, *posts, objects.wall(50, 12, 120, 0.3, 3)], seed, speed=27)
    return Staged(drive, "oncoming cars", "three cars at 27 m/s, 37 to 65 m ahead", [0, 1, 2], (20, -24, 80, 16))


def sparse(seed: int) -> Staged:
    """Distant traffic, seen by one LiDAR of 32 rings."""
    rng = np.random.default_rng(seed)
    bodies = [objects.car(rng, Route(x, 3.5, WEST, speed=13)) for x in (38, 48, 58)]
    bodies += [objects.car(rng, Route(x, -3.5, EAST, speed=11)) for x in (36, 50)]
    posts = [objects.pole(x, side, 6, 0.1) for x in range(0, 80, 15) for side in (-7, 7)]
    drive = drive_past([*bodies, *posts, objects.wall(40, 11, 80, 0.5, 4)], seed, profile="nuscenes", speed=8)
    whose = "five cars at 11 and 13 m/s, 32 to 52 m ahead"
    return Staged(drive, "a sparse sensor", whose, range(len(bodies)), (24, -24, 64, 16))


def far(seed: int) -> Staged:
    """Cars and people inside and outside of `point_cloud_range`."""
    rng, bodies = np.random.default_rng(seed), []
    for x in (20, 40, 82, 90):
        bodies.append(objects.car(rng, Route(x, 3.5, WEST, speed=9)))
        bodies.append(objects.pedestrian(rng, Route(x, -4, NORTH, speed=1.4)))
    drive, whose = drive_past(bodies, seed), "cars and people 82 and 90 m away"
    return Staged(drive, "outside the region", whose, [4, 5, 6, 7], (-2, -30, 96, 30))


def street(seed: int) -> Staged:
    rng = np.random.default_rng(seed)
    bodies = [
        objects.car(rng, Route(8, 3.5, WEST, speed=9)),
        objects.car(rng, Route(14, -3.5, EAST, speed=11)),
        objects.pedestrian(rng, Route(7, -6, EAST, speed=1.4)),
        objects.wall(10, 9, 30, 0.5, 4),
    ]
    return Staged(drive_past(bodies, seed), "ground left in", "two cars and a person", [0, 1, 2], (-6, -19, 28, 6))


def turn(seed: int) -> Staged:
    """A turn past a moving car, walls, parked cars and posts."""
    rng = np.random.default_rng(seed)
    bodies = [objects.car(rng, Route(12, 4, WEST, speed=9))]
    bodies += [objects.wall(20, 12, 40, 0.5, 4), objects.wall(20, -12, 40, 0.5, 4), objects.wall(45, 0, 0.5, 24, 4)]
    bodies += [objects.car(rng, Route(x, -7)) for x in (0, 7, 14, 22)]
    bodies += [objects.pole(x, 8, 5, 0.12) for x in (0, 10, 20)]
    drive, title = drive_past(bodies, seed, speed=6, radius=12, angle=1.2), "points and poses of different frames"
    return Staged(drive, title, "the static world", range(1, 11), (-4, -16, 40, 16))


def tree(seed: int) -> Staged:
    """Trees whose crowns hang over a lane, and a car below them."""
    rng = np.random.default_rng(seed)
    bodies = [objects.car(rng, _at(7 + rng.uniform(-1, 1), 4.0, WEST, 11)), objects.car(rng, _at(20, -4, EAST, 9))]
    for x in (3.5, 8.0, 12.5):
        bodies.append(objects.pole(x, 7.2, 5.0, 0.18))
        bodies += [_crown(rng, x + rng.uniform(-0.5, 0.5), y, rng.uniform(0.3, 0.9)) for y in (7.0, 5.2, 3.6)]
    return Staged(_past(bodies, seed, 5), "a car under a tree", "car, 11 m/s", [0], (-6, -7, 26, 12))


def bridge(seed: int) -> Staged:
    slab = [box(-4.5, 4.5, -14, 14, 4.7, 5.5, 0.5), box(-4.5, -4.2, -14, 14, 5.5, 6.4, 0.5)]
    abutments = [box(-4.5, 4.5, side * 10 - 1, side * 10 + 1, -1, 4.7, 0.5) for side in (-1, 1)]
    return _below(seed, Body([*slab, *abutments], Route(16, 0)), "cars under a bridge")


def gantry(seed: int) -> Staged:
    posts = [box(-0.2, 0.2, side * 9 - 0.2, side * 9 + 0.2, 0, 6.2, 0.5) for side in (-1, 1)]
    signs = [box(-0.1, 0.1, y - 1.4, y + 1.4, 4.6, 6.4, 0.8) for y in (-5.5, -2, 2, 5.5)]
    beam = box(-0.2, 0.2, -9, 9, 5.6, 6.0, 0.5)
    return _below(seed, Body([beam, *posts, *signs], Route(16, 0)), "cars under a gantry")


def _below(seed: int, above: Body, title: str) -> Staged:
    rng = np.random.default_rng(seed)
    routes = (_at(16, 4, WEST, 16), _at(15, -3.5, EAST, 14), _at(18, 7, WEST, 22))
    cars = [objects.car(rng, route) for route in routes]
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
    """Two people who walk along house fronts in opposite directions; `gap` is metres from shoulders to wall."""
    rng = np.random.default_rng(seed)
    y = 6.0 - gap - 0.25
    routes = [_at(x + rng.uniform(-0.5, 0.5), y, to, speed) for x, to, speed in ((4, EAST, 1.2), (10, WEST, 1.4))]
    people = [objects.pedestrian(rng, route) for route in routes]
    fronts = [objects.wall(x, 10, 9.7, 8, rng.uniform(5, 9)) for x in (-24, -14, -4, 6, 16, 26)]
    pipes = [objects.pole(x, 5.95, 5, 0.05) for x in (-19, -9, 1, 11, 21)]
    drive = _past([*people, *fronts, *pipes], seed, 3)
    return Staged(drive, f"walkers {gap:g} m from a wall", "two people, 1.2 and 1.4 m/s", [0, 1], (-6, -4, 20, 12))


def facade(seed: int, step: float = 0.55, profile: str = "av2") -> Staged:
    """Houses behind parked cars, whose shadows move over the fronts by `step` metres of the vehicle per 0.1 s."""
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


def abreast(seed: int) -> Staged:
    """Two cars side by side at different speeds, and a car close to a wall."""
    rng = np.random.default_rng(seed)
    routes = (_at(8, 3.2, EAST, 9), _at(9, 5.2, EAST, 13), _at(12, -4.0, WEST, 10))
    drive = _past([*(objects.car(rng, route) for route in routes), objects.wall(10, -5.4, 50, 0.5, 2.5)], seed, 6)
    return Staged(drive, "cars abreast, a car along a wall", "three cars, 9-13 m/s", [0, 1, 2], (-6, -8, 26, 10))


def border(seed: int) -> Staged:
    """Static objects on the borders of two regions, and moving cars and buses that cross them."""
    rng = np.random.default_rng(seed)
    moving, static = [], []
    for edge in BORDERS:
        out, back, aside, *at_edge = rng.uniform(0, 1, 6).tolist()
        # The visible side is within a metre of the border: 2.2 m from the middle of a car, 6 m from that of a bus.
        moving.append(objects.car(rng, _at(edge + 2.2 - out, 3, EAST, 14)))
        moving.append(objects.bus(_at(2, edge + 6 - aside, NORTH, 9)))
        moving.append(objects.car(rng, _at(edge + 2.2 + back, -3, WEST, 12)))
        moving.append(objects.car(rng, _at(-edge - 1.7, -3, WEST, 10)))
        static += [objects.car(rng, Route(-edge - 2.7 + x, y)) for x, y in zip(at_edge, (6, 9))]
        static += [objects.wall(edge, 8, 12, 0.3, 3), objects.car(rng, Route(7, -edge - 1.4 + at_edge[2]))]
    drive = _past([*moving, *static], seed, 5)
    return Staged(drive, "the region's border", "cars and buses", list(range(len(moving))), (-82, -82, 82, 82))


def _fronts(rng: np.random.Generator, front: float) -> list[Body]:
    """A row of houses along y = `front` with pilasters, window sills, doorsteps and drain pipes."""
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
    """The crown of a tree without its trunk, lifted by `lift` metres."""
    leaves = objects.tree(rng, x, y, 90).solids[1:]
    return Body([leaf._replace(centre=(*leaf.centre[:2], leaf.centre[2] + lift)) for leaf in leaves], Route(x, y))


def _wire(x: float, y: float, z: float, length: float, across: bool = False) -> Solid:
    rotation = {"roll": math.pi / 2} if across else {"pitch": math.pi / 2}
    return Solid(CYLINDER, (x, y, z), (0.02, 0.02, length / 2), albedo=0.4, **rotation)


def _at(x: float, y: float, heading: float, speed: float) -> Route:
    """A straight route that is at (x, y) at sweep t."""
    return Route(x, y, heading, start=-speed * SECONDS, speed=speed)


def _past(bodies: Sequence[Body], seed: int, speed: float, **more: Any) -> Any:
    return drive_past(bodies, seed, speed=speed, start=-speed * SECONDS, **more)
