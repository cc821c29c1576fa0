"""State of the tracks of a drive."""

from __future__ import annotations

from typing import Any, Callable, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.applications.smoothing import MotionState

# A track must show motion to be confirmed, because most short-lived groups are noise of the static world.
_MIN_EVIDENCE = 2.0  # sum of the log-odds of its confidence
_NO_CONFIDENCE = 0.7  # log-odds per sweep if the method has no confidence
# Metres; narrower and lower boxes add no evidence: posts, strips of a façade at the edge of an occlusion, and the lines
# that single beams draw on the static world, which slide along it as the vehicle moves.
_THIN = 0.12
_MIN_TRAVEL, _MIN_TRAVEL_OF_LENGTH = 0.3, 0.1  # least net displacement of the box: metres, plus a share of its length
_TRAVEL_FACTOR = 2.0  # largest ratio between the displacement of the box and the sum of its flow, either way
# Where an object is ever more or ever less hidden, one end of its box stays. With much evidence, it is enough that the
# other end has moved as the flow predicts.
_MUCH_EVIDENCE = 4.0
# With less evidence, the box must move farther and follow the flow more closely.
_LONG_TRAVEL, _TRAVEL_ERROR, _MIN_SWEEPS = 1.5, 0.25, 3  # metres (or the box's length if longer); share; sweeps
_JUMP, _SMALL = 1.5, 1.5  # if length + _SMALL (metres) changes by the factor _JUMP, we see another part


_NUMBER, _FLAG = torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.bool)
_SCALAR = torch.zeros(0, dtype=torch.float64)
_VECTOR, _MATRIX, _PAIR = _SCALAR.new_zeros(0, 3), _SCALAR.new_zeros(0, 2, 2), _SCALAR.new_zeros(0, 2, 3)


class Times(NamedTuple):
    """Times of a pair of sweeps, seconds."""

    now: float  # time of t
    interval: float  # from t to t+1
    elapsed: float  # from the last sweep to t
    late: float  # from the end of the last flow to t; more than 0 if a sweep is missing


class TrackStates(NamedTuple):
    """K tracks in the world frame; float64 unless another type is named. `TrackStates()` has no tracks."""

    id: Tensor = _NUMBER  # (K,) int64
    state: Tensor = _PAIR  # (K, 2, 3) filtered position of the centre of the whole box, metres, and velocity, m/s
    covariance: Tensor = _MATRIX  # (K, 2, 2) of the state
    whole: Tensor = _VECTOR  # (K, 3) length, width, height of the whole box, metres
    kind: Tensor = _NUMBER  # (K,) int64, index in `KINDS`
    path: Tensor = _VECTOR  # (K, 3) a point that the flow has moved since the track began
    box: Tensor = _VECTOR  # (K, 3) centre of the visible box; after a sweep, predicted for the next one
    size: Tensor = _VECTOR  # (K, 3) length, width, height of the visible box
    heading: Tensor = _SCALAR  # (K,) radians, of both boxes
    begin: Tensor = _SCALAR  # (K,) seconds, time of the first sweep
    start: Tensor = _VECTOR  # (K, 3) centre of the box where we began to measure `travel`
    start_length: Tensor = _SCALAR  # (K,) length of that box
    travel: Tensor = _VECTOR  # (K, 3) metres, sum of the flow since `start`
    confidence: Tensor = _SCALAR  # (K,) of the flow when it last moved
    evidence: Tensor = _SCALAR  # (K,) sum of the log-odds of the confidence since `start`
    num_points: Tensor = _NUMBER  # (K,) int64 points when it last moved, or the most seen since then
    num_moving: Tensor = _NUMBER  # (K,) int64 sweeps in which it moved
    missed: Tensor = _NUMBER  # (K,) int64 sweeps since it was last seen
    cluster: Tensor = _NUMBER  # (K,) int64 cluster_id, -1 = static
    is_moving: Tensor = _FLAG  # (K,) bool
    is_confirmed: Tensor = _FLAG  # (K,) bool

    def map(self, function: Callable[[Tensor], Any]) -> TrackStates:
        """Apply a function to each tensor."""
        return TrackStates(*map(function, self))

    def take(self, index: Tensor) -> TrackStates:
        """Select tracks by index or mask."""
        return self.map(lambda values: values[index])

    def extend(self, count: int) -> TrackStates:
        """Append tracks whose values are all 0."""
        return self.map(lambda values: F.pad(values, (0, 0) * (values.dim() - 1) + (0, count)))

    def add_evidence(self, index: Tensor, confidence: Tensor) -> None:
        """Add the log-odds of the (K,) confidence of this sweep's flow; NaN = the method has none."""
        odds = torch.logit(confidence, 0.01).nan_to_num(_NO_CONFIDENCE)
        self.evidence[index] += odds * (self.size[index].amin(1) >= _THIN)

    def write(self, index: Tensor, **columns: Any) -> None:
        """Overwrite columns of the indexed tracks in place."""
        for name, values in columns.items():
            getattr(self, name)[index] = values

    @property
    def motion(self) -> MotionState:
        """Position and velocity of the K tracks; a view."""
        return MotionState(self.state, self.covariance)

    def predict(self, seconds: float) -> TrackStates:
        """Predict the state after `seconds`."""
        motion, _ = self.motion.predict(self.state.new_full((len(self.id),), seconds))
        return self._replace(state=motion.state, covariance=motion.covariance)

    def measure(self, index: Tensor, measured: Tensor, noise: Tensor) -> None:
        """Update the indexed tracks by measured states, (K, 2, 3), with standard deviations (K, 2)."""
        motion = self.motion.at(index).update(measured, noise)
        self.write(index, state=motion.state, covariance=motion.covariance)

    def start_again(self, index: Tensor, length: Tensor) -> None:
        """Restart the evidence of motion of the indexed tracks whose box is now much longer or shorter.

        `length` (K,) is the length of each box in the sweep before. If it changes much, the centre of the box has
        jumped: another part of the object has become visible, or the object was merged with another one.
        """
        ratio = (self.size[index, 0] + _SMALL) / (length + _SMALL)
        index = index[(ratio > _JUMP) | (ratio < 1 / _JUMP)]
        self.write(index, start=self.box[index], start_length=self.size[index, 0], travel=0.0, evidence=0.0)

    def have_shown_motion(self) -> Tensor:
        """(K,) bool: the track moves, and its box has moved roughly as its flow predicts.

        If `evidence` is high, both ends of the box must have moved at least a little: a piece of a wall may have flow,
        but its box then grows, shrinks or jumps. If it is very high, one end must have moved nearly as predicted.
        Otherwise, the box must have moved far, and nearly as predicted.
        """
        predicted = self.travel.norm(dim=1)
        length = self.size[:, 0]
        moved = self.box - self.start
        centre = (moved * self.travel).sum(1) / predicted.clamp(min=1e-9)
        growth = (length - self.start_length) / 2
        ends = centre + torch.stack([-growth, growth])
        least = _MIN_TRAVEL + _MIN_TRAVEL_OF_LENGTH * length
        least_of_one = _MIN_TRAVEL + _MIN_TRAVEL_OF_LENGTH / 2 * length
        ends_moved = ends.amin(0) >= torch.maximum(least, predicted / _TRAVEL_FACTOR)
        ends_moved &= centre <= predicted * _TRAVEL_FACTOR
        one_end_moved = ((ends - predicted).abs() <= _TRAVEL_ERROR * predicted).any(0) & (predicted >= least_of_one)
        is_evident = ends_moved & (self.evidence >= _MIN_EVIDENCE) | one_end_moved & (self.evidence >= _MUCH_EVIDENCE)
        has_gone_far = predicted >= torch.maximum(length, self.start_length).clamp(min=_LONG_TRAVEL)
        is_exact = (moved - self.travel)[:, :2].norm(dim=1) <= _TRAVEL_ERROR * predicted
        return self.is_moving & (is_evident | (has_gone_far & is_exact & (self.num_moving >= _MIN_SWEEPS)))
