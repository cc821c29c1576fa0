"""Small simulated drives in which the method fails, one function each, first with a setting that fails, then mended."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from cflow_torch import FlowResult, Sweep, estimate_flow, make_config, make_model
from cflow_torch.data.log import Log, window
from cflow_torch.simulator import objects
from cflow_torch.simulator.drive import Drive
from cflow_torch.simulator.ground import Ground
from cflow_torch.simulator.objects import Body, Route, box
from cflow_torch.simulator.profiles import get_profile
from cflow_torch.simulator.scene import Scene, SolidTable

PAIR, NUM_SWEEPS = 5, 11  # sweep t, so that there are four older ones, and four after t+1
FLAT = Ground((0.0, 0.0), 0.0, kerb=0.0, half_widths=(1e4, 1.0), crossing_x=1e5)
EAST, NORTH, WEST = 0.0, math.pi / 2, math.pi
WIDE = (-100.0, -100.0, -math.inf, 100.0, 100.0, math.inf)
View = Tuple[float, float, float, float]


class Attempt(NamedTuple):
    """One setting.

    Args:
        name: preset and what is changed of it.
        residual: (N, 3) what it says, total flow less the flow of the TRUE ego motion, metres per sweep.
        confidence: (N,) 0 ... 1, None where the setting has none.
    """

    name: str
    residual: np.ndarray
    confidence: Optional[np.ndarray]


@dataclass(frozen=True)
class Case:
    """A failure.

    Args:
        title: what fails, a line.
        whose: the points that the error is of.
        points: (N, 3) metres, sweep t.
        is_ground: (N,) bool.
        truth: (N, 3) true residual flow, metres per sweep.
        concerned: (N,) bool, points that the error is of.
        attempts: the one that fails first.
        view: (x0, y0, x1, y1) metres, what the picture shows.
    """

    title: str
    whose: str
    points: np.ndarray
    is_ground: np.ndarray
    truth: np.ndarray
    concerned: np.ndarray
    attempts: List[Attempt]
    view: View

    def errors(self) -> List[float]:
        """Mean end-point error of the points concerned, metres per sweep, of each attempt."""
        lengths = (np.linalg.norm(attempt.residual - self.truth, axis=1) for attempt in self.attempts)
        return [float(length[self.concerned].mean()) for length in lengths]

    def confidences(self) -> List[float]:
        """Mean confidence of the points concerned, of each attempt; NaN where it has none."""
        given = (attempt.confidence for attempt in self.attempts)
        return [math.nan if one is None else float(one[self.concerned].mean()) for one in given]


def long_side(seed: int) -> Case:
    """The aperture problem: the side of a tram looks the same a metre further on."""
    drive, view = _tram(seed), (-14, -14, 30, 18)
    attempts = [_flow(drive, "paper"), _flow(drive, "paper", num_history=4)]
    return _case(drive, attempts, "a long side seen in two sweeps", "tram of 32 m, 8 m/s", [0], view)


def rail(seed: int) -> Case:
    """Guard rails, whose seen part travels with the vehicle."""
    posts = [box(x - 0.05, x + 0.05, -0.03, 0.03, -0.3, 0.45, 0.5) for x in (-8, -4, 0, 4, 8)]
    beam = box(-10, 10, -0.04, 0.04, 0.45, 0.76, 0.6)
    rails = [Body([beam, *posts], Route(x, y)) for x in range(-100, 140, 20) for y in (-3.2, 9.0)]
    rng = np.random.default_rng(seed)
    cars = [objects.car(rng, Route(20, 0, speed=27)), objects.car(rng, Route(-12, 4, speed=31))]
    drive, rows = _drive([*rails, *cars], seed, speed=27), range(len(rails))
    attempts = [_flow(drive, "paper"), _flow(drive, "default")]
    return _case(drive, attempts, "guard rails at speed", "rails, which stand still", rows, (-22, -25, 30, 13))


def slow_person(seed: int) -> Case:
    """People who walk along a hedge, within its component."""
    rng = np.random.default_rng(seed)
    hedge = [objects.bush(rng, x, 5.5 + rng.uniform(-0.2, 0.2), 60) for x in np.arange(4, 14, 1.2).tolist()]
    people = [Route(8, 4.7, EAST, start=-0.6, speed=1.2), Route(12, 4.6, WEST, start=-0.5, speed=1.0)]
    drive = _drive([*hedge, *(objects.pedestrian(rng, way) for way in people)], seed)
    rows = [len(hedge), len(hedge) + 1]
    return _case(drive, _with_and_without_history(drive), "slow people in a hedge", "two people, 1.1 m/s", rows)


def crowd(seed: int) -> Case:
    """Somebody who walks through a group that stands."""
    rng = np.random.default_rng(seed)
    people = [objects.pedestrian(rng, Route(8, 4.5, EAST, start=-0.5, speed=1.2))]
    for x, y in ((x, y) for x in (6.5, 7.2, 7.9, 8.6, 9.3) for y in (3.9, 5.1)):
        people.append(objects.pedestrian(rng, Route(x + rng.uniform(-0.1, 0.1), y + rng.uniform(-0.1, 0.1))))
    drive = _drive(people, seed)
    return _case(drive, _with_and_without_history(drive), "a person in a crowd", "who walks, 1.2 m/s", [0])


def touching(seed: int) -> Case:
    """A car that passes a parked one a hand's breadth away."""
    rng = np.random.default_rng(seed)
    bodies = [objects.car(rng, Route(6, 3.0, EAST, speed=9)), objects.car(rng, Route(11, 5.05))]
    drive = _drive([*bodies, objects.wall(10, 8, 40, 0.5, 3)], seed)
    attempts = [_flow(drive, "paper"), _flow(drive, "default")]
    return _case(drive, attempts, "two cars that touch", "both: one at 9 m/s, one parked", [0, 1], (-6, -7, 20, 12))


def turning(seed: int) -> Case:
    """A bus that turns by 4.5 degrees a sweep."""
    bus = objects.bus(Route(14, -6, NORTH, start=4, speed=7, radius=9, angle=NORTH))
    drive, view = _drive([bus], seed, speed=0), (-8, -11, 22, 11)
    attempts = [_flow(drive, "default", thorough=False), *_with_and_without_history(drive)]
    return _case(drive, attempts, "an object that turns", "bus, 7 m/s, 4.5 degrees a sweep", [0], view)


def vertical(seed: int) -> Case:
    """A car that climbs what rises by 15 % before it."""
    bodies = [objects.car(np.random.default_rng(seed), Route(22, -3, EAST, speed=12)), objects.wall(25, 8, 30, 0.5, 4)]
    drive, view = _drive(bodies, seed, speed=3, ground=replace(FLAT, curvature=0.006)), (10, -12, 38, 6)
    attempts = [_flow(drive, "paper", num_history=4), _flow(drive, "paper", num_history=4, sectional_view=True)]
    return _case(drive, attempts, "vertical motion", "car that rises by 0.18 m a sweep", [0], view)


def fast(seed: int) -> Case:
    """Cars faster than `max_speed` allows."""
    rng = np.random.default_rng(seed)
    bodies = [objects.car(rng, Route(-4, 4, EAST, speed=48)), objects.car(rng, Route(-10, -4, WEST, -20, 52))]
    drive, view = _drive([*bodies, objects.wall(25, 9, 30, 0.5, 4)], seed, speed=20), (-54, -37, 40, 32)
    attempts = [_flow(drive, "default"), _flow(drive, "default", max_speed=60)]
    return _case(drive, attempts, "faster than max_speed", "two cars, 48 and 52 m/s", [0, 1], view)


def large(seed: int) -> Case:
    """An object longer than the verified method lets move: the tram again."""
    drive, view = _tram(seed), (-14, -14, 30, 18)
    attempts = [_flow(drive, "default"), _flow(drive, "paper", num_history=4)]
    return _case(drive, attempts, "longer than 25 m", "tram of 32 m, 8 m/s", [0], view)


def beyond_region(seed: int) -> Case:
    """Cars and people that lie outside `point_cloud_range`."""
    rng, bodies = np.random.default_rng(seed), []
    for x in (20, 40, 60, 80):
        bodies.append(objects.car(rng, Route(x, 3.5, WEST, speed=9)))
        bodies.append(objects.pedestrian(rng, Route(x, -4, NORTH, speed=1.4)))
    drive, view = _drive(bodies, seed), (-2, -28, 86, 28)
    wide = _flow(drive, "default", point_cloud_range=WIDE)._replace(name="`default`, point_cloud_range=±100 m")
    attempts = [_flow(drive, "default"), wide]
    return _case(drive, attempts, "outside the region", "cars and people 60 and 80 m away", [4, 5, 6, 7], view)


def ground_left_in(seed: int) -> Case:
    """No ground mask: the ground joins what stands on it."""
    rng = np.random.default_rng(seed)
    bodies = [
        objects.car(rng, Route(8, 3.5, WEST, speed=9)),
        objects.car(rng, Route(14, -3.5, EAST, speed=11)),
        objects.pedestrian(rng, Route(7, -6, EAST, speed=1.4)),
        objects.wall(10, 9, 30, 0.5, 4),
    ]
    drive = _drive(bodies, seed)
    attempts = [_without_masks(drive, None), _without_masks(drive, "auto")]
    return _case(drive, attempts, "ground left in", "two cars and a person", [0, 1, 2], (-6, -19, 28, 6))


def wrong_frame(seed: int) -> Case:
    """Poses of the vehicle, points of a LiDAR 1.4 m ahead of it, in a turn."""
    drive, rows, view = place(seed), range(1, 11), (-4, -16, 40, 16)
    attempts = [_flow(drive, "default", log=MisplacedPoses(drive)), _flow(drive, "default")]
    attempts = [a._replace(name=f"`default`, {frame} frame") for a, frame in zip(attempts, ("wrong", "right"))]
    return _case(drive, attempts, "points and poses of different frames", "what stands still", rows, view)


def appearing(seed: int, later: int = 0) -> Case:
    """A car that comes out from behind a van, so many sweeps later than that it is first seen."""
    rng = np.random.default_rng(seed)
    hidden = objects.car(rng, Route(13.9 - 0.9 * (PAIR + later) + 4.5, 7, WEST, speed=9))
    drive = _drive([hidden, objects.van(rng, Route(8, 3.5)), objects.wall(10, 14, 30, 0.5, 4)], seed, speed=0)
    view = (-6, -6, 24, 16)
    attempts = [_flow(drive, "default"), _flow(drive, "offline")]
    return _case(drive, attempts, "an object that appears", "car, 9 m/s", [0], view)


def appeared(seed: int) -> Case:
    """The same car four sweeps later."""
    return replace(appearing(seed, later=4), title="the same, four sweeps later")


def rolling_shutter(seed: int, profile: str = "av2_rolling") -> Case:
    """Oncoming traffic under a sensor that turns while the world moves."""
    rng = np.random.default_rng(seed)
    bodies = [objects.car(rng, Route(x, 4, WEST, speed=27)) for x in (18, 30)]
    bodies += [objects.car(rng, Route(x, -4, EAST, speed=27)) for x in (-20, 22)]
    drive = _drive([*bodies, objects.wall(10, 12, 60, 0.5, 4)], seed, speed=20, profile=profile)
    whose, view = "two oncoming cars, closing at 47 m/s", (-30, -20, 26, 21)
    return _case(drive, [_flow(drive, "default")], "rolling shutter", whose, [0, 1], view)


def frozen_world(seed: int) -> Case:
    """The same for a sensor whose sweeps are instantaneous."""
    return replace(rolling_shutter(seed, "av2"), title="the same, instantaneous sweeps")


CASES: Dict[str, Callable[[int], Case]] = {
    case.__name__: case
    for case in (
        *(long_side, rail, slow_person, crowd, touching, turning, vertical, fast, large, beyond_region),
        *(ground_left_in, wrong_frame, appearing, appeared, rolling_shutter, frozen_world),
    )
}


class MisplacedPoses:
    """A log whose poses are those of a place 1.4 m behind the frame of its points."""

    def __init__(self, log: Log) -> None:
        self.log, self.log_id, self.timestamps, self.labels = log, "misplaced", log.timestamps, log.labels

    def sweep(self, index: int) -> Sweep:
        """The sweep with the wrong pose."""
        sweep = self.log.sweep(index)
        return replace(sweep, pose=sweep.pose @ np.array([[1, 0, 0, -1.4], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))


def place(seed: int) -> Drive:
    """A turn past one car that drives (row 0), and walls, parked cars and posts."""
    rng = np.random.default_rng(seed)
    bodies = [objects.car(rng, Route(12, 4, WEST, speed=9))]
    bodies += [objects.wall(20, 12, 40, 0.5, 4), objects.wall(20, -12, 40, 0.5, 4), objects.wall(45, 0, 0.5, 24, 4)]
    bodies += [objects.car(rng, Route(x, -7)) for x in (0, 7, 14, 22)]
    bodies += [objects.pole(x, 8, 5, 0.12) for x in (0, 10, 20)]
    return _drive(bodies, seed, speed=6, radius=12, angle=1.2)


def _tram(seed: int) -> Drive:
    tram = Body([box(-16, 16, -1.3, 1.3, 0.35, 3.3, 0.6)], Route(6, 6, EAST, speed=8), "BUS", (32.0, 2.6, 3.3))
    return _drive([tram, objects.car(np.random.default_rng(seed), Route(12, -4, WEST, speed=8))], seed, speed=4)


def _drive(
    bodies: Sequence[Body], seed: int, *, ground: Ground = FLAT, profile: str = "av2", speed: float = 5, **way: float
) -> Drive:
    """A drive past bodies, straight on if `way` does not say otherwise."""
    scene = Scene(ground, Route(0, 0, speed=speed, **way), tuple(bodies), SolidTable.of(tuple(bodies)))
    return Drive(scene, get_profile(profile), seed, NUM_SWEEPS, "failure")


def _pose_flow(drive: Drive) -> np.ndarray:
    """(N, 3) true flow of ego motion alone, PAIR -> PAIR + 1."""
    points = drive.sweep(PAIR).points.astype(np.float64)
    T = np.linalg.inv(drive.poses[PAIR + 1]) @ drive.poses[PAIR]
    return points @ T[:3, :3].T + T[:3, 3] - points


def _flow(drive: Drive, preset: str, log: Optional[Log] = None, **overrides: Any) -> Attempt:
    """The flow of the pair by a preset, from `log` if its poses or points shall be others."""
    config = make_config(preset, **overrides)
    (result,) = make_model(config)([window(log or drive, PAIR, config.num_history, config.num_future)])
    return _attempt(drive, ", ".join([f"`{preset}`", *(f"{k}={v}" for k, v in overrides.items())]), result)


def _with_and_without_history(drive: Drive) -> List[Attempt]:
    return [_flow(drive, "default"), _flow(drive, "default", num_history=0)]


def _without_masks(drive: Drive, ground: Optional[str]) -> Attempt:
    sweeps = window(drive, PAIR, 4)
    T = [np.linalg.inv(sweeps.pc1.pose) @ sweep.pose for sweep in (sweeps.pc0, *sweeps.pch)]
    history = {"pch": [sweep.points for sweep in sweeps.pch], "T_ego1_egoh": T[1:]}
    result = estimate_flow(sweeps.pc0.points, sweeps.pc1.points, T_ego1_ego0=T[0], ground=ground, **history)
    return _attempt(drive, f"`default`, ground={ground!r}", result)


def _attempt(drive: Drive, name: str, result: FlowResult) -> Attempt:
    confidence = None if result.confidence is None else result.confidence.numpy()
    return Attempt(name, result.flow.numpy() - _pose_flow(drive), confidence)


def _case(
    drive: Drive,
    attempts: List[Attempt],
    title: str,
    whose: str,
    bodies: Sequence[int],
    view: View = (-6, -6, 20, 13),
) -> Case:
    sweep, returns = drive.sweep(PAIR), drive.returns(PAIR)
    body = np.append(drive.scene.table.body, -1)[returns.solid.numpy()]  # ground = -1
    truth = drive.labels(PAIR).flow - _pose_flow(drive)
    return Case(title, whose, sweep.points, sweep.is_ground, truth, np.isin(body, list(bodies)), attempts, view)
