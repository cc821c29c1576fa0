"""Reader of OpenSceneFlow's HDF5 scenes: one file per scene, one group per sweep, named by its time stamp."""

from __future__ import annotations

import re
import weakref
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from cflow_torch.data.arrays.cloud_file import in_single
from cflow_torch.data.arrays.stamps import times_of_names
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.folders import search, visible
from cflow_torch.data.hdf5.frames import StoredMotion, harness_motion, is_argoverse2, recognized_extrinsics
from cflow_torch.data.log import FlowLabels, Log
from cflow_torch.data.paths import PathLike, as_path, is_timestamp, source_for_random_access
from cflow_torch.data.point_times import find_times
from cflow_torch.errors import CFlowError, import_optional
from cflow_torch.transforms import poses_from_quaternions, rigid_transform
from cflow_torch.types import Sweep
from cflow_torch.windows.returns import missing_returns

# Time stamps count from 1970 or 1980: smaller ones are microseconds (16 digits), others nanoseconds (18 or 19).
_FIRST_NANOSECOND = 10**17
_FIRST_MICROSECOND = 10**14
_LARGEST_CATEGORY = 255
_MOST_COLUMNS = 64  # of a sweep with fewer points than columns; more are those of a transposed one
_LONGEST_LAG = 10.0  # seconds from a sweep to its points
EXTRINSIC = "ego_T_lidar"  # attribute of a scene that `write_hdf5_scene` stores


def find_hdf5_scenes(root: PathLike) -> list[Path]:
    """Return the scene files of a folder or, if it has none, of its subfolders (train, val), sorted; or the given file.

    A missing path is a `CFlowError`.
    """

    def scenes_in(folder: Path) -> list[Path]:
        return [folder] if folder.is_file() else [path for path in visible(folder) if path.suffix == ".h5"]

    return sorted(search(as_path(root), scenes_in, 1, "a scene (.h5), or a folder of scenes"))


class HDF5Log(Log):
    """One scene. Needs h5py (`pip install h5py`).

    Args:
        file: `<scene>.h5`.
        ego_T_lidar: (4, 4), maps the frame of the stored points to the frame of the stored poses; None = they are the
            same; "auto" = recognise it (see Convention).
        needs_poses: True = a sweep of unknown pose is an error; False = its pose is None, as `with_poses` expects.

    Attributes:
        timestamps: nanoseconds, ascending. Names of groups (`sweep_name`) may be nanoseconds, microseconds, seconds
            with decimals (1700000000.05, 1700000000_050000000), dates, or numbers (000000, frame_0). Sweeps with
            numbers have no `timestamp_ns`.
        ego_T_lidar: (4, 4) float64, the transform in use.

    Convention:
        - Points, labels and results stay in the frame of the stored points. A sweep's `pose` is the pose of this frame:
          the stored pose times `ego_T_lidar`. So the poses fit the points even if the file combines points in the
          sensor frame with poses of the ego vehicle.
        - A scene without `pose` gets poses from `ego_motion`; the world is then the frame of the first sweep.
        - "auto" uses the file's attribute `ego_T_lidar` if it has one (our writer's files do), otherwise
          `recognized_extrinsics` of the first sweep.
        - Index files next to a scene are pickles: they are never opened.
    """

    def __init__(self, file: PathLike, ego_T_lidar: Any = "auto", needs_poses: bool = True) -> None:
        self.file, self._needs_poses = as_path(file), needs_poses
        self._chain: list[Any] = []  # poses of the first sweeps, from `ego_motion` where they have none; None = unknown
        self.log_id = self.file.stem
        self._scene = open_scene(self.file)
        # HDF5 would close the file after the interpreter has ended, which crashes if it is a Python file object.
        weakref.finalize(self, self._scene.close)
        with scene_errors(self.file):
            self._names = sweep_names(self._scene)
            self.timestamps = sorted(self._names)
        self._check_count(f"{self.file} (with a group for each sweep, called by its time, which holds lidar)")
        self.is_compensated = is_argoverse2(self.timestamps[0])
        if isinstance(ego_T_lidar, str) and ego_T_lidar == "auto":
            ego_T_lidar = self._stated_extrinsics()
        elif ego_T_lidar is None:
            ego_T_lidar = np.eye(4)
        self.ego_T_lidar = rigid_transform(ego_T_lidar, f"ego_T_lidar of {self.file}")

    def __reduce__(self) -> Any:
        return HDF5Log, (self.file, self.ego_T_lidar, self._needs_poses)  # another process opens the file itself

    def close(self) -> None:
        self._scene.close()

    def mounting_with(self, T_poses_points: np.ndarray) -> np.ndarray:
        return self.ego_T_lidar @ T_poses_points

    def sweep(self, index: int) -> Sweep:
        """Read sweep `index`: points, float64 pose of their frame; ground mask and times if stored.

        Points are float32, but float64 in the frame of a map that is too far for float32. `missing_returns` are NaN.
        """
        rows, timestamp = self._rows(index), self.timestamps[index]
        points = self._values(index, "lidar")[:, :3]
        points = points if points.dtype == np.float64 else points.astype(np.float32)
        is_missing = missing_returns(points) | (np.abs(points) > np.finfo(np.float32).max).any(axis=1)
        time = None if self.timestamps[-1] < _FIRST_MICROSECOND else timestamp  # None: the groups are numbered
        times = self._values(index, "lidar_dt", rows)
        if times is not None and np.abs(times).max(initial=0) > _LONGEST_LAG:  # of another unit or clock
            period = None if time is None else float(np.median(np.diff(self.timestamps))) * 1e-9
            found = find_times({"time": times}, time, period, self._note, is_missing)
            times = None if found is None else found.seconds
            is_missing |= False if found is None else found.is_stray
        elif times is not None:
            times = times.astype(np.float32)
        if is_missing.any():
            points = np.where(is_missing[:, None], points.dtype.type(np.nan), points)
        is_ground = self._values(index, "ground_mask", rows, np.bool_)
        pose = self._stored_pose(index)
        if pose is None and self._needs_poses:
            raise CFlowError(
                f"{self.file}: sweep {self.sweep_name(index)} has no pose; it has {', '.join(self.keys(index))}. Store "
                "pose (T_world_ego) of every sweep, or ego_motion to the next sweep, or set data.odometry=true"
            )
        if pose is not None and not np.array_equal(self.ego_T_lidar, np.eye(4)):
            pose = rigid_transform(pose, f"pose of sweep {self.sweep_name(index)} in {self.file}") @ self.ego_T_lidar
        if pose is not None and not np.isfinite(pose).all():
            raise CFlowError(f"{self.file}: the pose of sweep {self.sweep_name(index)} is not finite")
        return Sweep(in_single(points), is_ground, pose, time, times)

    def _labels(self, index: int) -> FlowLabels | None:
        rows = self._rows(index)
        flow = self._values(index, "flow", (*rows, 3), np.float32)
        if flow is None:
            return None
        category = self._values(index, "flow_category_indices", rows)
        is_valid = self._values(index, "flow_is_valid", rows, np.bool_)
        where = f"{self.file}: sweep {self.sweep_name(index)}"
        if category is None or is_valid is None:
            raise CFlowError(f"{where} has flow without flow_category_indices or flow_is_valid")
        if category.dtype.kind not in "iu" or category.max(initial=0) > _LARGEST_CATEGORY:
            raise CFlowError(f"{where}: flow_category_indices must be integers up to {_LARGEST_CATEGORY}")
        # Waymo's scenes have int8, and -1 = no label.
        return FlowLabels(flow, category.clip(0).astype(np.uint8), is_valid & (category >= 0))

    def eval_mask(self, index: int) -> np.ndarray | None:
        """Read which points are scored, (N,) bool; None if the sweep has no `eval_mask`."""
        return self._values(index, "eval_mask", self._rows(index), np.bool_)

    def stored_motion(self, index: int) -> StoredMotion:
        """Compute the ego motion that OpenSceneFlow uses for the pair (index, index + 1), from the stored poses."""
        poses: Any = [self._stored_pose(k, None) for k in (index, index + 1)]
        for pose in poses:
            rigid_transform(pose, f"pose of sweep {index} or {index + 1} of {self.file}")
        return StoredMotion(harness_motion(*poses), np.array_equal(self.ego_T_lidar, np.eye(4)))

    def sweep_name(self, index: int) -> str:
        return self._names[self._timestamp(index)]

    def keys(self, index: int) -> tuple[str, ...]:
        """Return the names of all arrays of sweep `index`, results included."""
        with scene_errors(self.file):
            return tuple(sorted(self._group(index)))

    def values(self, index: int, key: str) -> np.ndarray:
        """Read the array that sweep `index` stores under a key. Columns (N, 1) become (N,).

        A key that the sweep does not have is a `CFlowError`, which lists those that it has. Keys are for example
        `lidar` (N, 3+), `ego_motion` (4, 4) from the ego frame to that of the next sweep, `flow_instance_id` (N,) with
        0 = background, `lidar_id` (N,), `lidar_dt` (N,) in seconds, `lidar_center` (L, 4, 4) ego_T_sensor, `dufo`,
        `cluster`, and the name of a result, (N, 3) total flow.
        """
        values = self._values(index, key)
        if values is None:
            has = ", ".join(self.keys(index))
            raise CFlowError(f"{self.file}: sweep {self.sweep_name(index)} has no {key}; it has {has}")
        return values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values

    @cached_property
    def poses(self) -> np.ndarray | None:
        """(K, 4, 4) float64 `T_world_lidar` of every sweep, without reading any points; NaN or None = unknown."""
        of_sweeps = [self._stored_pose(index) for index in range(len(self))]
        if all(pose is None for pose in of_sweeps):
            return None
        stored = np.stack([np.full((4, 4), np.nan) if pose is None else pose for pose in of_sweeps])
        with np.errstate(all="ignore"):  # NaN stays NaN
            return stored @ self.ego_T_lidar

    def _matrix(self, index: int, key: str, dtype: Any) -> np.ndarray | None:
        """Read a rigid transform, (4, 4); a file may have only its upper three rows, or x y z qx qy qz qw."""
        matrix = self._values(index, key, None, dtype)
        if matrix is None or matrix.shape == (4, 4):
            return matrix  # type: ignore[no-any-return]
        if matrix.shape == (3, 4):
            return np.concatenate([matrix, np.eye(4, dtype=matrix.dtype)[3:]])
        if matrix.shape == (7,):
            where = f"{self.file}: {key} of sweep {self.sweep_name(index)}"
            return poses_from_quaternions(matrix[:3], matrix[[6, 3, 4, 5]], lambda _: where)[0]
        return self._values(index, key, (4, 4), dtype)  # type: ignore[no-any-return]  # raises the error

    def _stored_pose(self, index: int, dtype: Any = np.float64) -> Any:
        """Read a pose, or compute it from the pose before and the ego motion; None = it is unknown."""
        pose = self._matrix(index, "pose", dtype)
        if pose is not None:
            return pose
        for k in range(len(self._chain), index + 1):
            pose = self._matrix(k, "pose", np.float64)
            motion = None if pose is not None else self._matrix(max(k - 1, 0), "ego_motion", np.float64)
            if pose is None and k == 0:  # without poses, the world is the first ego frame
                has_motions = motion is not None and self._matrix(1, "pose", np.float64) is None
                pose = np.eye(4) if has_motions else None
            elif pose is None and motion is not None and self._chain[-1] is not None:
                motion = rigid_transform(motion, f"ego_motion of sweep {self.sweep_name(k - 1)} in {self.file}")
                pose = self._chain[-1] @ np.linalg.inv(motion)
            self._chain.append(pose)
        return self._chain[index]

    def _stated_extrinsics(self) -> np.ndarray:
        """Return the extrinsics of the scene's attribute, otherwise the recognised ones."""
        with scene_errors(f"{self.file}: attribute {EXTRINSIC}"):
            if EXTRINSIC in self._scene.attrs:
                return np.asarray(self._scene.attrs[EXTRINSIC], np.float64)
        points = self._values(0, "lidar") if is_argoverse2(self.timestamps[0]) else None
        if points is None:
            return np.eye(4)
        is_ground = self._values(0, "ground_mask", (len(points),), np.bool_)
        return recognized_extrinsics(self.timestamps[0], points, is_ground)

    def _group(self, index: int) -> Any:
        return member(self._scene, self.sweep_name(index), self.file)

    def _rows(self, index: int) -> tuple[int]:
        """Return the number of points of a sweep without reading them, as the shape of a column."""
        where = f"{self.file}: sweep {self.sweep_name(index)}"
        stored = member(self._group(index), "lidar", where)
        if stored is None:
            raise CFlowError(
                f"{where} has no lidar, its (N, 3+) points; it has {', '.join(self.keys(index)) or 'nothing'}"
            )
        if len(stored.shape) != 2 or not 3 <= stored.shape[1] <= max(_MOST_COLUMNS, stored.shape[0]):
            raise CFlowError(f"{where}: lidar has shape {stored.shape}, not (N, 3+)")
        return (stored.shape[0],)

    def _values(self, index: int, key: str, shape: tuple[int, ...] | None = None, dtype: Any = None) -> Any:
        """Read the array of a key, None if there is none. Its stored shape may have one more axis, of length 1."""
        group, what = self._group(index), f"{self.file}: {key} of sweep {self.sweep_name(index)}"
        stored = member(group, key, what)
        if stored is None:
            return None
        with scene_errors(what), np.errstate(over="ignore"):  # float64 beyond float32 becomes infinite, "no return"
            shape = stored.shape if shape is None else shape
            if stored.shape not in (shape, (*shape, 1)):
                raise CFlowError(f"{what} has shape {stored.shape}, expected {shape}")
            return stored[()].reshape(shape).astype(dtype or stored.dtype, copy=False)


_HINT = "write the scene again, as groups with arrays of plain numbers in the file itself"
scene_errors = partial(file_errors, hint="copy or write the scene again")


def sweep_names(scene: Any) -> dict[int, str]:
    """Return the time stamp of each sweep of an open scene, nanoseconds, or its number, and the name of its group.

    Names are numbers. Otherwise they are those that are alike apart from their digits, and state times or numbers.
    """
    names = {int(name): name for name in scene if is_timestamp(name)}
    if _FIRST_MICROSECOND <= max(names, default=0) < _FIRST_NANOSECOND:
        names = {1000 * stamp: name for stamp, name in names.items()}
    if names:
        return names
    forms: dict[str, list[str]] = {}
    for name in scene:
        if re.search("[0-9]", name):
            forms.setdefault(re.sub("[0-9]+", "0", name), []).append(name)
    alike = max(forms.values(), key=len, default=[])
    numbers = [re.findall("[0-9]+", name) for name in alike]
    stamps = times_of_names(alike) or [int(each[0]) for each in numbers if len(each) == 1 and len(each[0]) < 19]
    return dict(zip(stamps, alike)) if len({*stamps}) == len(alike) else {}


def import_h5py() -> Any:
    return import_optional("h5py", "HDF5 scenes need h5py (extra hdf5): pip install h5py")


def open_scene(file: Path) -> Any:
    """Open a scene for reading. A missing package or file, or a file that is not HDF5, raises a `CFlowError`."""
    h5py = import_h5py()
    with scene_errors(file):
        return h5py.File(source_for_random_access(file), "r")


def member(group: Any, name: str, where: PathLike) -> Any | None:
    """Return the group or the numeric array with a name in a group of h5py; None if there is none.

    A link, data in another file (which we never open), and an array of another type are a `CFlowError` that begins with
    `where`.
    """
    h5py = import_h5py()
    with scene_errors(f"{where}: {name}"):
        link = group.get(name, getlink=True)
        if link is None:
            return None
        # `group[name]` of a link could open a file elsewhere.
        found: Any = group[name] if isinstance(link, h5py.HardLink) else None
        is_array = isinstance(found, h5py.Dataset)
        if found is None or (is_array and (found.is_virtual or found.external)):
            raise CFlowError(f"{where}: {name} is a link or lies in other files, which are not read; {_HINT}")
        if is_array and (found.shape is None or found.dtype.kind not in "biuf"):
            raise CFlowError(f"{where}: {name} is not an array of bool, integers or floats; {_HINT}")
        return found
