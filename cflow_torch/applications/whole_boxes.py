"""Whole boxes of tracks: one size from all sweeps, held at the sides that face the sensor, along a smoothed path."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.applications.association import turned
from cflow_torch.applications.smoothing import MotionState, smooth

PEDESTRIAN, CYCLIST, CAR, TRUCK = range(4)
KINDS = ("pedestrian", "cyclist", "car", "truck")
# Length and width of each kind where they are not seen, metres: a step; a bicycle; a car of the middle class without
# mirrors; a lorry. The width of people follows from what is seen of them.
_TYPICAL = ((0.9, 0.0), (1.8, 0.0), (4.5, 1.9), (8.0, 2.5))
_ARMS = 0.16  # metres that a person or a cyclist is wider than what one sweep usually shows; from simulated drives
_WIDTHS = (0.5, 0.9)  # metres, least and most of people and cyclists
_LEAST = (3.6, 1.5)  # metres, length and width of the smallest cars; a smaller visible part is not the whole
_NARROW = (2.6, 1.2)  # metres, length and width below which an object is not a vehicle
_SHORT, RUNNING = 1.3, 3.0  # metres, m/s: narrow objects that are longer or faster are cyclists
_LONG_CAR, _HIGH_CAR = 6.0, 2.6  # metres; larger vehicles are trucks

_SEEN_ANGLE = math.radians(15)  # a side is seen if the view of the sensor meets it at this angle at least
_SHARE = 0.75  # quantile over the sweeps of where an edge is seen; points of other objects are beyond
_MOST_HIDDEN = 1.5  # metres above the ground, where what is seen of an object begins: others hide the lower part
_STRAY = 0.003  # share of the points of one sweep that are beyond an edge
FLOW_NOISE = 0.2  # m/s, standard deviation
_ANCHOR_NOISE, _FREE_NOISE = 0.15, 0.3  # standard deviation of a box: metres, plus a share of what is not seen
_DEPTHS = (0.12, 0.07)  # metres from what is seen of a person, of a cyclist back to the middle; from simulated drives
_CENTROID_NOISE = 1.0  # metres, standard deviation of the mean of the visible points
_MIN_SPEED = 0.5  # m/s; slower objects keep their heading
_LEAST_INERTIA = 1e-6  # square metres
_ROUNDS, _ROBUST_ROUNDS = 3, 3


class Sightings(NamedTuple):
    """What is seen of the K tracks of a drive: R sightings, sorted by track, then time, each with points; float64."""

    track: Tensor  # (R,) int64, 0 ... K - 1
    seconds: Tensor  # (R,)
    sensor: Tensor  # (R, 3) metres, position of the vehicle in the world
    heading: Tensor  # (R,) radians, where the object never moves fast enough to tell
    floor: Tensor  # (R,) metres, height of the ground below the object, NaN = unknown
    points: Tensor  # (P, 3) metres in the world
    velocity: Tensor  # (P, 3) m/s, flow of the points
    row: Tensor  # (P,) int64, sighting of each point


class WholeBoxes(NamedTuple):
    """The boxes of R sightings, in the world."""

    motion: MotionState  # of the centre
    size: Tensor  # (R, 3) metres: length, width, height
    heading: Tensor  # (R,) radians
    kind: Tensor  # (R,) int64, index in `KINDS`


class Edges(NamedTuple):
    """The visible extent of R objects along the axes of their boxes (ahead, left, up), metres."""

    low: Tensor  # (R, 3)
    high: Tensor  # (R, 3)
    median: Tensor  # (R, 3) of the points, along each axis
    sensor: Tensor  # (R, 3)

    @classmethod
    def of(cls, points: Tensor, row: Tensor, sensor: Tensor, heading: Tensor, floor: Tensor) -> Edges:
        """Turn points (P, 3) of R objects into the axes of boxes with (R,) headings; few points are strays.

        Objects stand on the `floor`, (R,) metres, unless what we see of them is far above it; NaN = it is unknown.
        """
        local = turned(points, -heading[row])
        count = len(heading)
        shares = (_STRAY, 1 - _STRAY, 0.5)
        low, high, median = quantiles_of_axes(local, row, count, *shares)
        stands = (floor <= low[:, 2]) & (floor >= low[:, 2] - _MOST_HIDDEN)
        low[:, 2] = torch.where(stands, floor, low[:, 2])
        return cls(low, high, median, turned(sensor, -heading))

    @property
    def middle(self) -> Tensor:
        """(R, 3)"""
        return (self.low + self.high) / 2

    @property
    def view(self) -> Tensor:
        """(R, 3) from the middle to the sensor."""
        return self.sensor - self.middle

    def at(self, rows: Tensor) -> Edges:
        """Select rows."""
        return Edges(*(values[rows] for values in self))

    def relative_to(self, origin: Tensor) -> Edges:
        """Shift the origin to (R, 3) points, along the axes of the boxes."""
        return Edges(*(values - origin for values in self))

    def is_seen(self) -> Tensor:
        """(R, 2) bool: the sensor looks at a long side, which shows the length; at an end, which shows the width.

        The edges are relative to a point of the object. A few points of another object in one sweep do not move it.
        """
        side = torch.atan2(self.sensor[:, 1].abs(), self.sensor[:, 0].abs())
        return torch.stack([side >= _SEEN_ANGLE, side <= math.pi / 2 - _SEEN_ANGLE], 1)

    def anchor(self, size: Tensor, kind: Tensor) -> tuple[Tensor, Tensor]:
        """Place boxes of (R, 3) size on the visible points.

        The visible edges of a vehicle are those that face the sensor. What is not seen of its box lies beyond the
        others. If the sensor is beside it, a part may be missing at either end. People and cyclists are round: their
        middle lies a little behind what is seen. For a person, this is the median of the points, which a few points of
        a wall do not move. A cyclist has fewer points at one end than at the other, so we take the middle of the ends.

        Returns:
            (R, 3) centres, along the axes of the boxes, and their (R,) standard deviations, metres.
        """
        missing = (size - (self.high - self.low)) / 2
        facing = (self.view / (size / 2)).clamp(-1, 1)
        shift = -facing * missing.clamp(min=0)
        visible = torch.where((kind == PEDESTRIAN)[:, None], self.median, self.middle)[:, :2]
        depth = visible.new_tensor(_DEPTHS)[kind.clamp(max=CYCLIST)]
        behind = visible - depth[:, None] * F.normalize(self.view[:, :2])
        centre = torch.where((kind <= CYCLIST)[:, None], behind, (self.middle + shift)[:, :2])
        noise = _ANCHOR_NOISE + _FREE_NOISE * missing[:, :2].abs().amax(1)
        height = self.low[:, 2:] + size[:, 2:] / 2
        return torch.cat([centre, height], 1), noise


class RigidFlow(NamedTuple):
    """The flow of R objects as rigid motions: the velocity of the middle of their points, and a turn about z.

    Where an object turns, the part that is seen does not move as the middle of its box.
    """

    middle: Tensor  # (R, 3) metres
    velocity: Tensor  # (R, 3) m/s, of the middle
    turn: Tensor  # (R,) rad/s

    @classmethod
    def of(cls, points: Tensor, velocity: Tensor, row: Tensor, count: int) -> RigidFlow:
        """Fit the velocities (P, 3) of the points (P, 3) of `count` objects by least squares; `row` is their object."""
        middle = _means(points, row, count)
        mean = _means(velocity, row, count)
        arm = points - middle[row]
        swing = velocity - mean[row]
        moment = arm[:, 0] * swing[:, 1] - arm[:, 1] * swing[:, 0]
        inertia = (arm[:, :2] ** 2).sum(1)
        moments = torch.stack([moment, inertia], 1)
        total = moments.new_zeros(count, 2).index_add_(0, row, moments)
        return cls(middle, mean, total[:, 0] / total[:, 1].clamp(min=_LEAST_INERTIA))

    def at(self, place: Tensor) -> Tensor:
        """(R, 3) velocity at (R, 3) places."""
        x, y, z = (place - self.middle).unbind(1)
        return self.velocity + self.turn[:, None] * torch.stack([-y, x, torch.zeros_like(z)], 1)


def whole_boxes(sightings: Sightings) -> WholeBoxes:
    """Estimate the box of each track from all its sightings.

    The flow gives the shape of the path, and the visible edges its position. Along a path, the edges of the object stay
    where they are in its box, and other points do not. So three quarters of all sightings must agree on an edge.
    """
    track = sightings.track
    count = int(track.max()) + 1 if len(track) else 0
    flow = RigidFlow.of(sightings.points, sightings.velocity, sightings.row, len(track))
    motion = _smoothed(sightings, flow.middle, flow.velocity, torch.full_like(sightings.seconds, _CENTROID_NOISE))
    for _ in range(_ROUNDS):
        heading = headings(motion.velocity, track, sightings.heading)
        edges = Edges.of(sightings.points, sightings.row, sightings.sensor, heading, sightings.floor)
        speed = motion.velocity[:, :2].norm(dim=1)
        along_path = edges.relative_to(turned(motion.position, -heading))
        (typical_speed,) = quantiles(speed, track, count, _SHARE)
        kind, size = kinds_and_sizes(along_path, track, count, typical_speed)
        local, noise = edges.anchor(size[track], kind[track])
        centre = turned(local, heading)
        velocity = flow.at(centre)
        motion = _smoothed(sightings, centre, velocity, noise)
        for _ in range(_ROBUST_ROUNDS - 1):
            residual = (centre - motion.position)[:, :2].norm(dim=1)
            motion = _smoothed(sightings, centre, velocity, torch.hypot(noise, residual))
    return WholeBoxes(motion, size[track], heading, kind[track])


def _smoothed(sightings: Sightings, centre: Tensor, velocity: Tensor, noise: Tensor) -> MotionState:
    measured = torch.stack([centre, velocity], 1)
    deviations = torch.stack([noise, torch.full_like(noise, FLOW_NOISE)], 1)
    return smooth(sightings.track, sightings.seconds, measured, deviations)


def kinds_and_sizes(edges: Edges, track: Tensor, count: int, speed: Tensor) -> tuple[Tensor, Tensor]:
    """Estimate what the tracks are, and how large.

    Args:
        edges: of R sightings, relative to a point that moves with the object.
        track: (R,) int64, track of each sighting, 0 ... count - 1.
        count: K.
        speed: (K,) m/s.

    Returns:
        (K,) int64 kinds and (K, 3) float64 sizes, metres. Lengths and widths that are not seen are typical ones, or
        what is visible if it is larger. People and cyclists have a typical length.
    """
    every = torch.ones_like(track, dtype=torch.bool)
    size = torch.stack([_extent(edges, axis, track, count, every) for axis in range(3)], 1)
    kind = _kind(size, speed)
    is_person = kind <= CYCLIST
    (usual_width,) = quantiles(edges.high[:, 1] - edges.low[:, 1], track, count, 0.5)
    typical = size.new_tensor(_TYPICAL)[kind]
    typical[:, 1] = torch.where(is_person, (usual_width + _ARMS).clamp(*_WIDTHS), typical[:, 1])
    is_seen = edges.is_seen()
    for axis, least in enumerate(_LEAST):
        seen = _extent(edges, axis, track, count, is_seen[:, axis])
        visible = torch.maximum(size[:, axis], typical[:, axis])
        of_vehicle = torch.where(seen >= least, seen, visible)  # NaN if it is never seen
        size[:, axis] = torch.where(is_person, typical[:, axis], of_vehicle)
    return kind, size


def _kind(size: Tensor, speed: Tensor) -> Tensor:
    """Classify objects by their visible (K, 3) size and (K,) speed; (K,) int64."""
    is_narrow = (size[:, 0] < _NARROW[0]) & (size[:, 1] < _NARROW[1])
    walks = (size[:, 0] < _SHORT) & (speed < RUNNING)
    is_large = (size[:, 0] > _LONG_CAR) | (size[:, 2] > _HIGH_CAR)
    return torch.where(is_narrow, torch.where(walks, PEDESTRIAN, CYCLIST), torch.where(is_large, TRUCK, CAR))


def _extent(edges: Edges, axis: int, track: Tensor, count: int, is_used: Tensor) -> Tensor:
    """(K,) metres between the edges on which most of the used sightings of each track agree; NaN without one."""
    (high,) = quantiles(edges.high[is_used, axis], track[is_used], count, _SHARE)
    (low,) = quantiles(edges.low[is_used, axis], track[is_used], count, 1 - _SHARE)
    return high - low


def headings(velocity: Tensor, track: Tensor, otherwise: Tensor) -> Tensor:
    """Direction of (R, 3) velocities, sorted by track, then time.

    An object that is slow keeps the direction that it had, or will have if it has not yet moved. If it is always slow,
    we take (R,) `otherwise`.
    """
    direction = torch.atan2(velocity[:, 1], velocity[:, 0])
    is_fast = velocity[:, :2].norm(dim=1) >= _MIN_SPEED
    index = torch.arange(len(track), device=track.device)
    before = torch.where(is_fast, index, -1).cummax(0).values.clamp(min=0)
    after = torch.where(is_fast, index, len(track)).flip(0).cummin(0).values.flip(0).clamp(max=len(track) - 1)
    heading = torch.where(is_fast[after] & (track[after] == track), direction[after], otherwise)
    return torch.where(is_fast[before] & (track[before] == track), direction[before], heading)


def quantiles(values: Tensor, group: Tensor, count: int, *shares: float) -> list[Tensor]:
    """Quantiles of the (N,) values of each group, (count,) for each share; the nearest value. NaN for empty groups."""
    size = torch.bincount(group, minlength=count)
    if len(values) == 0:
        return [values.new_full((count,), torch.nan) for _ in shares]
    lowest = values.min()
    span = values.max() - lowest + 1
    order = (group * span + (values - lowest)).argsort()  # by group, then value
    first = size.cumsum(0) - size
    found = []
    for share in shares:
        position = first + ((size - 1) * share).round().long()
        value = values[order[position.clamp(max=len(values) - 1)]]
        found.append(torch.where(size > 0, value, torch.nan))
    return found


def quantiles_of_axes(points: Tensor, group: Tensor, count: int, *shares: float) -> Tensor:
    """Quantiles of the (N, 3) points of each group along each axis, (shares, count, 3), see `quantiles`."""
    return torch.stack([torch.stack(quantiles(points[:, axis], group, count, *shares)) for axis in range(3)], 2)


def _means(values: Tensor, group: Tensor, count: int) -> Tensor:
    """(count, 3) means of the (N, 3) values of each group; none is empty."""
    total = values.new_zeros(count, values.shape[1]).index_add_(0, group, values)
    return total / torch.bincount(group, minlength=count)[:, None]
