"""Experimental reader of AevaScenes: FMCW LiDARs, one `sequence.json`, and one .npz file per LiDAR and frame."""

from __future__ import annotations

import io
from functools import lru_cache
from pathlib import Path
from typing import Any, Sequence

import numpy as np
from numpy.lib import format as npy

from cflow_torch.data.boxes import Boxes, BoxLog, category_indices
from cflow_torch.data.file_errors import file_errors, shortened
from cflow_torch.data.json_file import read_json
from cflow_torch.data.paths import PathLike, as_path, path_inside, read_bytes
from cflow_torch.data.pickles import load_array
from cflow_torch.transforms import poses_from_json, transform_points
from cflow_torch.types import CFlowError, Sweep, check_array
from cflow_torch.windows.returns import missing_returns

_HINT = "copy the sequence from the data set again"

GROUND = ("road", "lane_boundary", "road_marking", "reflective_marker", "sidewalk", "other_ground")
"""Classes of ground points."""

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
    **dict.fromkeys(GROUND, "NONE"),
}
"""Class of AevaScenes -> Argoverse 2 name. This map is ours, because the data set publishes none."""

_PATHS = {"compensated": ("point_cloud_compensated_path", "point_cloud_path"), "raw": ("point_cloud_raw_path",)}


class AevaScenesLog(BoxLog):
    """One sequence in the layout of version 0.1, 0.2 or 2. Experimental: tested on simulated sequences only.

    Args:
        folder: sequence folder with `sequence.json`.
        clouds: "compensated" or "raw". Only version 2 has raw clouds; the data set does not document what raw means.
        lidars: names of the LiDARs to merge; None = all of the sequence, in its order.
        ground: make a ground mask from the stored class names, if all clouds of the sweep have them.

    Attributes:
        lidars: names of the LiDARs that are merged.
        poses: (K, 4, 4) float64 `T_world_ego` of every sweep.

    Convention:
        - Points are in the vehicle frame (x forward, y left, z up, origin at the rear axle), one LiDAR after the other.
          We transform them in float64 by `vehicle_to_lidar_extrinsics`, which is `T_vehicle_lidar` despite its name.
        - `T_world_ego` is `ego_pose`; the world is the vehicle frame of the first sweep.
        - Truth comes from box tracks. Boxes of background classes (mostly poles) are ignored.
        - Classes come from `semantic_labels`, not from `semantic_labels_idx`, because its table is not published.
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
        self._clouds = clouds
        self._ground = ground
        self.is_compensated = clouds != "raw"
        self._clouds_of = lru_cache(1)(self._open_clouds)  # we read several arrays of the same clouds
        self._file = self.folder / "sequence.json"
        with file_errors(self._file, _HINT):
            content = read_json(self._file)
            self.lidars = _chosen(content["metadata"]["sensors"]["lidars"], lidars)
            by_time: dict[int, dict[str, Any]] = {frame["timestamp_ns"]: frame for frame in content["frames"]}
            self.timestamps = sorted(by_time)
            self._check_count(self._file)
            self._frames = [by_time[time] for time in self.timestamps]
            self._mounts = self._poses_of(
                [content["metadata"]["vehicle_to_lidar_extrinsics"][name] for name in self.lidars], "extrinsics"
            )
            self.poses = self._poses = self._poses_of([frame["ego_pose"] for frame in self._frames], "ego poses")
            self._has_boxes = any(frame.get("boxes") for frame in self._frames)

    def sweep(self, index: int) -> Sweep:
        """Read sweep `index`. If a cloud lacks class names, the mask is None; if a cloud lacks times, the times are."""
        names = self._column(index, "semantic_labels", np.str_) if self._ground else None
        times = self._column(index, "time_offset_ns", np.int64)
        is_ground = None if names is None else np.isin(names, GROUND)
        seconds = None if times is None else times * 1e-9
        return Sweep(self._points(index), is_ground, self._poses[index].copy(), self.timestamps[index], seconds)

    def radial_velocity(self, index: int) -> np.ndarray:
        """Read the (N,) float32 radial velocities of sweep `index`, m/s, positive = moving away from the LiDAR.

        In compensated clouds the motion of the vehicle is removed, so static points have about 0. Third parties
        measured this sign. A comment in the SDK states the opposite.
        """
        return np.concatenate([cloud.column("velocity", np.float32) for cloud in self._clouds_of(index)])

    def _points(self, index: int) -> np.ndarray:
        pairs = zip(self._clouds_of(index), self._mounts)
        return np.concatenate([transform_points(cloud.points, mount) for cloud, mount in pairs]).astype(np.float32)

    def _column(self, index: int, key: str, dtype: Any) -> np.ndarray | None:
        """Read one value per point of a sweep, (N,); None if one of its clouds has no such array."""
        clouds = self._clouds_of(index)
        return np.concatenate([c.column(key, dtype) for c in clouds]) if all(key in c.keys for c in clouds) else None

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

    def _boxes(self, index: int) -> Boxes | None:
        if not self._has_boxes:
            return None
        where = f"{self._file}, frame {self.timestamps[index]}"
        with file_errors(where, _HINT):
            boxes = self._frames[index].get("boxes") or []
            boxes = [box for box in boxes if CATEGORY_NAME.get(box["class"]) != "NONE"]
            frames = [box.get("reference_frame", "VEHICLE") for box in boxes]
            if set(frames) - {"VEHICLE"}:
                raise CFlowError(f"boxes must be in VEHICLE, got {shortened(sorted(set(frames)))}")
            return Boxes(
                [str(box["id"]) for box in boxes],
                category_indices([box["class"] for box in boxes], CATEGORY_NAME),
                [[box["dimensions"][axis] for axis in "xyz"] for box in boxes],
                self._poses_of([box["pose"] for box in boxes], f"frame {self.timestamps[index]}, boxes"),
            )

    def _poses_of(self, nodes: Sequence[Any], what: str) -> np.ndarray:
        """Build (K, 4, 4) float64 poses from objects with translation {x, y, z} and rotation {w, x, y, z}."""
        return poses_from_json(nodes, "translation", "rotation", f"{self._file}: {what}: number")


class Cloud:
    """One .npz file in memory; a missing or damaged file or array is a `CFlowError`.

    Attributes: `keys`, the names of its arrays, and `points`, (N, 3) float32 metres in the frame of the LiDAR; NaN =
    no return.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        with file_errors(file, _HINT):
            self._arrays = np.load(io.BytesIO(read_bytes(file)), allow_pickle=False)
            self.keys: list[str] = list(self._arrays.files)
        with file_errors(f"{file}: xyz", _HINT):
            points = self._arrays["xyz"]
            check_array(points, "xyz", (None, 3), "f", "(N, 3) floats, metres")
        self.points = np.where(missing_returns(points)[:, None], np.nan, points).astype(np.float32)

    def column(self, key: str, dtype: Any) -> np.ndarray:
        """Return one value per point, (N,) of `dtype`; np.str_ gives an object array of strings."""
        with file_errors(f"{self.file}: {key}", _HINT):
            values = self._texts(key) if dtype is np.str_ else self._arrays[key].astype(dtype, casting="same_kind")
            return values.reshape(len(self.points))

    def _texts(self, key: str) -> np.ndarray:
        """Return an array of strings. Pickled strings are decoded without executing anything."""
        with self._arrays.zip.open(f"{key}.npy") as member:
            npy.read_magic(member)
            _, _, dtype = npy.read_array_header_1_0(member)
            array: np.ndarray = load_array(member) if dtype.hasobject else self._arrays[key]
        if not all(isinstance(text, str) for text in array.ravel().tolist()):
            raise ValueError("it must hold strings")
        return array


def _chosen(known: Sequence[str], lidars: Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of the LiDARs that are merged; None = all that are known."""
    chosen = tuple(known if lidars is None else lidars)
    if not chosen or not set(chosen) <= set(known):
        raise CFlowError(f"it has the LiDARs {shortened(known)}, you asked for {shortened(list(chosen))}")
    return chosen
