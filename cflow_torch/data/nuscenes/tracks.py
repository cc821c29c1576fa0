"""Rigid motions and annotated boxes between the times at which they are known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Dict, List, Optional, Tuple

import numpy as np

from cflow_torch.data.nuscenes.tables import Annotations
from cflow_torch.types import CFlowError

_STRAIGHT = 1e-8  # radians below which sin(angle) / angle is 1 in float64: no turn to follow


def transforms(poses: np.ndarray) -> np.ndarray:
    """(K, 4, 4) float64 of (K, 7) translations and unit quaternions, scalar first."""
    w, x, y, z = poses[:, 3:].T
    result = np.zeros((len(poses), 4, 4))
    result[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1)
    result[:, 1, :3] = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1)
    result[:, 2, :3] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    result[:, :3, 3] = poses[:, :3]
    result[:, 3, 3] = 1
    return result


def between(poses0: np.ndarray, poses1: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Poses on the way from one to another: straight line and constant turn rate, the shorter way round.

    Args:
        poses0, poses1: (K, 7) float64, translation and unit quaternion.
        fraction: (K,) float64, 0 = the first, 1 = the second; beyond, the motion goes on.

    Returns:
        (K, 7) float64.
    """
    start, end = poses0[:, 3:], poses1[:, 3:]
    cosine = (start * end).sum(1)
    end = np.where(cosine[:, None] < 0, -end, end)  # q and -q are the same rotation
    # From the chord, since arccos loses half of the digits near 1.
    angle = 2 * np.arctan2(np.linalg.norm(end - start, axis=1), np.linalg.norm(end + start, axis=1))
    turns = angle > _STRAIGHT
    sine = np.where(turns, np.sin(angle), 1.0)
    weight0 = np.where(turns, np.sin((1 - fraction) * angle) / sine, 1 - fraction)
    weight1 = np.where(turns, np.sin(fraction * angle) / sine, fraction)
    rotation = weight0[:, None] * start + weight1[:, None] * end
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    shift = poses0[:, :3] + fraction[:, None] * (poses1[:, :3] - poses0[:, :3])
    return np.concatenate([shift, rotation], axis=1)


def poses_at(times: np.ndarray, known_times: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Poses at any times, from those around each; before the first and after the last the motion goes on.

    Args:
        times: (K,) int64, microseconds.
        known_times: (M,) int64, ascending, M >= 2.
        poses: (M, 7) float64 at `known_times`.

    Returns:
        (K, 7) float64.
    """
    left = np.clip(np.searchsorted(known_times, times, side="right") - 1, 0, len(known_times) - 2)
    fraction = (times - known_times[left]) / (known_times[left + 1] - known_times[left])
    return between(poses[left], poses[left + 1], fraction)


@dataclass(frozen=True)
class TrackBoxes:
    """The K boxes of one time.

    Args:
        track, category: K names.
        size: (K, 3) float64, metres: length, width, height.
        pose: (K, 4, 4) float64 `T_world_box`.
        is_known: (K,) bool, False where the time lies between two samples of which only one has the object: the box
            is then a guess. Guesses come first.
    """

    track: Tuple[str, ...]
    category: Tuple[str, ...]
    size: np.ndarray
    pose: np.ndarray
    is_known: np.ndarray


class Tracks:
    """The annotated boxes of a scene at any time.

    Args:
        sample_times: (S,) int64, ascending, microseconds.
        annotations: of these samples.

    Attributes:
        start, end: times of the first and of the last sample, microseconds.

    Raises:
        CFlowError: an object has two boxes in one sample.
    """

    def __init__(self, sample_times: np.ndarray, annotations: Annotations) -> None:
        self._times, self._annotations = sample_times, annotations
        self.start, self.end = (int(sample_times[0]), int(sample_times[-1])) if len(sample_times) else (0, 0)
        self._rows: List[Dict[str, int]] = [{} for _ in sample_times]  # per sample: track -> row
        for row, sample in enumerate(np.searchsorted(sample_times, annotations.time)):
            boxes = self._rows[int(sample)]
            if annotations.track[row] in boxes:
                raise CFlowError(
                    f"sample_annotation.json has instance {annotations.track[row]} twice in one sample; an object has "
                    "one box per sample, copy the tables again"
                )
            boxes[annotations.track[row]] = row

    def at(self, time: int) -> Optional[TrackBoxes]:
        """Boxes at a time; None before the first sample, after the last, and in a scene without annotations.

        Convention: at a sample its own boxes. Between two samples the centre moves on a straight line, the rotation at
        a constant rate, the size changes linearly. An object that only one of the two samples has goes on as between
        that sample and the next one beyond; if that lacks it too, it stays where it is.
        """
        times = self._times
        if not len(self._annotations.time) or not times[0] <= time <= times[-1]:
            return None
        left = int(np.searchsorted(times, time, side="right")) - 1
        if times[left] == time:
            return self._boxes([(row, row, 0.0) for row in self._rows[left].values()], 0)
        known, guessed = [], []  # row at one end, row at the other, how far between them
        before, now, then, after = (
            self._rows[sample] if 0 <= sample < len(times) else {} for sample in range(left - 1, left + 3)
        )
        for track, row in now.items():
            if track in then:
                known.append((row, then[track], self._fraction(time, left)))
            elif track in before:
                guessed.append((before[track], row, self._fraction(time, left - 1)))
            else:
                guessed.append((row, row, 0.0))
        for track, row in then.items():
            if track not in now and track in after:
                guessed.append((row, after[track], self._fraction(time, left + 1)))
            elif track not in now:
                guessed.append((row, row, 0.0))
        return self._boxes(guessed + known, len(guessed))

    def _fraction(self, time: int, sample: int) -> float:
        """How far `time` is from `sample` to the next one."""
        return float((time - self._times[sample]) / (self._times[sample + 1] - self._times[sample]))

    def _boxes(self, ends: List[Tuple[int, int, float]], num_guessed: int) -> TrackBoxes:
        table = self._annotations
        rows0, rows1 = [end[0] for end in ends], [end[1] for end in ends]
        fraction = np.array([end[2] for end in ends], dtype=np.float64)
        grown = np.clip(fraction, 0, 1)[:, None] * (table.size[rows1] - table.size[rows0])
        return TrackBoxes(
            track=tuple(table.track[row] for row in rows0),
            category=tuple(table.category[row] for row in rows0),
            size=table.size[rows0] + grown,
            pose=transforms(between(table.pose[rows0], table.pose[rows1], fraction)),
            is_known=np.arange(len(ends)) >= num_guessed,
        )
