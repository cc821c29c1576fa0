"""Small simulated drives in which the method fails, one function each, first with a setting that fails, then mended."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Sequence

import failure_drives
import merged_drives
import numpy as np
from failure_drives import EAST, FLAT, NORTH, PAIR, WEST, Staged, View, body_of, drive_past

from cflow_torch import FlowResult, Sweep, estimate_flow, make_config, make_model
from cflow_torch.data.log import Log, window
from cflow_torch.simulator import objects
from cflow_torch.simulator.drive import Drive
from cflow_torch.simulator.objects import Body, Route, box

WIDE = (-100.0, -100.0, -math.inf, 100.0, 100.0, math.inf)


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
    staged = failure_drives.tram(seed)
    ways = (("default", 0), ("paper", 0), ("paper", 4), ("offline", 0), ("default", 4))
    attempts = [_flow(staged.drive, preset, num_history=number) for preset, number in ways]
    return _staged_case(staged._replace(title="a long side seen in two sweeps"), attempts)


def rail(seed: int) -> Case:
    """Guard rails, whose seen part travels with the vehicle."""
    posts = [box(x - 0.05, x + 0.05, -0.03, 0.03, -0.3, 0.45, 0.5) for x in (-8, -4, 0, 4, 8)]
    beam = box(-10, 10, -0.04, 0.04, 0.45, 0.76, 0.6)
    rails = [Body([beam, *posts], Route(x, y)) for x in range(-100, 140, 20) for y in (-3.2, 9.0)]
    rng = np.random.default_rng(seed)
    cars = [objects.car(rng, Route(20, 0, speed=27)), objects.car(rng, Route(-12, 4, speed=31))]
    drive, rows = drive_past([*rails, *cars], seed, speed=27), range(len(rails))
    attempts = [_flow(drive, "paper"), _flow(drive, "default")]
    return _case(drive, attempts, "guard rails at speed", "rails, which stand still", rows, (-22, -25, 30, 13))


def slow_person(seed: int) -> Case:
    """People who walk along a hedge, within its component."""
    staged = failure_drives.hedge(seed)
    return _staged_case(staged, _with_and_without_history(staged.drive))


def crowd(seed: int) -> Case:
    """Somebody who walks through a group that stands."""
    staged = failure_drives.crowd(seed)
    return _staged_case(staged, _with_and_without_history(staged.drive))


def touching(seed: int) -> Case:
    """A car that passes a parked one a hand's breadth away."""
    rng = np.random.default_rng(seed)
    bodies = [objects.car(rng, Route(6, 3.0, EAST, speed=9)), objects.car(rng, Route(11, 5.05))]
    drive = drive_past([*bodies, objects.wall(10, 8, 40, 0.5, 3)], seed)
    attempts = [_flow(drive, "paper"), _flow(drive, "default")]
    return _case(drive, attempts, "two cars that touch", "both: one at 9 m/s, one parked", [0, 1], (-6, -7, 20, 12))


def turning(seed: int) -> Case:
    """A bus that turns by 4.5 degrees a sweep."""
    bus = objects.bus(Route(14, -6, NORTH, start=4, speed=7, radius=9, angle=NORTH))
    drive, view = drive_past([bus], seed, speed=0), (-8, -11, 22, 11)
    attempts = [_flow(drive, "default", thorough=False), *_with_and_without_history(drive)]
    return _case(drive, attempts, "an object that turns", "bus, 7 m/s, 4.5 degrees a sweep", [0], view)


def vertical(seed: int) -> Case:
    """A car that climbs what rises by 15 % before it."""
    bodies = [objects.car(np.random.default_rng(seed), Route(22, -3, EAST, speed=12)), objects.wall(25, 8, 30, 0.5, 4)]
    drive, view = drive_past(bodies, seed, speed=3, ground=replace(FLAT, curvature=0.006)), (10, -12, 38, 6)
    attempts = [_flow(drive, "paper", num_history=4), _flow(drive, "paper", num_history=4, sectional_view=True)]
    return _case(drive, attempts, "vertical motion", "car that rises by 0.18 m a sweep", [0], view)


def fast(seed: int) -> Case:
    """Cars faster than `max_speed` allows."""
    rng = np.random.default_rng(seed)
    bodies = [objects.car(rng, Route(-4, 4, EAST, speed=48)), objects.car(rng, Route(-10, -4, WEST, -20, 52))]
    drive, view = drive_past([*bodies, objects.wall(25, 9, 30, 0.5, 4)], seed, speed=20), (-54, -37, 40, 32)
    attempts = [_flow(drive, "default", max_speed=40), _flow(drive, "default")]
    return _case(drive, attempts, "faster than max_speed", "two cars, 48 and 52 m/s", [0, 1], view)


def large(seed: int) -> Case:
    """An object longer than the verified method lets move: the tram again."""
    staged = failure_drives.tram(seed)
    return _staged_case(staged, [_flow(staged.drive, "default"), _flow(staged.drive, "paper", num_history=4)])


def beyond_region(seed: int) -> Case:
    """Cars and people that lie outside `point_cloud_range`."""
    rng, bodies = np.random.default_rng(seed), []
    for x in (20, 40, 82, 90):
        bodies.append(objects.car(rng, Route(x, 3.5, WEST, speed=9)))
        bodies.append(objects.pedestrian(rng, Route(x, -4, NORTH, speed=1.4)))
    drive, view = drive_past(bodies, seed), (-2, -30, 96, 30)
    wide = _flow(drive, "default", point_cloud_range=WIDE)._replace(name="`default`, point_cloud_range=±100 m")
    attempts = [_flow(drive, "default"), wide]
    return _case(drive, attempts, "outside the region", "cars and people 82 and 90 m away", [4, 5, 6, 7], view)


def ground_left_in(seed: int) -> Case:
    """No ground mask: the ground joins what stands on it."""
    rng = np.random.default_rng(seed)
    bodies = [
        objects.car(rng, Route(8, 3.5, WEST, speed=9)),
        objects.car(rng, Route(14, -3.5, EAST, speed=11)),
        objects.pedestrian(rng, Route(7, -6, EAST, speed=1.4)),
        objects.wall(10, 9, 30, 0.5, 4),
    ]
    drive = drive_past(bodies, seed)
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
    staged = failure_drives.appearing(seed, later)
    return _staged_case(staged, [_flow(staged.drive, "default"), _flow(staged.drive, "offline")])


def appeared(seed: int) -> Case:
    """The same car four sweeps later."""
    return replace(appearing(seed, later=4), title="the same, four sweeps later")


def rolling_shutter(seed: int, profile: str = "av2_rolling") -> Case:
    """Oncoming traffic under a sensor that turns while the world moves."""
    staged = failure_drives.rolling_shutter(seed, profile)
    return _staged_case(staged, [_flow(staged.drive, "default")])


def frozen_world(seed: int) -> Case:
    """The same for a sensor whose sweeps are instantaneous."""
    return replace(rolling_shutter(seed, "av2"), title="the same, instantaneous sweeps")


def facade(seed: int) -> Case:
    """Parked cars and the fronts behind them, from a vehicle at walking speed."""
    staged = merged_drives.facade(seed, 0.1)
    standing = range(len(staged.bodies), len(staged.drive.scene.bodies))
    return _staged_case(staged._replace(whose="what stands", bodies=standing), [_flow(staged.drive, "default")])


def _by_default(stage: Callable[[int], Staged]) -> Callable[[int], Case]:
    """What `default` makes of a drive."""

    def case(seed: int) -> Case:
        staged = stage(seed)
        return _staged_case(staged, [_flow(staged.drive, "default")])

    return case


_MERGED = ("tree", "bridge", "gantry", "wires", "walkers", "train", "abreast")
CASES: Dict[str, Callable[[int], Case]] = {
    case.__name__: case
    for case in (
        *(long_side, rail, slow_person, crowd, touching, turning, vertical, fast, large, beyond_region),
        *(ground_left_in, wrong_frame, appearing, appeared, rolling_shutter, frozen_world, facade),
    )
}
CASES.update({name: _by_default(getattr(merged_drives, name)) for name in _MERGED})


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
    return drive_past(bodies, seed, speed=6, radius=12, angle=1.2)


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


def _staged_case(staged: Staged, attempts: List[Attempt]) -> Case:
    return _case(staged.drive, attempts, *staged[1:])


def _case(
    drive: Drive,
    attempts: List[Attempt],
    title: str,
    whose: str,
    bodies: Sequence[int],
    view: View = (-6, -6, 20, 13),
) -> Case:
    sweep, truth = drive.sweep(PAIR), drive.labels(PAIR).flow - _pose_flow(drive)
    concerned = np.isin(body_of(drive), list(bodies))
    return Case(title, whose, sweep.points, sweep.is_ground, truth, concerned, attempts, view)
