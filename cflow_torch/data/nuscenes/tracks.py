"""Annotated boxes, interpolated between the samples at which they are known."""

from __future__ import annotations

import numpy as np

from cflow_torch.data.nuscenes.tables import Annotations
from cflow_torch.data.rigid_motion import interpolate_poses


class Tracks:
    """The annotated boxes of a scene at any time, from its (S,) ascending sample times in microseconds.

    `start` and `end` are the times of the first and of the last sample.
    """

    def __init__(self, sample_times: np.ndarray, annotations: Annotations) -> None:
        self._times, self._annotations = sample_times, annotations
        self.start, self.end = (int(sample_times[0]), int(sample_times[-1])) if len(sample_times) else (0, 0)
        self._rows: list[dict[str, int]] = [{} for _ in sample_times]  # per sample: track -> row
        for row, sample in enumerate(np.searchsorted(sample_times, annotations.time)):
            self._rows[int(sample)][annotations.track[row]] = row

    def at(self, time: int) -> tuple[Annotations, np.ndarray] | None:
        """Return the K boxes at a time, and (K,) bool whether each is known; None outside the annotated time.

        A box between two samples of which only one has the object is a guess. Guesses come first.

        Convention: at a sample, we return its own boxes. Between two samples the centre and the size change linearly,
            and the rotation at a constant rate. If only one of the two samples has an object, we continue its motion
            between that sample and the next one beyond; if that one lacks it too, the object stays where it is.
        """
        times = self._times
        if not len(self._annotations.time) or not times[0] <= time <= times[-1]:
            return None
        left = int(np.searchsorted(times, time, side="right")) - 1
        rows = dict(enumerate(self._rows))
        if times[left] == time:
            return self._boxes(time, [(row, row, 0.0, True) for row in rows[left].values()])
        ends: list[tuple[int, int, float, bool]] = []  # row at one end, row at the other, fraction, whether it is known
        for track, row in {**rows[left], **rows[left + 1], **rows[left]}.items():  # those of `left` come first
            both = [k for k in (left, left - 1, left + 1) if track in rows.get(k, ()) and track in rows.get(k + 1, ())]
            start = both[0] if both else None
            if start is None:
                ends.append((row, row, 0.0, False))
            else:
                fraction = float((time - times[start]) / (times[start + 1] - times[start]))
                ends.append((rows[start][track], rows[start + 1][track], fraction, start == left))
        return self._boxes(time, sorted(ends, key=lambda end: end[3]))

    def _boxes(self, time: int, ends: list[tuple[int, int, float, bool]]) -> tuple[Annotations, np.ndarray]:
        table, rows0, rows1 = self._annotations, [end[0] for end in ends], [end[1] for end in ends]
        fraction = np.array([end[2] for end in ends], dtype=np.float64)
        boxes = Annotations(
            time=np.full(len(ends), time),
            track=[table.track[row] for row in rows0],
            category=[table.category[row] for row in rows0],
            size=table.size[rows0] + np.clip(fraction, 0, 1)[:, None] * (table.size[rows1] - table.size[rows0]),
            pose=interpolate_poses(table.pose[rows0], table.pose[rows1], fraction),
        )
        return boxes, np.array([end[3] for end in ends], dtype=bool)
