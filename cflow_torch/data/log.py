"""Logs and their windows. A log is an ordered sequence of sweeps, which are read when you ask for them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Callable, Iterator, Mapping, Sequence, TypeVar, overload

import numpy as np
from torch.utils.data import Dataset

from cflow_torch.data.camera import Camera
from cflow_torch.data.finding import Finding
from cflow_torch.data.trajectory import Trajectory, fit_to_sweeps
from cflow_torch.diagnosis.inspection import repeats
from cflow_torch.diagnosis.pair import LEAST_DISTANCE, is_around
from cflow_torch.diagnosis.readings import Judgement
from cflow_torch.errors import warn
from cflow_torch.transforms import poses_at
from cflow_torch.types import CFlowError, Sweep, Window, as_numpy, check_array

_GAP, _LONGEST_STEP = 2.5, 0.45  # a gap is longer than so many usual intervals, and seconds
_Log = TypeVar("_Log", bound="Log")


@dataclass(frozen=True)
class FlowLabels:
    """Ground truth of one pair of sweeps, rows in the order of sweep t.

    Args:
        flow: (N, 3) float32, metres, TOTAL flow t -> t+1 (ego motion included), axes of ego1.
        category: (N,) uint8, Argoverse 2 index 1 ... 30, 0 = background.
        is_valid: (N,) bool, False where the truth is unknown.
    """

    flow: np.ndarray
    category: np.ndarray
    is_valid: np.ndarray

    def __post_init__(self) -> None:
        check_array(self.flow, "FlowLabels.flow", (None, 3), "f", "(N, 3) floats, metres, total flow")
        rows = len(self.flow)
        wanted = f"({rows},) integers, Argoverse 2 index of each point, 0 = background"
        check_array(self.category, "FlowLabels.category", (rows,), "iu", wanted)
        check_array(self.is_valid, "FlowLabels.is_valid", (rows,), "b", f"({rows},) bool, False = unknown")


class Log(ABC):
    """One drive, a sequence of sweeps: `len(log)`, `log[-1]`, `log[1:3]`, `for sweep in log` and `with log` work.

    To write your own reader, set `log_id` and `timestamps`, and implement `sweep` and, if the log has truth, `labels`.

    Attributes:
        log_id: name of the log, safe as a folder name; the name of its file or folder unless the reader says otherwise.
        timestamps: sweep times, nanoseconds, ascending; other ascending numbers if the sweeps have no `timestamp_ns`.
        gaps: indices of sweeps after which sweeps are left out; `open_log` adds those after which none follows for
            long. No history or future of a window reaches over a gap, and the commands and `track` leave out the pair
            over it (`pairs`).
        is_compensated: True = the format is known to be compensated for ego motion within a sweep.
        has_raw_times: True = sweeps with `point_times` are expected not to be compensated.
        has_sparse_poses: True = most poses are interpolated between sweeps.
        has_estimated_poses: True = we estimated the poses from the points (`cflow_torch.data.odometry`).
        lidar_position: (3,) metres, position of the rotating LiDAR in the frame of the points.
        has_viewpoints: True = the poses come with the clouds, which are then often in the world's frame.
        turn_seconds: duration of a turn of the LiDAR; None = the median time between two sweeps.

    Convention: our readers return float32 points and float64 poses `T_world_ego`. Opening a log reads its poses and
        times, and `sweep` and `labels` read the rest.

    Raises:
        CFlowError: a file is missing, damaged or incomplete, a setting is not allowed, or there are fewer than two
            sweeps. After an error of `sweep` or `labels` you can still read other sweeps.
    """

    log_id: str
    timestamps: Sequence[int]
    gaps: frozenset[int] = frozenset()
    has_viewpoints: bool = False
    has_sparse_poses: bool = False
    has_estimated_poses: bool = False
    # What `cflow_torch.data.deskewing` must know of a reader.
    is_compensated: bool = False
    has_raw_times: bool = False
    lidar_position: Any = (0.0, 0.0, 0.0)
    turn_seconds: float | None = None

    @abstractmethod
    def sweep(self, index: int) -> Sweep:
        """Read sweep `index`: float32 points, float64 pose `T_world_ego`, ground mask, time."""

    def labels(self, index: int) -> FlowLabels | None:
        """Read the truth of the pair (index, index + 1); None for the last sweep, at a gap, and if the log has none."""
        self._timestamp(index)
        return self._labels(index) if index < len(self) - 1 and index not in self.gaps else None

    def _labels(self, index: int) -> FlowLabels | None:
        """Read the truth of a pair that exists."""
        return None

    # What a log may have beyond sweeps and labels. Readers and wrappers set or override it.

    @cached_property
    def poses(self) -> np.ndarray | None:
        """(K, 4, 4) float64 `T_world_ego` of every sweep; None = unknown before the points are read."""
        return None

    @cached_property
    def trajectory(self) -> tuple[np.ndarray, np.ndarray] | None:
        """(M,) int64 nanoseconds and (M, 4, 4) float64 `T_world_ego` at these times; None = only `poses` are known."""
        return None

    @property
    def readings(self) -> tuple[str, ...]:
        """The readings under which points and poses are converted, in this order, see `cflow_torch.data.read_as`."""
        return ()

    @cached_property
    def surrounds_poses(self) -> bool:
        """Whether points lie around the position of their pose, by the sweep that is farthest from the origin.

        Cost: reads this sweep if it is at least 3 m from the origin.
        """
        poses = known_poses(self)
        if poses is None:
            return False
        distance = np.linalg.norm(poses[:, :2, 3], axis=1)
        farthest = int(distance.argmax())
        return bool(distance[farthest] >= LEAST_DISTANCE) and is_around(self.sweep(farthest).points, poses[farthest])

    @property
    def judgement(self) -> Judgement | None:
        """How well readings of the poses fit, if they were compared to read the log."""
        return None

    def mounting_with(self, T_poses_points: np.ndarray) -> np.ndarray:
        """Return the setting `ego_T_lidar` under which the points are moved by more, (4, 4), from where they are read.

        The setting replaces the mounting that is in use, so it contains this.
        """
        return T_poses_points

    def findings(self) -> list[Finding]:
        """Return what was found, and is used, to read the log."""
        return []

    def eval_mask(self, index: int) -> np.ndarray | None:
        """Read which points of sweep `index` are evaluated, (N,) bool."""
        return None

    def stored_motion(self, index: int) -> Any:
        """Read the ego motion that the file stores for the pair (index, index + 1)."""
        return None

    def moving(self, index: int) -> np.ndarray | None:
        """Read which points of sweep `index` move, (N,) bool, where labels say only that."""
        return None

    def units(self, index: int) -> Any:
        """Read the returns of each LiDAR of a simulated sweep."""
        return None

    def boxes(self, index: int) -> Any:
        """Read the boxes of a simulated sweep."""
        return None

    def columns(self, index: int) -> Mapping[str, np.ndarray]:
        """Read the other columns of the points of sweep `index`, such as intensity, ring and time.

        Models ignore them; `write_array_log` and `cflow clean` (`CleanLog`) keep them.

        Returns:
            Name -> (N,) bool, integers or floats, as stored; empty if the reader has no such columns.
        """
        self._timestamp(index)
        return {}

    def cameras(self, index: int) -> Sequence[Camera]:
        """Return the calibrated cameras at the time of sweep `index`; () if the log has no calibration of cameras."""
        self._timestamp(index)
        return ()

    @property
    def T_camera0_lidar(self) -> np.ndarray | None:
        """(4, 4) float64, from the LiDAR to KITTI's rectified camera 0; None = the log has no such camera."""
        return None

    def frame_number(self, index: int) -> int:
        """Return the number of sweep `index` in the data set, such as that of its file; the index if it has none."""
        self._timestamp(index)
        return index

    def finds_ground(self, index: int) -> bool:
        """Tell whether the ground mask of sweep `index` is ours, not one of the data set."""
        return False

    def sweep_times(self, sweep_interval: float = 0.1) -> np.ndarray:
        """Return the (K,) float64 seconds of all sweeps, 0 for the first. Reads one sweep.

        Without time stamps, sweeps are `sweep_interval` seconds apart. Where sweeps are missing by their numbers
        (`frame_number`), the time goes on.
        """
        if self.sweep(0).timestamp_ns is not None:
            stamps = np.array(self.timestamps, np.int64)
            return (stamps - stamps[0]) * 1e-9  # type: ignore[no-any-return]
        frames = np.array([self.frame_number(index) for index in range(len(self))])
        usual = np.median(np.diff(frames)) if len(frames) > 1 else 1
        return sweep_interval * (frames - frames[0]) / usual  # type: ignore[no-any-return]

    def sweep_name(self, index: int) -> str:
        """Return the name of sweep `index` in the data set and in its submissions."""
        return str(self._timestamp(index))

    @cached_property
    def sample_tokens(self) -> Sequence[str | None]:
        """Names of the sweeps in files of nuScenes; None = the sweep of a scene of nuScenes is not a key frame."""
        return [f"{self.log_id}_{timestamp}" for timestamp in self.timestamps]

    @property
    def pairs(self) -> list[int]:
        """The indices of all sweeps t whose next one is t+1: without the last sweep, and those before gaps."""
        return [index for index in range(len(self) - 1) if index not in self.gaps]

    def windows(self, num_history: int = 0, num_future: int = 0) -> Iterator[Window]:
        """Iterate over the windows of all sweeps but the last one, also of those before gaps; each is read once.

        See `window`.
        """
        return windows(self, num_history, num_future)

    @property
    def notes(self) -> list[str]:
        """What the reader assumed, left out or could not use so far: sentences, each also given as a `CFlowWarning`."""
        return list(self.__dict__.get("_notes", {}).values())

    def _note(self, text: str, kind: str = "") -> None:
        """Warn, but only once in a log for texts of one `kind`; "" = once for each text."""
        notes = self.__dict__.setdefault("_notes", {})
        if text and (kind or text) not in notes:
            notes[kind or text] = text
            warn(f"log {self.log_id}: {text}")

    def close(self) -> None:
        """Close the files that the log holds open."""
        return

    @property
    def unmoved(self) -> Log:
        """The log before its sweeps are de-skewed; the log itself if they are not."""
        return self

    def repeats(self, index: int) -> bool:
        """Test whether sweep `index` has the points of the one before, also if both are de-skewed by other motions."""
        if len(self.sweep(index - 1).points) != len(self.sweep(index).points):
            return False
        return repeats(self.unmoved.sweep(index - 1), self.unmoved.sweep(index))

    @property
    def unwrapped(self) -> Log:
        """The log without its wrappers (ground, poses, cache)."""
        return self

    def __enter__(self: _Log) -> _Log:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"{type(self.unwrapped).__name__}({self.log_id}, {len(self.timestamps)} sweeps)"

    def __len__(self) -> int:
        return len(self.timestamps)

    @overload
    def __getitem__(self, index: int) -> Sweep: ...
    @overload
    def __getitem__(self, index: slice) -> list[Sweep]: ...
    def __getitem__(self, index: int | slice) -> Sweep | list[Sweep]:
        chosen = range(len(self))[index]
        return self.sweep(chosen) if isinstance(chosen, int) else [self.sweep(k) for k in chosen]

    def __iter__(self) -> Iterator[Sweep]:
        return map(self.sweep, range(len(self)))

    def _timestamp(self, index: int) -> int:
        """Return the time stamp of sweep `index`; an index out of range is a `CFlowError`."""
        if not 0 <= index < len(self.timestamps):
            raise CFlowError(f"log {self.log_id} has sweeps 0 ... {len(self) - 1}, you asked for {index}")
        return self.timestamps[index]

    def _use_poses(self, trajectory: Trajectory, where: Any) -> np.ndarray:
        """Take poses with times, keep the sweeps that have one, with a note, and return their indices.

        `where` as in `_check_count`.
        """
        self.poses, is_covered, note = fit_to_sweeps(trajectory, self.timestamps)
        self._note(note)
        self.has_sparse_poses = trajectory.is_sparse(self.timestamps)
        self.trajectory = np.asarray(trajectory.times_ns), trajectory.poses
        return self._keep(is_covered, where)

    def _keep(self, is_kept: np.ndarray, where: Any) -> np.ndarray:
        """Leave out sweeps, (K,) bool, with gaps in their places, and return the indices of the others.

        `where` as in `_check_count`.
        """
        kept = np.flatnonzero(is_kept)
        self.timestamps = [self.timestamps[k] for k in kept]
        self.gaps |= frozenset(np.flatnonzero(np.diff(kept) > 1).tolist())
        self._check_count(where)
        return kept

    def _check_count(self, where: Any) -> None:
        """Refuse a log without a pair of sweeps; `where` begins the message."""
        if len(self.timestamps) < 2:
            raise CFlowError(f"{where} has {len(self.timestamps)} sweeps; scene flow needs two or more")


def known_poses(log: Log) -> np.ndarray | None:
    """Return the poses that a log knows without reading points, (K, 4, 4) float64; None = it knows none."""
    try:
        poses = log.poses
    except CFlowError:
        return None
    if poses is None or np.shape(poses) != (len(log.timestamps), 4, 4) or not np.isfinite(poses).all():
        return None
    return np.asarray(poses, np.float64)


def poses_beyond(log: Log, poses: np.ndarray, count: int) -> tuple[np.ndarray, int]:
    """Return the poses of a log, and up to `count` more on each side if its trajectory goes on, (L, 4, 4) float64.

    Also return how many are before the first sweep. All are a usual interval of the sweeps apart.
    """
    if log.trajectory is None or len(log.timestamps) != len(poses):
        return poses, 0
    known, driven = log.trajectory
    interval = int(np.median(np.diff(log.timestamps)))
    before = log.timestamps[0] - interval * np.arange(count, 0, -1)
    after = log.timestamps[-1] + interval * np.arange(1, count + 1)
    before, after = before[before >= known[0]], after[after <= known[-1]]
    sides = [poses_at(times, known, driven) if len(times) else poses[:0] for times in (before, after)]
    return np.concatenate([sides[0], poses, sides[1]]), len(before)


def typical_sweeps(log: Log) -> list[int]:
    """Return those of the first, middle and last sweep that can be read, and have most of the points; [0] = none can.

    A recording may begin and end within a turn of its LiDAR.
    """
    num_points = {}
    for index in sorted({0, (len(log.timestamps) - 1) // 2, len(log.timestamps) - 1}):
        try:
            num_points[index] = int(np.isfinite(as_numpy(log.sweep(index).points)[:, 0]).sum())
        except (CFlowError, OSError):
            continue
    most = max(num_points.values(), default=0)
    return [index for index, count in num_points.items() if count >= most / 2] or [0]


def intervals_of(log: Log) -> np.ndarray | None:
    """Return the (K-1,) float64 seconds from each sweep to the next; None = sweeps have no times. Reads one sweep."""
    return None if log.sweep(0).timestamp_ns is None else np.diff(np.array(log.timestamps, np.int64)) * 1e-9


def gaps_in(steps: np.ndarray) -> list[int]:
    """Return the indices of sweeps after which none follows for long, from the (K-1,) seconds between sweeps."""
    if not len(steps):
        return []
    return np.flatnonzero((steps > _GAP * np.median(steps)) & (steps > _LONGEST_STEP)).tolist()  # type: ignore[no-any-return]


def add_gaps_in_time(log: Log) -> None:
    """Add the gaps after which no sweep follows for long to those of a log, with a note. Stamps are nanoseconds."""
    steps = np.diff(log.timestamps) * 1e-9
    gaps = [gap for gap in gaps_in(steps) if gap not in log.gaps]
    if gaps:
        first = f"the first is {steps[gaps[0]]:.2g} s long, after sweep {gaps[0]}"
        log._note(
            f"it has {len(gaps)} gaps between sweeps ({first}); no history or future of a window reaches over them"
        )
        log.gaps = log.gaps.union(gaps)


def window(log: Log, index: int, num_history: int = 0, num_future: int = 0) -> Window:
    """Read the window for the flow from sweep `index` to sweep `index + 1`.

    It has fewer than `num_history` older or `num_future` later sweeps at the ends of the log, at its gaps and, with a
    warning, at a sweep whose file is missing or damaged. A pair that cannot be read is a `CFlowError`, and so is
    another sweep that the file system does not give.
    """
    count = len(log.timestamps)
    if not 0 <= index < count - 1:
        raise CFlowError(f"log {log.log_id} has {count} sweeps; a pair needs 0 <= index < {count - 1}, got {index}")
    history = range(index - 1, max(index - 1 - num_history, -1), -1)
    future = range(index + 2, min(index + 2 + num_future, count))
    pair = log.sweep(index), log.sweep(index + 1)
    return Window(*pair, *(tuple(_readable(log, indices)) for indices in (history, future)))


def _readable(log: Log, indices: range) -> Iterator[Sweep]:
    """Yield the sweeps of a history or future, up to a gap of the log or a sweep whose file is missing or damaged."""
    for index in indices:
        if (index if indices.step < 0 else index - 1) in log.gaps:
            return
        try:
            sweep = log.sweep(index)
        except CFlowError as error:
            if _may_pass(error):
                raise
            warn(f"log {log.log_id}: windows near sweep {index} are shorter, because {error}")
            return
        yield sweep


def _may_pass(error: BaseException | None) -> bool:
    """Test whether the file system caused an error, such as a lost connection. Then the next run may read the sweep.

    Its errors have an `errno`, or are of a connection (h5py passes on those of remote files). An OSError without one is
    of a library that finds the content damaged, such as gzip.
    """
    if error is None:
        return False
    is_of_system = isinstance(error, OSError) and error.errno is not None
    return is_of_system or isinstance(error, (ConnectionError, TimeoutError)) or _may_pass(error.__cause__)


def windows(log: Log, num_history: int = 0, num_future: int = 0) -> Iterator[Window]:
    """Iterate over the windows of all sweeps but the last one, also of those before gaps; each sweep is read once."""
    cached = CachedLog(log, num_history + num_future + 2)
    return (window(cached, index, num_history, num_future) for index in range(len(log.timestamps) - 1))


class WindowDataset(Dataset):  # type: ignore[type-arg]
    """The windows of one or more logs, for a `torch.utils.data.DataLoader`. Logs must be picklable for its workers.

    Examples:
        >>> data = WindowDataset(logs, num_history=model.config.num_history)
        >>> loader = DataLoader(data, batch_size=4, num_workers=2, collate_fn=data.collate)
        >>> for batch in loader:
        ...     results = model(batch)
    """

    def __init__(self, logs: Log | Sequence[Log], num_history: int = 0, num_future: int = 0) -> None:
        several: Any = [logs] if isinstance(logs, Log) else logs
        self._pairs = [(log, index) for log in several for index in range(len(log.timestamps) - 1)]
        self._num_history, self._num_future = num_history, num_future
        self._cached: CachedLog | None = None

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, number: int) -> Window:
        log, index = self._pairs[number]
        if self._cached is None or self._cached.log is not log:
            self._cached = CachedLog(log, self._num_history + self._num_future + 2)
        return window(self._cached, index, self._num_history, self._num_future)

    @staticmethod
    def collate(windows: Sequence[Window]) -> list[Window]:
        """Return the windows as a list. Sweeps of different numbers of points cannot be stacked."""
        return list(windows)


class LogWrapper(Log):
    """Base class of logs that change the sweeps of another log. Every other member comes from the other log."""

    def __init__(self, log: Log) -> None:
        self.log, self.log_id, self.timestamps, self.gaps = log, log.log_id, log.timestamps, log.gaps

    @property
    def unmoved(self) -> Log:
        return self if self.log.unmoved is self.log else self.log.unmoved

    def __getattr__(self, name: str) -> Any:
        if name == "log" or name.startswith("__"):  # Python asks for hooks while it unpickles, before `log` is set
            raise AttributeError(name)
        return getattr(self.log, name)


class _OfLog:
    """A member of a wrapper that is the member of the wrapped log."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, wrapper: Any, owner: Any = None) -> Any:
        return self if wrapper is None else getattr(wrapper.log, self._name)


for _name in (
    *("labels", "columns", "cameras", "poses", "trajectory", "readings", "judgement", "findings"),
    *("eval_mask", "stored_motion", "moving", "units", "boxes", "T_camera0_lidar", "sample_tokens"),
    *("sweep_name", "frame_number", "sweep_times", "finds_ground", "mounting_with"),
    *("has_estimated_poses", "notes", "_note", "close", "unwrapped"),
):
    setattr(LogWrapper, _name, _OfLog(_name))  # `__getattr__` is not asked for members that `Log` has


class TimedLog(LogWrapper):
    """A log whose sweeps all have a `timestamp_ns`: their own, or one by `Log.sweep_times`. `timestamps` stay."""

    def __init__(self, log: Log, sweep_interval: float = 0.1) -> None:
        super().__init__(log)
        self._sweep_interval = sweep_interval

    def sweep(self, index: int) -> Sweep:
        sweep = self.log.sweep(index)
        return sweep if sweep.timestamp_ns is not None else replace(sweep, timestamp_ns=self._stamps[index])

    def sweep_times(self, sweep_interval: float = 0.1) -> np.ndarray:
        return self.log.sweep_times(self._sweep_interval)

    @cached_property
    def _stamps(self) -> list[int]:
        return [round(1e9 * seconds) for seconds in self.sweep_times().tolist()]


class CachedLog(LogWrapper):
    """A log that keeps the last `count` sweeps in memory, because neighbouring windows share all sweeps but one."""

    def __init__(self, log: Log, count: int) -> None:
        super().__init__(log)
        self._count = count
        self._sweep: Callable[[int], Sweep] = lru_cache(count)(log.sweep)

    def __reduce__(self) -> Any:
        return CachedLog, (self.log, self._count)

    def sweep(self, index: int) -> Sweep:
        return self._sweep(index)

    @cached_property
    def unmoved(self) -> Log:
        return self if self.log.unmoved is self.log else CachedLog(self.log.unmoved, 2)

    def stop(self) -> None:
        """Forget the sweeps, and keep none from now on, so that callers may write into what they get."""
        self.__dict__.pop("unmoved", None)
        self._count = 0
        self._sweep = lru_cache(0)(self.log.sweep)
