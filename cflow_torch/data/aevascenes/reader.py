"""Reader of AevaScenes: FMCW LiDARs, one `sequence.json` and one npz per LiDAR and frame."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence, Tuple

import numpy as np

from cflow_torch.data.aevascenes.npz_strings import npz_contents, read_npz_member
from cflow_torch.data.boxes import Boxes, flow_from_boxes
from cflow_torch.data.categories import CATEGORY_INDEX
from cflow_torch.data.folders import find_folders
from cflow_torch.data.json_file import is_number, is_whole, read_json, shown
from cflow_torch.data.log import FlowLabels
from cflow_torch.data.names import inside
from cflow_torch.data.paths import Place, as_path
from cflow_torch.types import CFlowError, Sweep
from cflow_torch.windows.ego_motion import relative_transform

SEARCH_DEPTH = 3  # <root>/<data set>/<split>/<sequence>
QUATERNION_TOLERANCE = 1e-3  # a quaternion is a rotation only if its length is 1

CATEGORY_NAME: Dict[str, str] = {
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
"""Class of AevaScenes -> Argoverse 2 name. The data set publishes no such map: this one is cflow_torch's."""

GROUND = ("road", "lane_boundary", "road_marking", "reflective_marker", "sidewalk", "other_ground")
"""Classes that are ground."""
CATEGORY_NAME.update(dict.fromkeys(GROUND, "NONE"))

_PATHS = {"compensated": ("point_cloud_compensated_path", "point_cloud_path"), "raw": ("point_cloud_raw_path",)}


def find_aevascenes_sequences(root: Place) -> List[Path]:
    """Folders of all sequences under a folder, sorted.

    Args:
        root: a sequence (holds `sequence.json`), a split, or a folder at most three levels above the sequences.

    Raises:
        CFlowError: `root` is no folder.
    """
    what = "a sequence (it holds sequence.json), or a folder of sequences"
    return find_folders(as_path(root), lambda folder: (folder / "sequence.json").is_file(), SEARCH_DEPTH, what)


class AevaScenesLog:
    """One sequence, of the layout of version 0.1, 0.2 or 2; implements the `Log` protocol.

    Args:
        folder: sequence folder with `sequence.json`.
        clouds: "compensated", or "raw" (version 2 only; what is raw in it is not documented).
        lidars: names of the LiDARs to merge; None = all of the sequence, in its order.
        ground: make ground masks from the stored class names, where every cloud of a sweep has them.

    Attributes:
        log_id: name of the folder.
        timestamps: frame times in nanoseconds, ascending.
        lidars: names of the LiDARs that are merged.

    Convention:
        - Points are float32 in the vehicle frame (x forward, y left, z up, origin at the rear axle), LiDAR by LiDAR,
          moved there in float64 by `vehicle_to_lidar_extrinsics`, which despite its name is `T_vehicle_lidar`.
        - `T_world_ego` is `ego_pose`, world = vehicle at the first frame.
        - Truth comes from box tracks. Boxes of classes that are background (poles for the greater part) are not used.
        - Class names are stored as pickled strings: they are decoded by a reader that makes nothing but strings.
          `semantic_labels_idx` is not used: its table is not published.

    Raises:
        CFlowError: no such folder or setting; `sequence.json` is missing, no JSON, or lacks something; fewer than two
            frames.
    """

    def __init__(
        self,
        folder: Place,
        clouds: str = "compensated",
        lidars: Optional[Sequence[str]] = None,
        ground: bool = True,
    ) -> None:
        self.folder = as_path(folder)
        self.log_id = self.folder.resolve().name
        if clouds not in _PATHS:
            raise CFlowError(f"clouds is one of {', '.join(_PATHS)}; got {clouds!r}")
        self._clouds, self._ground = clouds, ground
        self._last: Tuple[int, List[Tuple[Path, Any]]] = (-1, [])
        self._file = self.folder / "sequence.json"
        metadata, frames = self._read_sequence()
        extrinsics = self._get(metadata, "metadata", "vehicle_to_lidar_extrinsics")
        known = self._get(metadata, "metadata", "sensors", "lidars")
        if not isinstance(known, list) or not all(isinstance(name, str) for name in known):
            raise CFlowError(f"{self._file}: sensors.lidars must be a list of names, got {shown(known)}")
        self.lidars: Sequence[str] = tuple(known if lidars is None else lidars)
        strangers = sorted(set(self.lidars) - set(known))
        if strangers or not self.lidars:
            raise CFlowError(f"{self._file} has the LiDARs {shown(known)}; got {shown(list(self.lidars))}")
        self._T_ego_lidar = {
            name: self._pose(self._get(extrinsics, "vehicle_to_lidar_extrinsics", name), f"extrinsic of {name}")
            for name in self.lidars
        }
        times = [self._get(frame, f"frame number {i}", "timestamp_ns") for i, frame in enumerate(frames)]
        if not all(map(is_whole, times)):
            raise CFlowError(f"{self._file}: timestamp_ns must be integers of 64 bits, got {shown(times)}")
        by_time = dict(zip(times, frames))
        if len(by_time) < 2 or len(by_time) < len(frames):
            raise CFlowError(
                f"{self._file} has {len(frames)} frames with {len(by_time)} different times; two or more are needed"
            )
        self.timestamps: Sequence[int] = sorted(by_time)
        self._frames = [by_time[time] for time in self.timestamps]
        self._poses = [
            self._pose(self._get(frame, f"frame {time}", "ego_pose"), f"ego_pose of frame {time}")
            for time, frame in zip(self.timestamps, self._frames)
        ]
        self._has_boxes = any(frame.get("boxes") for frame in self._frames)

    def __len__(self) -> int:
        return len(self.timestamps)

    def sweep(self, index: int) -> Sweep:
        """Sweep number `index`; `is_ground` is None where a cloud of it has no class names.

        Raises:
            CFlowError: no such sweep, or a cloud is missing or cannot be read.
        """
        clouds = self._clouds_of(index)
        is_ground = None
        if self._ground:
            names = [read_npz_member(file, "semantic_labels", True, contents) for file, contents in clouds]
            if all(name is not None for name in names):
                is_ground = np.isin(np.concatenate([np.asarray(name).reshape(-1) for name in names]), GROUND)
        points = self._points(index)
        if is_ground is not None and is_ground.shape != (len(points),):
            raise CFlowError(
                f"{clouds[0][0]} and its neighbours: {len(points)} points but {len(is_ground)} class names"
            )
        return Sweep(points, is_ground, self._poses[index].copy(), self.timestamps[index])

    def radial_velocity(self, index: int) -> np.ndarray:
        """(N,) float32 m/s along the ray of each point of sweep `index`, positive = receding from its LiDAR.

        In compensated clouds the motion of the vehicle is taken out: what stands has about 0. The sign is measured by
        third parties and contradicts a comment of the SDK.

        Raises:
            CFlowError: no such sweep, or a cloud is missing or cannot be read.
        """
        return np.concatenate([self._array(*cloud, "velocity").reshape(-1) for cloud in self._clouds_of(index)])

    def labels(self, index: int) -> Optional[FlowLabels]:
        """Truth of the pair (index, index + 1) from box tracks; None for the last sweep and sequences without boxes.

        Raises:
            CFlowError: no such sweep, or a cloud or box that cannot be read.
        """
        points = self._points(index)
        if index == len(self) - 1 or not self._has_boxes:
            return None
        T_ego1_ego0 = relative_transform(self._poses[index + 1], self._poses[index])
        return flow_from_boxes(points, self._boxes(index), self._boxes(index + 1), T_ego1_ego0)

    def _points(self, index: int) -> np.ndarray:
        """(N, 3) float32, vehicle frame."""
        clouds = []
        for name, (file, contents) in zip(self.lidars, self._clouds_of(index)):
            xyz = self._array(file, contents, "xyz")
            if xyz.ndim != 2 or xyz.shape[1] != 3:
                raise CFlowError(f"{file}: xyz must have shape (N, 3), got {xyz.shape}")
            T = self._T_ego_lidar[name]
            clouds.append(xyz.astype(np.float64) @ T[:3, :3].T + T[:3, 3])
        return np.concatenate(clouds).astype(np.float32)

    def _array(self, file: Path, contents: Any, key: str) -> np.ndarray:
        array = read_npz_member(file, key, contents=contents)
        if array is None:
            raise CFlowError(f"{file} has no array {key}; it has {zipfile.ZipFile(contents).namelist()[:20]}")
        if not np.issubdtype(array.dtype, np.floating):
            raise CFlowError(f"{file}: {key} must be floating point, got {array.dtype}")
        return array.astype(np.float32, copy=False)

    def _clouds_of(self, index: int) -> List[Tuple[Path, Any]]:
        """The npz of each LiDAR and what to read it from; those of the last sweep are kept, as several arrays of each
        are read one after the other."""
        if index != self._last[0]:
            self._last = index, [(file, npz_contents(file)) for file in self._files(index)]
        return self._last[1]

    def _files(self, index: int) -> List[Path]:
        """The npz of each LiDAR."""
        if not 0 <= index < len(self):
            raise CFlowError(f"sequence {self.log_id} has sweeps 0 ... {len(self) - 1}, asked for {index}")
        where, files = f"frame {self.timestamps[index]}", []
        for name in self.lidars:
            entry = self._get(self._frames[index], where, "point_cloud", name)
            keys = [key for key in _PATHS[self._clouds] if isinstance(entry, dict) and key in entry]
            if not keys:
                raise CFlowError(
                    f"{self._file}, {where}, {name}: no {self._clouds} cloud, only {shown(entry)}; raw clouds come "
                    f"with version 2 of the data set"
                )
            files.append(inside(self.folder, entry[keys[0]], f"{self._file}, {where}, {name}: the path"))
        return files

    def _boxes(self, index: int) -> Boxes:
        where = f"frame {self.timestamps[index]}"
        tracks, categories, sizes, poses = [], [], [], []
        listed = self._frames[index].get("boxes") or []
        if not isinstance(listed, list):
            raise CFlowError(f"{self._file}, {where}: boxes must be a list, got {shown(listed)}")
        for box in listed:
            kind = self._get(box, where, "class")
            if not isinstance(kind, str) or kind not in CATEGORY_NAME:
                raise CFlowError(
                    f"{self._file}, {where}: unknown class {shown(kind)}; known are {', '.join(CATEGORY_NAME)}"
                )
            if CATEGORY_NAME[kind] == "NONE":
                continue
            if box.get("reference_frame", "VEHICLE") != "VEHICLE":
                raise CFlowError(f"{self._file}, {where}: boxes are in VEHICLE, got {shown(box['reference_frame'])}")
            tracks.append(self._track(box, where))
            categories.append(CATEGORY_INDEX[CATEGORY_NAME[kind]])
            sizes.append(self._numbers(self._get(box, where, "dimensions"), "xyz", where))
            poses.append(self._pose(self._get(box, where, "pose"), f"{where}, box {tracks[-1]}"))
        try:
            return Boxes(
                tracks,
                np.array(categories, dtype=np.uint8),
                np.array(sizes, dtype=np.float64).reshape(-1, 3),
                np.array(poses, dtype=np.float64).reshape(-1, 4, 4),
            )
        except CFlowError as error:
            raise CFlowError(f"{self._file}, {where}: {error}") from error

    def _read_sequence(self) -> Tuple[Dict[str, Any], List[Dict[str, Any]]]:
        try:
            content = read_json(self._file)
        except FileNotFoundError:
            raise CFlowError(f"{self.folder} is no AevaScenes sequence: it holds no sequence.json") from None
        except OSError as error:
            raise CFlowError(f"cannot read {self._file} ({error}); copy it again") from error
        metadata, frames = (self._get(content, "the file", key) for key in ("metadata", "frames"))
        if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
            raise CFlowError(f"{self._file}: frames must be a list of objects; is this a sequence of AevaScenes?")
        return metadata, frames

    def _get(self, node: Any, where: str, *keys: str) -> Any:
        """Value below an object of the file, key by key."""
        for key in keys:
            if not isinstance(node, dict) or key not in node:
                has = shown(sorted(node)) if isinstance(node, dict) else type(node).__name__
                raise CFlowError(f"{self._file}: {where} has no {key!r} (it has {has}); is this AevaScenes, complete?")
            node = node[key]
        return node

    def _track(self, box: Any, where: str) -> str:
        name = self._get(box, where, "id")
        if type(name) not in (str, int):
            raise CFlowError(f"{self._file}, {where}: the id of a box is text or a number, got {shown(name)}")
        return str(name)

    def _numbers(self, node: Any, keys: str, where: str) -> List[float]:
        values = [self._get(node, where, key) for key in keys]
        if not all(map(is_number, values)):
            raise CFlowError(f"{self._file}: {where}: {', '.join(keys)} must be finite numbers, got {shown(values)}")
        return values

    def _pose(self, node: Any, where: str) -> np.ndarray:
        """(4, 4) float64 from translation {x, y, z} and rotation {w, x, y, z}."""
        w, x, y, z = q = np.array(self._numbers(self._get(node, where, "rotation"), "wxyz", where), dtype=np.float64)
        if not abs(np.linalg.norm(q) - 1) <= QUATERNION_TOLERANCE:
            raise CFlowError(f"{self._file}: {where}: a rotation is a quaternion of length 1, got {q.tolist()}")
        w, x, y, z = q / np.linalg.norm(q)
        pose = np.eye(4)
        pose[:3, :3] = (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
        pose[:3, 3] = self._numbers(self._get(node, where, "translation"), "xyz", where)
        return pose
