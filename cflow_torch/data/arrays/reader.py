"""Reader for any sensor: a folder with one point cloud per file, and text files of poses and times."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Mapping, Sequence

import numpy as np

from cflow_torch.data.arrays import poses_text
from cflow_torch.data.arrays.bin_layout import BinLayout, find_bin_layout
from cflow_torch.data.arrays.cloud_file import SUFFIXES, read_columns, read_table
from cflow_torch.data.arrays.pcd import LONGEST_HEADER, pcd_viewpoint
from cflow_torch.data.arrays.poses_text import Trajectory
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.folders import find_folders
from cflow_torch.data.log import Log
from cflow_torch.data.npy_file import read_npy
from cflow_torch.data.paths import PathLike, as_path, is_path_like, is_remote, read_bytes, read_start
from cflow_torch.data.point_times import TIME_FIELDS, PointTimes, seconds_after
from cflow_torch.transforms import poses_from_quaternions, rigid_transform, transform_points
from cflow_torch.types import CFlowError, Sweep
from cflow_torch.windows.returns import missing_returns

POINT_FOLDERS = ("points", "lidar", "velodyne", "clouds", "pcd")  # where the clouds may lie below the log's folder
POSE_FILES = ("poses.txt", "poses.npy", "poses.csv", "trajectory.txt", "trajectory.csv", "odometry.csv")
GROUND_FOLDER = "ground"
_VIEWPOINT = "VIEWPOINT"
SEARCH_DEPTH = 4
_OTHER_STEMS = {"poses", "trajectory", "times", "timestamps", "calib"}
# File names that are times: 16, 17 digits = us, 18, 19 = ns; and seconds with decimals or nanoseconds.
_STAMP = re.compile("[0-9]{16,18}|[0-8][0-9]{18}")
_SECONDS = re.compile(r"\D*([0-9]+)\.([0-9]+)|\D*([0-9]{9,10})_([0-9]+)")
_FIRST_NANOSECOND = 10**17


def find_array_logs(root: PathLike) -> list[Path]:
    """Find the folders of all logs, at most four levels below a folder, sorted.

    A log has two or more clouds of one suffix, in its folder or in a subfolder of `POINT_FOLDERS`.
    """
    what = "a folder with one point cloud per file, or a folder of such"
    is_log, is_passed = (lambda folder: bool(_clouds(folder)[1])), (lambda child: child.name != GROUND_FOLDER)
    return find_folders(as_path(root), is_log, SEARCH_DEPTH, what, is_passed)


class ArraysLog(Log):
    """A folder of point clouds.

    Args:
        folder: holds two or more clouds of one suffix (`cloud_file.SUFFIXES`), or has a subfolder points, lidar,
            velodyne, clouds or pcd that does, or one of any name if it holds poses or times.txt. Clouds are sorted
            naturally: 2 before 10.
        poses: "auto" = poses.txt, odometry.csv or the like (`POSE_FILES`) in the folder, or KITTI's
            ../../poses/<name>.txt, if there is one, or VIEWPOINT of `.pcd` files if it is set; None = no poses; or a
            file (see `read_poses`); or a (K, 4, 4) array.
        poses_of: "ego" or "lidar", the frame whose poses these are.
        calibration: "auto" = `calib.txt` in the folder, if the poses are KITTI's 12 numbers; None = none; or a file. It
            converts poses of KITTI's camera to poses of the LiDAR, and `poses_of` is then ignored.
        times: "auto" = times.txt in the folder; None = none; or a file with one time in seconds per sweep.
        ground: "auto" = the subfolder `ground`, if there is one; None = no masks; or a folder. It has one .npy file per
            cloud, of the same name, with (N,) bool or 0 and 1.
        ego_T_lidar: (4, 4), maps the frame of the stored points to the ego frame; None = they are the same.
        suffix: suffix of the clouds to read, if a folder has several kinds.
        bin_columns: numbers per point of `.bin` files: 4 in KITTI, 5 in nuScenes; "auto" = `find_bin_layout`.

    Attributes:
        files: the clouds, in order.
        timestamps: nanoseconds from `times`, else from file names (see `times_of_names`), else from TUM poses, if each
            cloud has one. Otherwise 0, 1, 2, ..., and sweeps have no `timestamp_ns`.
        poses: (K, 4, 4) float64 `T_world_ego` of every sweep; None = unknown. Sweeps before the first pose, after the
            last one, or in a gap of the poses of more than half a second are left out.
        gaps: indices of sweeps after which sweeps were left out.
        bin_layout: numbers of a point of `.bin` files, None for files of another suffix.
        has_viewpoints: whether the poses come from VIEWPOINT. Such clouds are often in the world's frame (`read_as`).

    Convention:
        `missing_returns` stay, as NaN, so that results have a row for every row of the file.
        Sweeps are in the ego frame: points are transformed by `ego_T_lidar` in float64, then rounded to float32. Poses
        with times (TUM) are interpolated at the times of the sweeps, if these are known. Otherwise there must be one
        pose per sweep. The ego frame should have z up, because the method works in the bird's-eye view.
    """

    has_raw_times: bool = True

    def __init__(
        self,
        folder: PathLike,
        poses: Any = "auto",
        poses_of: str = "ego",
        calibration: PathLike | None = "auto",
        times: PathLike | None = "auto",
        ground: PathLike | None = "auto",
        ego_T_lidar: Any = None,
        suffix: str | None = None,
        bin_columns: int | str = "auto",
    ) -> None:
        self.folder = as_path(folder)
        if poses_of not in ("ego", "lidar"):
            raise CFlowError(f"poses_of={poses_of!r}: pass 'ego' or 'lidar'")
        if bin_columns != "auto" and (type(bin_columns) is not int or bin_columns < 3):
            raise CFlowError(f"bin_columns={bin_columns!r}: pass 'auto' or an integer of at least 3")
        self.log_id = self.folder.resolve().name
        self.files = _one_suffix(self.folder, suffix)
        self.bin_layout = self._find_bin_layout(bin_columns)
        self._ground = _resolve(self.folder, ground, (GROUND_FOLDER,), "ground")
        self.ego_T_lidar = np.eye(4) if ego_T_lidar is None else rigid_transform(ego_T_lidar, "ego_T_lidar")
        self.lidar_position = self.ego_T_lidar[:3, 3]
        trajectory, are_of_lidar = self._trajectory(poses, calibration)
        stamps = self._times(times, trajectory)
        self._has_times = stamps is not None
        self.timestamps: Sequence[int] = list(range(len(self.files))) if stamps is None else stamps
        self.gaps = frozenset()
        self.poses = None if trajectory is None else self._pose_per_sweep(trajectory, stamps)
        if self.poses is not None and (are_of_lidar or poses_of == "lidar"):
            self.poses = self.poses @ np.linalg.inv(self.ego_T_lidar)
        self.has_viewpoints = trajectory is not None and trajectory.source == _VIEWPOINT
        if self.has_viewpoints:
            self._note("its poses come from VIEWPOINT")

    def sweep(self, index: int) -> Sweep:
        """Read sweep `index`: (N, 3) float32 in the ego frame; pose, ground mask and times where they are known."""
        self._timestamp(index)
        points, columns = read_table(self.files[index], self.bin_layout)
        time = self.timestamps[index] if self._has_times else None
        times = self._point_times(columns, time, points)
        is_missing = missing_returns(points)
        if times is not None:
            is_missing |= times.is_stray
        if is_missing.any():
            points = np.where(is_missing[:, None], np.float32(np.nan), points)
        if not np.array_equal(self.ego_T_lidar, np.eye(4)):
            points = transform_points(points, self.ego_T_lidar)
        is_ground = None if self._ground is None else _read_mask(self._ground, self.files[index].stem, len(points))
        pose = None if self.poses is None else self.poses[index].copy()
        seconds = None if times is None else times.seconds
        return Sweep(points.astype(np.float32, copy=False), is_ground, pose, time, seconds)

    def _point_times(
        self, columns: Mapping[str, np.ndarray], time: int | None, points: np.ndarray
    ) -> PointTimes | None:
        """Return the times of the points of a sweep; None = unknown. We say what we assume or leave out."""
        period = float(np.median(np.diff(self.timestamps))) * 1e-9 if self._has_times else None
        names = [name for name in TIME_FIELDS if name in columns]
        found = [seconds_after(columns[name], time or 0, period, points) for name in names]
        usable = [times for times in found if times.seconds is not None]
        for times in usable[:1] or found:
            self._note(times.note, "times of points")
        for times in usable[:1]:
            if times.is_stray.any():
                text = f"{times.is_stray.sum()} of {len(points)} points of a sweep have stray times and become NaN"
                self._note(text + ", also in other sweeps", "stray times")
        return usable[0] if usable else None

    def columns(self, index: int) -> dict[str, np.ndarray]:
        """Read the columns of cloud `index` besides x, y, z, see `cloud_file.read_columns`."""
        self._timestamp(index)
        return read_columns(self.files[index], self.bin_layout)

    def _find_bin_layout(self, columns: Any) -> BinLayout | None:
        """Return the layout of `.bin` files; None = the files have another suffix. We say if it is not KITTI's."""
        first = self.files[0]
        if first.suffix.lower() != ".bin":
            return None
        with file_errors(first):
            layout = find_bin_layout(read_bytes(first), None if columns == "auto" else columns)
        if columns == "auto" and layout != BinLayout():
            self._note(f"its .bin files look like {layout}; data.bin_columns sets another number")
        return layout

    def _trajectory(self, poses: Any, calibration: Any) -> tuple[Trajectory | None, bool]:
        """Return the poses, and whether a calibration converted them to the LiDAR's."""
        if poses is not None and not is_path_like(poses):
            return Trajectory(poses_text.checked_poses(np.asarray(poses), "poses"), None, "matrix", "poses"), False
        kitti = self.folder.resolve().parent.parent / "poses" / f"{self.log_id}.txt"
        file = _resolve(self.folder, poses, POSE_FILES, "poses", kitti)
        if file is None:
            return self._viewpoints() if poses == "auto" else None, False
        trajectory = poses_text.read_poses(file)
        chosen = _resolve(self.folder, calibration, ("calib.txt",), "calibration")
        if chosen is None or (calibration == "auto" and trajectory.layout != "kitti"):
            return trajectory, False
        T_cam_lidar = poses_text.read_calibration(chosen)
        return trajectory._replace(poses=np.linalg.inv(T_cam_lidar) @ trajectory.poses @ T_cam_lidar), True

    def _viewpoints(self) -> Trajectory | None:
        """Read the poses in VIEWPOINT of `.pcd` files; None if no file has one."""
        if self.files[0].suffix.lower() != ".pcd":
            return None
        numbers = np.tile(np.eye(7)[3], (len(self.files), 1))
        for row, file in zip(numbers, self.files):
            with file_errors(file):
                viewpoint = pcd_viewpoint(read_start(file, LONGEST_HEADER))
            row[:] = row if viewpoint is None else viewpoint
        if (numbers == np.eye(7)[3]).all():
            return None
        poses = poses_from_quaternions(numbers[:, :3], numbers[:, 3:], lambda k: f"{self.files[k]}: VIEWPOINT")
        return Trajectory(poses, None, "matrix", _VIEWPOINT)

    def _times(self, times: Any, trajectory: Trajectory | None) -> list[int] | None:
        """Return the nanoseconds of each sweep; None = unknown."""
        count = len(self.files)
        file = _resolve(self.folder, times, ("times.txt",), "times")
        if file is not None:
            stamps = poses_text.read_times(file).tolist()
            if len(stamps) != count:
                raise CFlowError(f"{file} has {len(stamps)} times for {count} sweeps; it needs one each")
            return stamps
        stamps = times_of_names([path.stem for path in self.files])
        if stamps is not None:
            return stamps
        if trajectory is not None and trajectory.times_ns is not None and len(trajectory.times_ns) == count:
            return trajectory.times_ns.tolist()
        return None

    def _pose_per_sweep(self, trajectory: Trajectory, stamps: list[int] | None) -> np.ndarray:
        if trajectory.times_ns is not None and stamps is not None:
            covered = poses_text.are_covered(trajectory, stamps)
            self._note(poses_text.describe_uncovered(trajectory, stamps, covered))
            kept = np.flatnonzero(covered)
            self.files, self.timestamps = [self.files[k] for k in kept], [stamps[k] for k in kept]
            self.gaps = frozenset(np.flatnonzero(np.diff(kept) > 1).tolist())
            self._check_count(f"{self.folder}: without the sweeps that have no pose, it")
            return poses_text.covered_poses(trajectory, self.timestamps)
        if len(trajectory.poses) != len(self.files):
            raise CFlowError(
                f"{trajectory.source} has {len(trajectory.poses)} poses for {len(self.files)} sweeps: pass one each, "
                "or poses with times (TUM) and the times of the sweeps in times.txt"
            )
        return trajectory.poses


def natural_key(name: str) -> tuple[Any, ...]:
    """Return a key for sorting that compares digits in names as numbers: 2 before 10."""
    return tuple((0, int(run), run) if run.isdecimal() else (1, 0, run) for run in re.findall(r"\d+|\D+", name))


def times_of_names(names: Sequence[str]) -> list[int] | None:
    """Return the nanoseconds that names of files state; None if they are not times.

    Names are digits (16, 17 = microseconds, 18, 19 = nanoseconds), or seconds and a fraction, "1700000000.05" or
    "1700000000_050000000", also after a text without digits. Fractions are decimals, unless their numbers of digits
    differ and the longest has nine: then they are nanoseconds without leading zeros.
    """
    if all(_STAMP.fullmatch(name) for name in names):
        return [int(name) * (1 if int(name) >= _FIRST_NANOSECOND else 1000) for name in names]
    matches = [_SECONDS.fullmatch(name) for name in names]
    pairs = [[word for word in match.groups() if word is not None] for match in matches if match is not None]
    if len(pairs) < len(names) or any(len(second) > 10 for second, _ in pairs):
        return None
    digits = {len(fraction) for _, fraction in pairs}
    are_decimals = max(digits) != 9 or len(digits) == 1
    fractions = [int(fraction[:9].ljust(9, "0") if are_decimals else fraction) for _, fraction in pairs]
    return [int(second) * 10**9 + fraction for (second, _), fraction in zip(pairs, fractions)]


def _clouds(folder: Path) -> tuple[Path, dict[str, list[Path]]]:
    """Return the folder that holds a log's clouds, and the clouds of each suffix that has two or more."""
    places = [folder, *(folder / name for name in POINT_FOLDERS)]
    if folder.is_dir() and any((folder / name).exists() for name in (*POSE_FILES, "times.txt")):  # of clouds below
        places += sorted(path for path in folder.iterdir() if path.name not in (*POINT_FOLDERS, GROUND_FOLDER))
    for parent in places:
        kinds: dict[str, list[Path]] = {}
        if parent.is_dir():
            for path in parent.iterdir():
                if path.suffix.lower() in SUFFIXES and path.stem.lower() not in _OTHER_STEMS and path.name[0] != ".":
                    kinds.setdefault(path.suffix.lower(), []).append(path)
        kinds = {suffix: files for suffix, files in kinds.items() if len(files) > 1}
        if kinds:
            return parent, kinds
    return folder, {}


def _one_suffix(folder: Path, suffix: str | None) -> list[Path]:
    parent, kinds = _clouds(folder)
    if suffix is not None:
        kinds = {kind: files for kind, files in kinds.items() if kind == "." + suffix.lower().lstrip(".")}
    if not kinds:
        raise CFlowError(
            f"{folder} and its subfolders {', '.join(POINT_FOLDERS)} have fewer than two point clouds "
            f"({suffix or ', '.join(SUFFIXES)}); scene flow needs two or more"
        )
    if len(kinds) > 1:
        raise CFlowError(f"{parent} has several kinds of clouds, {', '.join(sorted(kinds))}: choose one by suffix=...")
    files = sorted(next(iter(kinds.values())), key=lambda path: natural_key(path.stem))
    stamps = times_of_names([path.stem for path in files])
    return files if stamps is None else [files[k] for k in np.argsort(stamps, kind="stable")]


def _resolve(folder: Path, setting: PathLike | None, names: Sequence[str], what: str, *elsewhere: Path) -> Path | None:
    """Return the file or folder that a setting names, or that "auto" finds; None = none."""
    if setting is None:
        return None
    if setting == "auto":
        found = [parent for parent in (*(folder / name for name in names), *elsewhere) if parent.exists()]
        if len(found) > 1:
            several = ", ".join(path.name for path in found)
            raise CFlowError(f"{folder} has several files for {what}: {several}; choose one with {what}=...")
        return found[0] if found else None
    path = as_path(setting)
    path = path if is_remote(path) or path.is_absolute() or path.exists() else folder / path
    if not path.exists():
        raise CFlowError(f"{what}={str(setting)!r} does not exist, neither here nor in {folder}")
    return path


def _read_mask(folder: Path, stem: str, rows: int) -> np.ndarray:
    file = folder / f"{stem}.npy"
    mask = read_npy(file, "every sweep needs its ground mask, or pass ground=None")
    if mask.shape not in ((rows,), (rows, 1)) or mask.dtype.kind not in "biu" or not np.isin(mask, (0, 1)).all():
        raise CFlowError(f"{file} has shape {mask.shape} and dtype {mask.dtype} for {rows} points; masks are (N,) bool")
    return mask.reshape(rows).astype(bool)
