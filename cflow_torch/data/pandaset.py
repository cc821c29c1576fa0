"""Reader of PandaSet: pickled pandas data frames, read without pandas and without executing what a pickle names."""

from __future__ import annotations

import io
from functools import cached_property
from pathlib import Path
from typing import Sequence

import numpy as np

from cflow_torch.data.boxes import Boxes, category_indices, flow_from_boxes
from cflow_torch.data.camera import Camera, intrinsic_matrix
from cflow_torch.data.categories import CATEGORY_INDEX
from cflow_torch.data.file_errors import check_columns, file_errors
from cflow_torch.data.folders import visible
from cflow_torch.data.json_file import read_json
from cflow_torch.data.log import FlowLabels, Log
from cflow_torch.data.paths import PathLike, as_path, exist, read_bytes, remote_errors
from cflow_torch.data.pickles import load_columns
from cflow_torch.transforms import poses_from_json, transform_points, upright_poses
from cflow_torch.types import CFlowError, Sweep

_IMAGE_SIZE = (1920, 1080)  # width, height of all cameras
_LIDARS = (0, 1)  # Pandar64, which rotates, and PandarGT, which looks forward
_EVERY_LIDAR = -1  # sensor_id of a cuboid for both LiDARs; an object may instead have one cuboid for each
_POSITION, _SIZE = ("position.x", "position.y", "position.z"), ("dimensions.y", "dimensions.x", "dimensions.z")

_LABELS = {
    "ANIMAL": ("Animals - Bird", "Animals - Other"),
    "BICYCLE": ("Bicycle",),
    "BUS": ("Bus", "Trolley"),
    "CONSTRUCTION_CONE": ("Cones", "Pylons"),
    "LARGE_VEHICLE": ("Emergency Vehicle", "Other Vehicle - Construction Vehicle", "Other Vehicle - Uncommon"),
    "MOTORCYCLE": ("Motorcycle",),
    "NONE": ("Road Barriers", "Rolling Containers", "Temporary Construction Barriers"),
    "PEDESTRIAN": ("Pedestrian", "Pedestrian with Object"),
    "RAILED_VEHICLE": ("Train", "Tram / Subway"),
    "REGULAR_VEHICLE": ("Car", "Pickup Truck"),
    "SIGN": ("Construction Signs", "Signs"),
    "TRUCK": ("Medium-sized Truck", "Semi-truck"),
    "VEHICULAR_TRAILER": ("Towed Object",),
    "WHEELED_DEVICE": ("Motorized Scooter", "Other Vehicle - Pedicab", "Personal Mobility Device"),
}
CATEGORY_NAME: dict[str, str] = {label: name for name, labels in _LABELS.items() for label in labels}
"""Label of a cuboid or class of a point -> Argoverse 2 name. This map is ours, because the data set publishes none."""

_GROUND = ("Driveway", "Ground", "Lane Line Marking", "Other Road Marking", "Road", "Sidewalk", "Stop Line Marking")
_WITHOUT_FLOW = ("Exhaust", "Reflection", "Smoke", "Spray or rain")


class PandaSetLog(Log):
    """One sequence.

    Args:
        folder: sequence folder with `lidar/00.pkl.gz` (or 00.pkl) ..., `lidar/poses.json` and `lidar/timestamps.json`.

    Convention:
        - Points are stored in the world frame, compensated for ego motion. We return them in the frame of the stored
          LiDAR pose (x right, y forward, z up), points of both LiDARs in the order of the file.
        - Ground masks come from the classes of points in `annotations/semseg`; None for a sequence without them.
        - A point moves with the tracked cuboid in `annotations/cuboids` for its LiDAR or for both. If points have
          classes, these are the categories, and a point is valid only if its class and the cuboids agree on whether
          it is part of an object. Smoke, exhaust, spray and reflections are not valid.
    """

    is_compensated: bool = True

    def __init__(self, folder: PathLike) -> None:
        self.folder = as_path(folder)
        self.log_id = self.folder.resolve().name
        lidar = self.folder / "lidar"
        names = {path.name for path in visible(lidar)}
        end = next((end for end in (".pkl.gz", ".pkl") if any(name.endswith(end) for name in names)), ".pkl.gz")
        seconds, self._poses = _times_and_poses(lidar)
        self.timestamps = [round(each * 1e9) for each in seconds]
        self._check_count(self.folder)
        files = [f"{number:02d}{end}" for number in range(len(self._poses))]  # one may be missing
        self._files = [lidar / name for name in files]
        found = {name for name in names if name.endswith(end)}
        if len(self._poses) != len(self.timestamps) or not found or not found <= set(files):
            counts = f"{len(found)} sweeps, {len(self._poses)} poses and {len(self.timestamps)} time stamps"
            raise CFlowError(f"{lidar} has {counts}; copy it again")

    def sweep(self, index: int) -> Sweep:
        time = self._timestamp(index)
        points, shots, _ = self._cloud(index)
        classes = self._classes(index, len(points))
        is_ground = None if classes is None else np.isin(classes[0], _GROUND)[classes[1]]
        return Sweep(points, is_ground, self._poses[index].copy(), time, shots - time * 1e-9)

    def _labels(self, index: int) -> FlowLabels | None:
        files = [self.folder / "annotations" / "cuboids" / self._files[k].name for k in (index, index + 1)]
        if not exist(*files):
            return None
        points, _, lidars = self._cloud(index)
        labels = FlowLabels(
            flow=np.zeros((len(points), 3), np.float32),
            category=np.zeros(len(points), np.uint8),
            is_valid=np.zeros(len(points), bool),
        )
        names = ("uuid", "label", "yaw", "cuboids.sensor_id", *_POSITION, *_SIZE)
        cuboids = [_columns(file, names) for file in files]
        T_ego1_ego0 = np.linalg.inv(self._poses[index + 1]) @ self._poses[index]
        for lidar in _LIDARS:
            rows = np.flatnonzero(lidars == lidar)
            boxes0, boxes1 = (self._boxes(cuboids[k], files[k], index + k, lidar) for k in (0, 1))
            of_lidar = flow_from_boxes(points[rows], boxes0, boxes1, T_ego1_ego0)
            labels.flow[rows] = of_lidar.flow
            labels.category[rows] = of_lidar.category
            labels.is_valid[rows] = of_lidar.is_valid
        return self._with_classes(index, labels)

    def _with_classes(self, index: int, labels: FlowLabels) -> FlowLabels:
        """Take the categories from the classes of points, if there are any; see the class for which are valid."""
        classes = self._classes(index, len(labels.flow))
        if classes is None:
            return labels
        names, class_of_point = classes
        index_of_class = np.array([CATEGORY_INDEX[CATEGORY_NAME.get(name, "NONE")] for name in names], np.uint8)
        category = index_of_class[class_of_point]
        agrees = (labels.category > 0) == (category > 0)
        is_valid = labels.is_valid & agrees & ~np.isin(names, _WITHOUT_FLOW)[class_of_point]
        return FlowLabels(labels.flow, category, is_valid)

    def columns(self, index: int) -> dict[str, np.ndarray]:
        """Read i (intensity), t (unix time in seconds) and d (index of the LiDAR) of the points of sweep `index`."""
        self._timestamp(index)
        columns = _columns(self._files[index])
        return {name: columns[name] for name in ("i", "t", "d") if name in columns}

    def cameras(self, index: int) -> list[Camera]:
        """Return all cameras of the folder `camera`, which have their own poses."""
        time = self._timestamp(index) * 1e-9
        cameras = []
        for name, (matrix, poses, times) in self._camera_poses.items():
            image = self._files[index].name.partition(".")[0]
            T_camera_ego = np.linalg.inv(poses[index]) @ self._poses[index]
            cameras.append(Camera(name, image, _IMAGE_SIZE, matrix, T_camera_ego, times[index] - time))
        return cameras

    @cached_property
    def _camera_poses(self) -> dict[str, tuple[np.ndarray, np.ndarray, list[float]]]:
        """Camera -> intrinsic matrix, (K, 4, 4) `T_world_camera`, and K unix times in seconds; {} without cameras."""
        folder = self.folder / "camera"
        with remote_errors(folder):
            files = sorted(folder.glob("*/intrinsics.json"))
        cameras = {}
        for file in files:
            with file_errors(file):
                numbers = read_json(file)
                matrix = intrinsic_matrix(*(float(numbers[name]) for name in ("fx", "fy", "cx", "cy")))
            times, poses = _times_and_poses(file.parent)
            if not len(poses) == len(times) == len(self._files):
                raise CFlowError(
                    f"{file.parent} has {len(poses)} poses and {len(times)} times of images for {len(self._files)} "
                    "sweeps; copy it again"
                )
            cameras[file.parent.name] = (matrix, poses, times)
        return cameras

    def _cloud(self, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Read (N, 3) float32 points in the frame of the pose, (N,) float64 unix times in seconds, (N,) LiDAR index."""
        names = ("x", "y", "z", "t", "d")
        columns = _columns(self._files[index], names)
        with file_errors(self._files[index]):
            table = np.stack([columns[name] for name in names]).astype(np.float64)
        points = transform_points(table[:3].T, np.linalg.inv(self._poses[index]))
        return points.astype(np.float32), table[3], table[4]

    def _classes(self, index: int, num_points: int) -> tuple[list[str], np.ndarray] | None:
        """Read the names of classes, and the index of each point's class, (N,); None if the sequence has no classes."""
        folder = self.folder / "annotations" / "semseg"
        file, table = folder / self._files[index].name, folder / "classes.json"
        if not exist(file, table):
            return None
        classes = _columns(file, ("class",))["class"]
        if classes.shape != (num_points,):
            raise CFlowError(f"{file} has {len(classes)} classes for {num_points} points; copy the sequence again")
        numbers, class_of_point = np.unique(classes, return_inverse=True)
        with file_errors(table):
            names = read_json(table)
            return [str(names.get(str(int(number)), "")) for number in numbers.tolist()], class_of_point

    def _boxes(self, cuboids: dict[str, np.ndarray], file: Path, index: int, lidar: int) -> Boxes:
        """Return the cuboids for the points of a LiDAR, in the frame of sweep `index`. Yaw 0 is along the world's y."""
        with file_errors(file):
            rows = np.flatnonzero(np.isin(cuboids["cuboids.sensor_id"], (_EVERY_LIDAR, lidar)))
            heading_centre = np.stack([cuboids[name][rows] for name in ("yaw", *_POSITION)], axis=1)
            world = upright_poses(heading_centre + (np.pi / 2, 0, 0, 0))
            return Boxes(
                cuboids["uuid"][rows].tolist(),
                category_indices(cuboids["label"][rows].tolist(), CATEGORY_NAME),
                np.stack([cuboids[name][rows] for name in _SIZE], axis=1),
                np.linalg.inv(self._poses[index]) @ world,
            )


def _times_and_poses(folder: Path) -> tuple[list[float], np.ndarray]:
    """Read the K unix times in seconds, and the poses, (K, 4, 4) float64, of a LiDAR or a camera."""
    times, poses = folder / "timestamps.json", folder / "poses.json"
    with file_errors(times):
        seconds = [float(each) for each in read_json(times)]
    with file_errors(poses):
        return seconds, poses_from_json(read_json(poses), "position", "heading", f"{poses}: pose")


def _columns(file: Path, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
    """Read columns of a pickled data frame; None = all."""
    with file_errors(file):
        columns = load_columns(io.BytesIO(read_bytes(file)))
        names = list(columns) if names is None else names
        check_columns(file, list(columns), names)
        return {name: columns[name] for name in names}
