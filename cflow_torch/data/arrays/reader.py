"""Reader for any sensor: a folder with one point cloud per file, and text files of poses and times."""

from __future__ import annotations

import re
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Sequence

import numpy as np

from cflow_torch.data.arrays import poses_text
from cflow_torch.data.arrays.bin_layout import BinLayout, find_bin_layout
from cflow_torch.data.arrays.cloud_file import in_single, read_columns, read_table
from cflow_torch.data.arrays.folder import (
    GROUND_FOLDER,
    find_clouds,
    find_poses,
    find_times_files,
    only_one,
    other_folders,
    read_all,
    resolve,
    tell_unused_poses,
)
from cflow_torch.data.arrays.pcd import LONGEST_HEADER, pcd_viewpoint
from cflow_torch.data.arrays.stamps import times_of_names
from cflow_torch.data.calibration import CAMERA_KEYS, read_calibration, transform
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.finding import CHOOSE
from cflow_torch.data.folders import natural_key
from cflow_torch.data.log import Log
from cflow_torch.data.log_motion import fits_better
from cflow_torch.data.npy_file import read_npy
from cflow_torch.data.paths import PathLike, as_path, is_path_like, read_bytes, read_start, stem_of, suffix_of
from cflow_torch.data.point_times import find_times
from cflow_torch.data.trajectory import Trajectory, checked_poses
from cflow_torch.transforms import poses_from_quaternions, rigid_transform, transform_points
from cflow_torch.types import CFlowError, Sweep
from cflow_torch.windows.returns import missing_returns

_VIEWPOINT = "VIEWPOINT"  # source of poses that come with the clouds
_LEAST_NAMED = 0.5  # share of the sweeps whose numbers poses have, if poses have numbers
_LEAST_REACH = 0.8  # part of a table after which the row of the last file is, unless the layout says so
_LEAST_USUAL = 2 / 3  # share of steps between the numbers of files that are equal, or the numbers are irregular
_LONG_STEP = 10  # usual steps between irregular numbers; a longer one is a gap


class ArraysLog(Log):
    """A folder of point clouds.

    Args:
        folder: of a log, see `find_array_logs`. Clouds are sorted by the times in their names, else naturally: 2
            before 10.
        poses: "auto" = one of `POSE_FILES` in the folder, or KITTI's ../../poses/<name>.txt, or the only file or
            folder there whose contents are poses, or VIEWPOINT of `.pcd` files if it is set, or the only file of text
            in a folder near this one that has poses at the unix times of the sweeps; None = no poses; or a file (see
            `read_poses`); or a (K, 4, 4) array.
        poses_of: whose poses these are: "ego", "lidar", or "sensor" = of another sensor. Then `ego_T_lidar` maps to
            this sensor, the ego frame is the LiDAR's, and the points stay. "auto" = of the LiDAR if they come from
            VIEWPOINT, or if `ego_T_lidar` is given and the sweeps then fit clearly better, else "ego".
        calibration: "auto" = `calib.txt` in the folder, if the poses are KITTI's 12 numbers; None = none; or a file. It
            converts poses of KITTI's camera to poses of the LiDAR, and `poses_of` is then ignored.
        times: "auto" = times.txt in the folder, or see `timestamps`; None = none; or a file with one time per sweep.
        ground: "auto" = the subfolder `ground`, if there is one; None = no masks; or a folder. It has one .npy file per
            cloud, of the same name, with (N,) bool or 0 and 1.
        ego_T_lidar: (4, 4), maps the frame of the stored points to the ego frame; None = they are the same.
        suffix: suffix, or pattern of the names ("front_*.pcd"), of the clouds to read, if a folder has several kinds.
        bin_columns: numbers per point of `.bin` files: 4 in KITTI, 5 in nuScenes; "auto" = `find_bin_layout`.

    Attributes:
        files: the clouds, in order.
        timestamps: nanoseconds from `times`, else from file names (see `times_of_names`), else from TUM poses, if each
            cloud has one, else from the only file named so with one time per cloud. Otherwise 0, 1, 2, ..., and sweeps
            have no `timestamp_ns`.
        poses: (K, 4, 4) float64 `T_world_ego` of every sweep, see `fit_to_sweeps`; None = unknown. Without times, there
            is one pose per sweep, or each sweep takes that of its name or number.
        trajectory: times and `T_world_ego` of all poses, by which `DeskewedLog` moves points; None = without times.
        bin_layout: numbers of a point of `.bin` files, None for files of another suffix.
        has_viewpoints: whether the poses come from VIEWPOINT. Such clouds are often in the world's frame (`read_as`).

    Convention:
        `missing_returns` stay, as NaN, so that results have a row for every row of the file. Sweeps are in the ego
        frame, which should have z up. Unless `poses_of` is "sensor", points are transformed by `ego_T_lidar` in
        float64, then rounded to float32.
    """

    has_raw_times: bool = True
    # Whether numbers of files are rows of tables in this layout. Else the last number must be near the end of a table.
    _numbers_are_rows = False

    def __init__(
        self,
        folder: PathLike,
        poses: Any = "auto",
        poses_of: str = "auto",
        calibration: PathLike | None = "auto",
        times: PathLike | None = "auto",
        ground: PathLike | None = "auto",
        ego_T_lidar: Any = None,
        suffix: str | None = None,
        bin_columns: int | str = "auto",
    ) -> None:
        self.folder = as_path(folder)
        if poses_of not in ("auto", "ego", "lidar", "sensor"):
            raise CFlowError(f"poses_of={poses_of!r}: pass 'auto', 'ego', 'lidar' or 'sensor'")
        if bin_columns != "auto" and (type(bin_columns) is not int or bin_columns < 3):
            raise CFlowError(f"bin_columns={bin_columns!r}: pass 'auto' or an integer of at least 3")
        self.log_id = self.folder.resolve().name
        self.files = find_clouds(self.folder, suffix)
        self.bin_layout = self._find_bin_layout(bin_columns)
        self._bin_columns: Any = self.bin_layout if bin_columns == "auto" else bin_columns
        self._name_other_folders()
        self._ground = resolve(self.folder, ground, (GROUND_FOLDER,), "ground")
        mounting = np.eye(4) if ego_T_lidar is None else rigid_transform(ego_T_lidar, "ego_T_lidar")
        stamps, table = self._known_times(times)
        trajectory, whose = self._trajectory(poses, poses_of, calibration, stamps)
        self.has_viewpoints = trajectory is not None and trajectory.source == _VIEWPOINT
        whose = "lidar" if whose == "auto" and self.has_viewpoints else whose
        self.ego_T_lidar = np.eye(4) if whose == "sensor" else mounting
        self._sensor_T_lidar = mounting if whose == "sensor" else np.eye(4)
        self.lidar_position = self.ego_T_lidar[:3, 3]
        stamps = self._chosen_times(stamps, table, trajectory)
        self._has_times = stamps is not None
        self.timestamps: Sequence[int] = list(range(len(self.files))) if stamps is None else stamps
        self.poses = None
        if trajectory is not None:
            frame_T_ego = {"lidar": np.linalg.inv(mounting), "sensor": mounting}.get(whose, np.eye(4))
            self._take_poses(trajectory._replace(poses=trajectory.poses @ frame_T_ego))
        self.gaps |= frozenset(self._gaps_in_numbers())
        self._note(f"its poses come from {_VIEWPOINT}" if self.has_viewpoints else "")
        if whose == "auto" and ego_T_lidar is not None and self.poses is not None:
            self._ask_whose_poses()

    def mounting_with(self, T_poses_points: np.ndarray) -> np.ndarray:
        return self._sensor_T_lidar @ T_poses_points @ self.ego_T_lidar

    def sweep(self, index: int) -> Sweep:
        """Read sweep `index`: (N, 3) float32 in the ego frame; pose, ground mask and times where they are known."""
        self._timestamp(index)
        points, columns = read_table(self.files[index], self._bin_columns)
        time = self.timestamps[index] if self._has_times else None
        period = float(np.median(np.diff(self.timestamps))) * 1e-9 if self._has_times else None
        is_missing = missing_returns(points)
        times = find_times(columns, time, period, self._note, is_missing)
        if times is not None:
            is_missing |= times.is_stray
        if is_missing.any():
            points = np.where(is_missing[:, None], np.float32(np.nan), points)
        if not np.array_equal(self.ego_T_lidar, np.eye(4)):
            points = transform_points(points, self.ego_T_lidar)
        is_ground = None if self._ground is None else _read_mask(self._ground, stem_of(self.files[index]), len(points))
        pose = None if self.poses is None else self.poses[index].copy()
        seconds = None if times is None else times.seconds
        return Sweep(in_single(points), is_ground, pose, time, seconds)

    def frame_number(self, index: int) -> int:
        """Return the number of the file of sweep `index`; the index if the files are not numbered regularly."""
        self._timestamp(index)
        return self._frame_numbers[index]

    @cached_property
    def _frame_numbers(self) -> Sequence[int]:
        stems = [stem_of(path) for path in self.files]
        numbers = [_number_of(stem) for stem in stems]
        return numbers if times_of_names(stems) is None and _are_regular(numbers) else range(len(numbers))

    def columns(self, index: int) -> dict[str, np.ndarray]:
        """Read the columns of cloud `index` besides x, y, z, see `cloud_file.read_columns`."""
        self._timestamp(index)
        return read_columns(self.files[index], self._bin_columns)

    def _name_other_folders(self) -> None:
        others = other_folders(self.folder)
        if others:
            self._note(f"we read the clouds in {self.files[0].parent.name}; there are others in {', '.join(others)}")

    def _find_bin_layout(self, columns: Any) -> BinLayout | None:
        """Return the layout of `.bin` files; None = the files have another suffix. We say if it is not KITTI's."""
        first = self.files[0]
        if suffix_of(first) != ".bin":
            return None
        with file_errors(first):
            layout = find_bin_layout(read_bytes(first), None if columns == "auto" else columns)
        if columns == "auto" and layout != BinLayout():
            self._note(f"its .bin files look like {layout}; data.bin_columns sets another number")
        return layout

    def _trajectory(
        self, poses: Any, poses_of: str, calibration: Any, stamps: Sequence[int] | None
    ) -> tuple[Trajectory | None, str]:
        """Return the poses, and whose they are: of the LiDAR if a calibration converted them, else as given."""
        if poses is not None and not is_path_like(poses):
            return Trajectory(checked_poses(np.asarray(poses), "poses"), None, False, "poses"), poses_of
        if poses == "auto":
            found = find_poses(self.folder, self.files, stamps, partial(self._fits, stamps), self._note)
            trajectory = found or self._viewpoints()
            if trajectory is None and not any(CHOOSE in note for note in self.notes):
                tell_unused_poses(self.folder, self.files, partial(self._fits, stamps), self._note)
        else:
            file = resolve(self.folder, poses, (), "poses")
            trajectory = None if file is None else poses_text.read_poses(file)
        if trajectory is None:
            return None, poses_of
        chosen = resolve(self.folder, calibration, ("calib.txt",), "calibration")
        if chosen is None or (calibration == "auto" and not trajectory.is_kitti):
            return trajectory, poses_of
        values = read_calibration(chosen)
        if calibration == "auto" and values.keys().isdisjoint(CAMERA_KEYS):
            fix = "if they are KITTI's poses of a camera, download data_odometry_calib.zip, which has it"
            self._note(f"{chosen.name} has no Tr, so we take the poses for those of the LiDAR: {fix}")
            return trajectory, poses_of
        T_cam_lidar = transform(values, chosen, *CAMERA_KEYS)
        converted = np.linalg.inv(T_cam_lidar) @ trajectory.poses @ T_cam_lidar
        if calibration == "auto" and _drives_along_x(trajectory.poses) and not _drives_along_x(converted):
            self._note(
                f"{trajectory.source} has poses that drive along x, the LiDAR's axis ahead, not along z, the camera's. "
                f"So we take them for poses of the LiDAR, and ignore Tr of {chosen.name}"
            )
            return trajectory, "lidar"
        return trajectory._replace(poses=converted), "lidar"

    def _chosen_times(
        self, stamps: list[int] | None, table: Path | None, trajectory: Trajectory | None
    ) -> list[int] | None:
        """Choose the times of poses, if each cloud has one, before those of a table; nanoseconds."""
        if stamps is not None and table is None:
            return stamps
        of_poses = None if trajectory is None else trajectory.counted(None).times_ns
        if of_poses is not None and len(of_poses) == len(self.files):
            return of_poses.tolist()  # type: ignore[no-any-return]
        if table is not None:
            self._note(f"the times of its sweeps are those of {table.name}")
        return stamps

    def _ask_whose_poses(self) -> None:
        """Take the poses for those of the LiDAR if the static world then stands still clearly better."""
        lidar_T_ego = np.linalg.inv(self.ego_T_lidar)
        others = np.asarray(self.poses) @ lidar_T_ego
        try:
            are_of_lidar = fits_better(self, others)
        except (CFlowError, OSError):  # `sweep` raises the error of the sweep that cannot be read
            return
        if are_of_lidar:
            self._note("its points fit better if its poses are those of the LiDAR; data.poses_of=lidar confirms it")
            self.poses = others
            self.trajectory = self.trajectory and (self.trajectory[0], self.trajectory[1] @ lidar_T_ego)

    def _fits(self, stamps: Sequence[int] | None, trajectory: Trajectory) -> bool:
        """Test whether poses may be those of the sweeps: by their times, their labels or their number."""
        trajectory = trajectory.counted(stamps)
        if stamps is not None and trajectory.times_ns is not None:
            return trajectory.covers(stamps)
        return self._rows(len(trajectory.poses), trajectory.labels) is not None

    def _viewpoints(self) -> Trajectory | None:
        """Read the poses in VIEWPOINT of `.pcd` files; None if no file has one."""
        if suffix_of(self.files[0]) != ".pcd":
            return None
        numbers = np.tile(np.eye(7)[3], (len(self.files), 1))
        for row, file in zip(numbers, self.files):
            with file_errors(file):
                viewpoint = pcd_viewpoint(read_start(file, LONGEST_HEADER))
            row[:] = row if viewpoint is None else viewpoint
        known = np.flatnonzero(np.isfinite(numbers).all(axis=1) & numbers[:, 3:].any(axis=1))
        if (numbers[known] == np.eye(7)[3]).all():
            return None
        poses = np.full((len(numbers), 4, 4), np.nan)
        poses[known] = poses_from_quaternions(
            numbers[known, :3], numbers[known, 3:], lambda k: f"{self.files[known[k]]}: VIEWPOINT"
        )
        return Trajectory(poses, None, False, _VIEWPOINT)

    def _known_times(self, times: Any) -> tuple[list[int] | None, Path | None]:
        """Return the nanoseconds of each sweep by times.txt, else by the names of the files; None = unknown.

        Else they are those of the only other file of so many times, which is also returned.
        """
        file = resolve(self.folder, times, ("times.txt",), "times")
        if file is not None:
            stamps = poses_text.read_times(file)
            rows = self._rows(len(stamps), what=f"times in {file}")
            if rows is None:
                raise CFlowError(f"{file} has {len(stamps)} times for {len(self.files)} sweeps; it needs one each")
            return stamps[rows].tolist(), None
        of_names = times_of_names([stem_of(path) for path in self.files])
        if of_names is not None or times != "auto":
            return of_names, None
        read = read_all(find_times_files(self.folder, self.files), poses_text.read_times, self._note)
        read = {table: known for table, known in read.items() if len(known) == len(self.files)}
        table = only_one(list(read), self.folder, "times")
        return (None, None) if table is None else (read[table].tolist(), table)

    def _rows(self, count: int, labels: Sequence[str] = (), what: str = "") -> np.ndarray | None:
        """Return the row of each file in a table of `count` rows, one per sweep; None = the table does not fit.

        Labels of the rows may be the names of the files, or have their numbers. If they have those of more than half of
        the files, the others have no row (-1). Labels of one kind without these numbers have the order of the files.
        If there are no labels and files are missing, the numbers of the files tell the rows, from 0 or 1 on, and we say
        so if you pass `what` the rows are.
        """
        stems = [stem_of(path) for path in self.files]
        names = [Path(label).stem for label in labels] if len(labels) == count else []
        row_of = dict(zip(names, range(count)))
        if row_of.keys() >= set(stems):
            return np.array([row_of[stem] for stem in stems])
        least = _LEAST_NAMED if count != len(stems) else 1 - 1e-9
        rows = self._rows_of_numbers([_number_of(name) for name in names], least)
        if rows is None and len(row_of) == len(stems) and len({re.sub(r"\d+", "", label) for label in labels}) == 1:
            rows = np.array(sorted(range(count), key=lambda row: natural_key(labels[row])))
        if rows is not None or count == len(stems):
            return np.arange(count) if rows is None else rows
        firsts = (0,) if self._numbers_are_rows else (0, 1)
        by_number = [self._rows_of_numbers(range(first, first + count), 1 - 1e-9) for first in firsts]
        fitting = [each for each in by_number if each is not None]
        if len(fitting) != 1:
            return None
        self._note(f"it has {count} {what} for {len(stems)} sweeps, so each takes that of its number" if what else "")
        return fitting[0]

    def _rows_of_numbers(self, numbers: Sequence[int], least: float) -> np.ndarray | None:
        """Return the row of the number of each file in a table whose rows have numbers, -1 = it has none.

        None = the table does not fit: a number comes twice, it has those of at most a share `least` of the files, or
        it goes on far behind the last file, so it is of another rate.
        """
        of_files = [_number_of(stem_of(path)) for path in self.files]
        row_of = dict(zip(numbers, range(len(numbers))))
        if not row_of or len(row_of) < len(numbers) or len(set(of_files)) < len(of_files):
            return None
        rows = np.array([row_of.get(number, -1) for number in of_files])
        is_near_end = self._numbers_are_rows or max(of_files) >= _LEAST_REACH * max(row_of)
        return rows if is_near_end and (rows >= 0).mean() > least else None

    def _take_poses(self, trajectory: Trajectory) -> None:
        """Take the pose of each sweep, by its time or its row, and leave out sweeps that have none."""
        trajectory = trajectory.counted(self.timestamps if self._has_times else None)
        source = trajectory.source
        where = f"{self.folder}: without the sweeps that have no pose, it"
        if trajectory.times_ns is not None and self._has_times:
            kept = self._use_poses(trajectory, where)
        else:
            rows = self._rows(len(trajectory.poses), trajectory.labels, f"poses in {source}")
            if rows is None:
                raise CFlowError(
                    f"{source} has {len(trajectory.poses)} poses for {len(self.files)} sweeps: pass one each, or poses "
                    "with times (TUM) and the times of the sweeps in times.txt, or none (data.poses=null)"
                )
            is_known = np.isfinite(trajectory.poses[rows]).all(axis=(1, 2)) & (rows >= 0)
            if not is_known.all():
                count = f"{(~is_known).sum()} of {len(rows)} sweeps"
                self._note(f"{count} have no pose, or one of NaN or zeros, in {source} and are left out")
            kept = self._keep(is_known, where)
            self.poses = trajectory.poses[rows[kept]]
        self.files = [self.files[k] for k in kept]

    def _gaps_in_numbers(self) -> list[int]:
        """Return the indices of files without times after which others are missing, by the numbers in their names."""
        numbers = [_number_of(stem_of(path)) for path in self.files]
        steps = np.diff(numbers)
        usual = np.sort(steps)[(len(steps) - 1) // 2]
        longest = usual if _are_regular(numbers) else _LONG_STEP * usual
        gaps = [gap for gap in np.flatnonzero(steps > longest).tolist() if gap not in self.gaps]
        if self._has_times or not gaps or steps.min() <= 0:
            return []
        first = self.files[gaps[0]].name
        missing = f"sweeps are missing by the numbers of its files, first after {first}"
        self._note(f"{missing}; no history or future of a window reaches over them")
        return gaps  # type: ignore[no-any-return]


def _are_regular(numbers: Sequence[int]) -> bool:
    """Test whether numbers of files ascend, most by the same step."""
    steps = np.diff(numbers)
    return bool(steps.min() > 0 and (steps == np.median(steps)).mean() >= _LEAST_USUAL)


def _number_of(stem: str) -> int:
    """Return the last number in the name of a file; -1 = it has none."""
    digits = re.findall(r"\d+", stem)
    return int(digits[-1]) if digits else -1


def _drives_along_x(poses: np.ndarray) -> bool:
    """Test whether poses (K, 4, 4) move along their own x axis more than along y and z."""
    steps = np.linalg.inv(poses[:-1]) @ poses[1:]
    along = np.nansum(np.abs(steps[:, :3, 3]), axis=0)  # unknown poses are NaN
    return bool(along[0] > along[1] + along[2])


def _read_mask(folder: Path, stem: str, rows: int) -> np.ndarray:
    file = folder / f"{stem}.npy"
    mask = read_npy(file, "every sweep needs its ground mask, or set data.ground=null")
    if mask.shape not in ((rows,), (rows, 1)) or mask.dtype.kind not in "biu" or not np.isin(mask, (0, 1)).all():
        raise CFlowError(f"{file} has shape {mask.shape} and dtype {mask.dtype} for {rows} points; masks are (N,) bool")
    return mask.reshape(rows).astype(bool)
