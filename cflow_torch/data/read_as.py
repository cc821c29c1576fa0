"""Read a log whose poses or points have another convention: the setting `read_as` of `open_log`."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any, Sequence

import numpy as np

from cflow_torch.data.column_names import default_names
from cflow_torch.data.finding import FOUND, RIGHT, WRONG, Finding
from cflow_torch.data.log import FlowLabels, Log, LogWrapper, known_poses, poses_beyond, typical_sweeps
from cflow_torch.data.log_motion import judge_log
from cflow_torch.data.odometry import PosedLog
from cflow_torch.diagnosis.conventions import LATEST, OF_POINTS, READINGS, REVERSED, TIMES_OF_POSES, WORLD
from cflow_torch.diagnosis.point_frame import MOST_COLUMNS, column_problem
from cflow_torch.diagnosis.readings import STEPS
from cflow_torch.errors import CFlowError
from cflow_torch.transforms import rigid_transform, transform_points
from cflow_torch.types import Sweep, as_numpy

_COARSEST = 0.01  # metres between two float32 coordinates
_UNNAMED = default_names(MOST_COLUMNS)[3:]  # columns after the first three, which may be x, y and z
READ_AS = ("auto", None, *READINGS)


def read_as(log: Log, reading: str | None | Sequence[str] = "auto") -> Log:
    """Return a log that is read in another way.

    Args:
        log: any log.
        reading: None = as it is. "auto" = the same, unless the points are in the world's frame: then "world". Several
            are used one after the other. What else is allowed is a name in `READINGS` of
            `cflow_torch.diagnosis.conventions`, whose `cause` says what it means, such as "inverted" (poses are
            T_ego_world), "late" (the pose of sweep i is at sweep i + 1; those at an end are extrapolated), "camera"
            (axes of the poses), "feet" (unit of the poses) and "points_feet" (unit of the points). The poses stay under
            a reading of the points, so give ("points_camera", "camera") if both have a camera's axes.
    """
    if isinstance(reading, Sequence) and not isinstance(reading, str):
        for each in reading:
            log = read_as(log, each)
        return log
    if reading not in READ_AS:
        raise CFlowError(f"read_as={reading!r}: give one of {', '.join(str(one or 'null') for one in READ_AS)}")
    placed = _in_world_of_points(log) if reading in ("auto", WORLD) else log
    if reading == "auto":
        return ReadAs(placed, WORLD, is_found=True) if _is_in_world(placed) else log
    return log if reading is None else ReadAs(placed, reading)


def _in_world_of_points(log: Log) -> Log:
    """Return the log with poses in the world around whose poses its points lie: that of the poses or the first sweep.

    Programs write clouds in the frame of the first one, next to poses in that of a map.
    """
    try:
        poses = None if log.surrounds_poses else known_poses(log)
        from_first = log if poses is None else PosedLog(log, np.linalg.inv(poses[0]) @ poses)
        return from_first if from_first.surrounds_poses else log
    except (CFlowError, OSError):
        return log  # `sweep` raises the error


def _is_in_world(log: Log) -> bool:
    """Test whether the points of a log are in the world's frame; by one sweep, if it is not there."""
    try:
        if not (log.unwrapped.has_viewpoints or log.surrounds_poses) or WORLD not in judge_log(log).best:
            return False
        return not problem_of_columns(log)
    except (CFlowError, OSError):
        return False  # `sweep` raises the error


def problem_of_columns(log: Log) -> str:
    """Return which columns of a typical sweep seem to be x, y and z, if others than the first three do."""
    index = typical_sweeps(log)[0]
    points = as_numpy(log.sweep(index).points)[:, :3]
    others = [values for name, values in log.columns(index).items() if name in _UNNAMED]
    return column_problem(np.column_stack([points, *(each for each in others if len(each) == len(points))]))


class ReadAs(LogWrapper):
    """A log whose points and poses are converted, see `read_as`. `is_found` tells that we found the reading.

    Labels are converted, too: flow is then in the axes of the converted points.
    """

    def __init__(self, log: Log, reading: str, is_found: bool = False) -> None:
        super().__init__(log)
        self.reading = reading
        self.is_reading_found = is_found

    @property
    def readings(self) -> tuple[str, ...]:
        return (*self.log.readings, self.reading)

    def sweep(self, index: int) -> Sweep:
        sweep = self.log.sweep(index)
        points = np.asarray(sweep.points)
        moved = self._move(points, index, sweep.pose).astype(np.float32)
        return replace(sweep, points=moved, pose=None if sweep.pose is None else self._converted[index].copy())

    def _labels(self, index: int) -> FlowLabels | None:
        labels = self.log.labels(index)
        if labels is None or self.reading not in (WORLD, *OF_POINTS):
            return labels
        sweep, pose1 = self.log.sweep(index), self.log.sweep(index + 1).pose
        points = np.asarray(sweep.points)[:, :3].astype(np.float64)
        start, end = self._move(points, index, sweep.pose), self._move(points + labels.flow, index + 1, pose1)
        return replace(labels, flow=(end - start).astype(np.float32))

    def labels(self, index: int) -> FlowLabels | None:
        return Log.labels(self, index)

    def findings(self) -> list[Finding]:
        what = READINGS[self.reading].cause
        said = Finding("frame", RIGHT, f"as you say, {what} (read_as={self.reading})")
        used = f"we move them to that of the vehicle. data.read_as={self.reading} does the same without this line"
        found = Finding("frame", FOUND, f"{what}, so {used}", True)
        findings = [*self.log.findings(), found if self.is_reading_found else said]
        if self.reading == WORLD:  # are coordinates of a map too large for float32?
            points = as_numpy(self.log.sweep(typical_sweeps(self.log)[0]).points)[:, :3]
            step = float(np.spacing(np.nanmax(np.abs(points), initial=0).astype(np.float32)))
            if points.dtype == np.float32 and step > _COARSEST:
                text = f"the points are float32 with steps of {step:.2g} m"
                why = "as they are far from the origin of the world: give points and poses relative to a place nearby"
                findings.append(Finding("frame", WRONG, f"{text}, {why}", True))
        return findings

    @cached_property
    def poses(self) -> np.ndarray | None:
        return None if self.log.poses is None else self._converted

    @cached_property
    def trajectory(self) -> tuple[np.ndarray, np.ndarray] | None:
        given = self.log.trajectory
        if given is None or self.reading in (REVERSED, *TIMES_OF_POSES, *STEPS):
            return None
        times, poses = given
        return times, self._convert(poses)

    @cached_property
    def _converted(self) -> np.ndarray:
        """The (K, 4, 4) poses of all sweeps, as `T_world_ego`."""
        given = np.stack([self._given(index) for index in range(len(self))])
        if self.reading not in TIMES_OF_POSES:
            return self._convert(given)
        extended, num_before = poses_beyond(self.log, given, LATEST)
        return self._convert(extended)[num_before : num_before + len(given)]

    def _convert(self, poses: np.ndarray) -> np.ndarray:
        convert = READINGS[self.reading].of_poses
        return poses if convert is None else convert(poses)

    def _move(self, points: np.ndarray, index: int, pose: Any) -> np.ndarray:
        """Convert points of sweep `index`, (N, 3+), to metres in the frame of the vehicle."""
        if self.reading == WORLD:
            T_ego_points = np.linalg.inv(self._given(index, pose))
            own: Any = self.log.unwrapped
            if own.has_viewpoints:  # the reader took the points for those of the LiDAR
                T_ego_points = T_ego_points @ np.linalg.inv(own.ego_T_lidar)
            return transform_points(points[:, :3], T_ego_points)
        convert = READINGS[self.reading].of_points
        return points[:, :3] if convert is None else convert(points)

    def _given(self, index: int, pose: Any = None) -> np.ndarray:
        if pose is None:
            pose = self.log.sweep(index).pose if self.log.poses is None else self.log.poses[index]
        if pose is None:
            raise CFlowError(f"log {self.log_id}: sweep {index} has no pose, which read_as={self.reading} needs")
        return rigid_transform(pose, f"pose of sweep {index}")
