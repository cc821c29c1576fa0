"""Experimental reader of AevaScenes: FMCW LiDARs, one `sequence.json`, and one .npz file per LiDAR and frame."""

from __future__ import annotations

import io
import math
from functools import lru_cache
from pathlib import Path
from typing import Any, Sequence

import numpy as np
from numpy.lib import format as npy

from cflow_torch.data.boxes import Boxes, category_indices, flow_from_boxes, make_boxes
from cflow_torch.data.files import file_errors, shortened
from cflow_torch.data.json_file import read_json
from cflow_torch.data.log import FlowLabels, Log
from cflow_torch.data.names import path_inside
from cflow_torch.data.paths import PathLike, as_path, read_bytes
from cflow_torch.data.pickles import load_array
from cflow_torch.data.rigid_motion import poses_from_json, transform_points
from cflow_torch.types import CFlowError, Sweep
from cflow_torch.windows.ego_motion import relative_transform

_HINT = "copy the sequence from the data set again"

CATEGORY_NAME: dict[str, str] = {
    **dict.fromkeys(("unknown", "pole_trunk", "building", "other_structure", "vegetation"), "NONE"),
    "car": "REGULAR_VEHICLE",
    "bus": "BUS",
    "truck": "TRUCK",
    "trailer": "VEHICULAR_TRAILER",
    "vehicle_on_rails": "RAILED_VEHICLE",
    "other_vehicle": "LARGE_VEHICLE",
    "bicycle": "BICYCLE",
    "motorcycle": "MOTORCYCLE",
    "motorcyclist": "MOTORCYCLIST",
    "bicyclist": "BICYCLIST",
    "pedestrian": "PEDESTRIAN",
    "animal": "ANIMAL",
    "traffic_item": "CONSTRUCTION_CONE",
    "traffic_sign": "SIGN",
}
"""Class of AevaScenes -> Argoverse 2 name. The data set publishes no such map; this one is ours."""

GROUND = ("road", "lane_boundary", "road_marking", "reflective_marker", "sidewalk", "other_ground")
"""Classes of ground points."""
CATEGORY_NAME.update(dict.fromkeys(GROUND, "NONE"))

_PATHS = {"compensated": ("point_cloud_compensated_path", "point_cloud_path"), "raw": ("point_cloud_raw_path",)}


class AevaScenesLog(Log):
    """One sequence in the layout of version 0.1, 0.2 or 2. Experimental: tested on simulated sequences only.

    Args:
        folder: sequence folder with `sequence.json`.
        clouds: "compensated", or "raw" (version 2 only, where the data set does not document what raw means).
        lidars: names of the LiDARs to merge; None = all of the sequence, in its order.
        ground: make ground masks from the stored class names, where every cloud of a sweep has them.

    Attributes:
        log_id: name of the folder.
        timestamps: frame times in nanoseconds, ascending.
        lidars: names of the LiDARs that are merged.

    Convention:
        - Points are float32 in the vehicle frame (x forward, y left, z up, origin at the rear axle), one LiDAR after
          the other, transformed in float64 by `vehicle_to_lidar_extrinsics`, which despite its name is
          `T_vehicle_lidar`.
        - `T_world_ego` is `ego_pose`, world = vehicle at the first frame.
        - Truth comes from box tracks. Boxes of background classes (mostly poles) are not used.
        - Class names are stored as pickled strings, which are decoded without executing anything.
          `semantic_labels_idx` is not used, because its table is not published.

    Raises:
        CFlowError: no such folder or setting; `sequence.json` is missing, not JSON, or incomplete; fewer than two
            frames.
    """

    def __init__(
        self,
        folder: PathLike,
        clouds: str = "compensated",
        lidars: Sequence[str] | None = None,
        ground: bool = True,
    ) -> None:
        self.folder = as_path(folder)
        self.log_id = self.folder.resolve().name
        if clouds not in _PATHS:
            raise CFlowError(f"clouds={clouds!r}: choose one of {', '.join(_PATHS)}")
        self._clouds, self._ground = clouds, ground
        self._clouds_of = lru_cache(1)(self._open_clouds)  # several arrays of a sweep's clouds are read
        self._file = self.folder / "sequence.json"
        with file_errors(self._file, _HINT):
            content = read_json(self._file)
            mounts, known = content["metadata"]["vehicle_to_lidar_extrinsics"], content["metadata"]["sensors"]["lidars"]
            self.lidars: Sequence[str] = tuple(known if lidars is None else lidars)
            if not self.lidars or not set(self.lidars) <= set(known):
                wanted = shortened(list(self.lidars))
                raise CFlowError(f"{self._file} has the LiDARs {shortened(known)}, you asked for {wanted}")
            by_time: dict[int, dict[str, Any]] = {frame["timestamp_ns"]: frame for frame in content["frames"]}
            self.timestamps = sorted(by_time)
            self._check_count(self._file)
            self._frames = [by_time[time] for time in self.timestamps]
            self._mounts = self._poses_of([mounts[name] for name in self.lidars], "extrinsics")
            self._poses = self._poses_of([frame["ego_pose"] for frame in self._frames], "ego poses")
            self._has_boxes = any(frame.get("boxes") for frame in self._frames)

    def sweep(self, index: int) -> Sweep:
        """Read sweep `index`; `is_ground` is None if one of its clouds has no class names."""
        points, is_ground = self._points(index), None
        names = [cloud.names("semantic_labels") for cloud in self._clouds_of(index)] if self._ground else [None]
        if None not in names:
            is_ground = np.array([name in GROUND for of_cloud in names for name in of_cloud or ()], dtype=bool)
            if len(is_ground) != len(points):
                file = self._clouds_of(index)[0].file
                raise CFlowError(f"{file} and the other LiDARs: {len(points)} points but {len(is_ground)} class names")
        return Sweep(points, is_ground, self._poses[index].copy(), self.timestamps[index], self._point_times(index))

    def radial_velocity(self, index: int) -> np.ndarray:
        """Read the (N,) float32 radial velocities of sweep `index`, m/s, positive = moving away from the LiDAR.

        In compensated clouds the motion of the vehicle is removed, so static points have about 0. Third parties
        measured the sign, which contradicts a comment in the SDK.

        Raises:
            CFlowError: no such sweep, or a cloud is missing or cannot be read.
        """
        return np.concatenate([cloud.numbers("velocity", 1)[:, 0] for cloud in self._clouds_of(index)])

    def labels(self, index: int) -> FlowLabels | None:
        """Read the truth of the pair (index, index + 1) from box tracks; None for the last sweep and without boxes."""
        self._timestamp(index)
        if index == len(self) - 1 or not self._has_boxes:
            return None
        T_ego1_ego0 = relative_transform(self._poses[index + 1], self._poses[index])
        return flow_from_boxes(self._points(index), self._boxes(index), self._boxes(index + 1), T_ego1_ego0)

    def _points(self, index: int) -> np.ndarray:
        """Read the (N, 3) float32 points in the vehicle frame."""
        pairs = zip(self._clouds_of(index), self._mounts)
        clouds = [transform_points(cloud.numbers("xyz", 3), mount) for cloud, mount in pairs]
        return np.concatenate(clouds).astype(np.float32)

    def _point_times(self, index: int) -> np.ndarray | None:
        """Read the (N,) float64 seconds after the time stamp; None if a cloud has no times."""
        clouds = self._clouds_of(index)
        times = [cloud.seconds("time_offset_ns", len(cloud.numbers("xyz", 3))) for cloud in clouds]
        known = [of_cloud for of_cloud in times if of_cloud is not None]
        return np.concatenate(known) if len(known) == len(times) else None

    def _open_clouds(self, index: int) -> list[Cloud]:
        where, clouds = f"{self._file}, frame {self._timestamp(index)}", []
        for name in self.lidars:
            with file_errors(where, _HINT):
                entry = self._frames[index]["point_cloud"][name]
                paths = [entry[key] for key in _PATHS[self._clouds] if key in entry]
            if not paths:
                has = f"there is no {self._clouds} cloud, only {shortened(entry)}"
                raise CFlowError(f"{where}, {name}: {has}; only version 2 of the data set has raw clouds")
            clouds.append(Cloud(path_inside(self.folder, paths[0], f"{where}, {name}: the path")))
        return clouds

    def _boxes(self, index: int) -> Boxes:
        where = f"{self._file}, frame {self.timestamps[index]}"
        with file_errors(where, _HINT):
            boxes = self._frames[index].get("boxes") or []
            boxes = [box for box in boxes if CATEGORY_NAME.get(box["class"]) != "NONE"]
            frames = [box.get("reference_frame", "VEHICLE") for box in boxes]
            if set(frames) - {"VEHICLE"}:
                raise CFlowError(f"boxes must be in VEHICLE, got {shortened(sorted(set(frames)))}")
            return make_boxes(
                [str(box["id"]) for box in boxes],
                category_indices([box["class"] for box in boxes], CATEGORY_NAME),
                [[box["dimensions"][axis] for axis in "xyz"] for box in boxes],
                self._poses_of([box["pose"] for box in boxes], f"frame {self.timestamps[index]}, boxes"),
            )

    def _poses_of(self, nodes: Sequence[Any], what: str) -> np.ndarray:
        """Build (K, 4, 4) float64 poses from objects with translation {x, y, z} and rotation {w, x, y, z}."""
        return poses_from_json(nodes, "translation", "rotation", f"{self._file}: {what}: number")


class Cloud:
    """One .npz file in memory; arrays are unpacked when you ask for them.

    A missing or damaged file, or an array of another type or shape, is a `CFlowError`.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        with file_errors(file, _HINT):
            self._arrays = np.load(io.BytesIO(read_bytes(file)), allow_pickle=False)
            self._keys = list(self._arrays.files)

    def numbers(self, key: str, columns: int) -> np.ndarray:
        """Return an array as (N, columns) float32."""
        if key not in self._keys:
            raise CFlowError(f"{self.file} has no array {key}; it has {self._keys[:20]}")
        array = self._array(key, np.floating, lambda a: a.size % columns == 0 and a.shape[1:] in ((), (columns,)))
        return array.reshape(-1, columns).astype(np.float32, copy=False)

    def seconds(self, key: str, rows: int) -> np.ndarray | None:
        """Return an array of integer nanoseconds as (rows,) float64 seconds; None if there is no such array."""
        if key not in self._keys:
            return None
        return self._array(key, np.integer, lambda a: a.shape in ((rows,), (rows, 1))).reshape(rows) * 1e-9

    def _array(self, key: str, kind: type, is_shape: Any) -> np.ndarray:
        with file_errors(f"{self.file}: {key}", _HINT):
            array: np.ndarray = self._arrays[key]
            if not np.issubdtype(array.dtype, kind) or not is_shape(array):
                raise CFlowError(f"{self.file}: {key} has shape {array.shape} and dtype {array.dtype}; {_HINT}")
            return array

    def names(self, key: str) -> list[str] | None:
        """Return the texts of an array of any shape, executing nothing; None if there is no such array."""
        if key not in self._keys:
            return None
        with file_errors(f"{self.file}: {key}", _HINT):
            with self._arrays.zip.open(f"{key}.npy") as member:
                npy.read_magic(member)
                shape, _, dtype = npy.read_array_header_1_0(member)
                stored = load_array(member) if dtype.hasobject else self._arrays[key]
            texts: list[str] = stored.ravel().tolist()
            if {type(text) for text in texts} - {str} or len(texts) != math.prod(shape):
                raise ValueError(f"it must hold {math.prod(shape)} strings")
            return texts
