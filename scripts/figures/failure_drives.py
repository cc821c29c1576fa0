"""Drives of docs/limits.md that are scored elsewhere too, and what small simulated drives are made of."""

from __future__ import annotations

import math
from typing import NamedTuple, Sequence, Tuple

import numpy as np

from cflow_torch.simulator import objects
from cflow_torch.simulator.drive import Drive
from cflow_torch.simulator.ground import Ground
from cflow_torch.simulator.objects import Body, Route, box
from cflow_torch.simulator.profiles import get_profile
from cflow_torch.simulator.scene import Scene, SolidTable

PAIR, NUM_SWEEPS = 5, 11  # sweep t, so that four older ones exist, and four after t+1
FLAT = Ground((0.0, 0.0), 0.0, kerb=0.0, half_widths=(1e4, 1.0), crossing_x=1e5)
EAST, NORTH, WEST = 0.0, math.pi / 2, math.pi
View = Tuple[float, float, float, float]


class Staged(NamedTuple):
    """A drive, and what of it is looked at.

    Args:
        drive: the pair that counts is (PAIR, PAIR + 1).
        title: what is hard, a line.
        whose: the points that the error is of.
        bodies: their numbers in the scene.
        view: (x0, y0, x1, y1) metres, frame of t, what a picture shows.
    """

    drive: Drive
    title: str
    whose: str
    bodies: Sequence[int]
    view: View = (-6, -6, 20, 13)


def drive_past(
    bodies: Sequence[Body], seed: int, *, ground: Ground = FLAT, profile: str = "av2", speed: float = 5, **way: float
) -> Drive:
    """A drive past bodies, straight on if `way` does not say otherwise."""
    scene = Scene(ground, Route(0, 0, speed=speed, **way), tuple(bodies), SolidTable.of(tuple(bodies)))
    return Drive(scene, get_profile(profile), seed, NUM_SWEEPS, "failure")


def body_of(drive: Drive) -> np.ndarray:
    """(N,) number of the body that each point of sweep t lies on, -1 = ground."""
    return np.append(drive.scene.table.body, -1)[drive.returns(PAIR).solid.numpy()]


def hedge(seed: int) -> Staged:
    """People who walk along a hedge, within its component."""
    rng = np.random.default_rng(seed)
    leaves = [objects.bush(rng, x, 5.5 + rng.uniform(-0.2, 0.2), 60) for x in np.arange(4, 14, 1.2).tolist()]
    people = [Route(8, 4.7, EAST, start=-0.6, speed=1.2), Route(12, 4.6, WEST, start=-0.5, speed=1.0)]
    drive = drive_past([*leaves, *(objects.pedestrian(rng, way) for way in people)], seed)
    return Staged(drive, "slow people in a hedge", "two people, 1.1 m/s", [len(leaves), len(leaves) + 1])


def crowd(seed: int) -> Staged:
    """Somebody who walks through a group that stands."""
    rng = np.random.default_rng(seed)
    people = [objects.pedestrian(rng, Route(8, 4.5, EAST, start=-0.5, speed=1.2))]
    for x, y in ((x, y) for x in (6.5, 7.2, 7.9, 8.6, 9.3) for y in (3.9, 5.1)):
        people.append(objects.pedestrian(rng, Route(x + rng.uniform(-0.1, 0.1), y + rng.uniform(-0.1, 0.1))))
    return Staged(drive_past(people, seed), "a person in a crowd", "who walks, 1.2 m/s", [0])


def tram(seed: int) -> Staged:
    """A tram of 32 m."""
    long = Body([box(-16, 16, -1.3, 1.3, 0.35, 3.3, 0.6)], Route(6, 6, EAST, speed=8), "BUS", (32.0, 2.6, 3.3))
    drive = drive_past([long, objects.car(np.random.default_rng(seed), Route(12, -4, WEST, speed=8))], seed, speed=4)
    return Staged(drive, "longer than 25 m", "tram of 32 m, 8 m/s", [0], (-14, -14, 30, 18))


def appearing(seed: int, later: int = 0) -> Staged:
    """A car that comes out from behind a van, so many sweeps later than that it is first seen."""
    rng = np.random.default_rng(seed)
    hidden = objects.car(rng, Route(13.9 - 0.9 * (PAIR + later) + 4.5, 7, WEST, speed=9))
    drive = drive_past([hidden, objects.van(rng, Route(8, 3.5)), objects.wall(10, 14, 30, 0.5, 4)], seed, speed=0)
    return Staged(drive, "an object that appears", "car, 9 m/s", [0], (-6, -6, 24, 16))


def rolling_shutter(seed: int, profile: str = "av2_rolling") -> Staged:
    """Oncoming traffic under a sensor that turns while the world moves."""
    rng = np.random.default_rng(seed)
    bodies = [objects.car(rng, Route(x, 4, WEST, speed=27)) for x in (18, 30)]
    bodies += [objects.car(rng, Route(x, -4, EAST, speed=27)) for x in (-20, 22)]
    drive = drive_past([*bodies, objects.wall(10, 12, 60, 0.5, 4)], seed, speed=20, profile=profile)
    return Staged(drive, "rolling shutter", "two oncoming cars, closing at 47 m/s", [0, 1], (-30, -20, 26, 21))
