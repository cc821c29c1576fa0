"""Reader of KITTI: raw drives, sequences (odometry, SemanticKITTI) and tracking."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cflow_torch.data.arrays.cloud_file import read_table
from cflow_torch.data.arrays.folder import read_all
from cflow_torch.data.arrays.poses_text import read_poses, read_times
from cflow_torch.data.arrays.reader import ArraysLog
from cflow_torch.data.arrays.tables import read_numbers
from cflow_torch.data.boxes import flow_from_boxes
from cflow_torch.data.calibration import CAMERA_KEYS, read_calibration, transform
from cflow_torch.data.camera import Camera
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.folders import visible
from cflow_torch.data.kitti import labels as stored_labels
from cflow_torch.data.kitti.drives import KITTIDrive, find_kitti_drives
from cflow_torch.data.kitti.geometry import IMAGE_SIZE, NUM_USED, in_image, png_size, poses_from_oxts
from cflow_torch.data.kitti.labels import FrameBoxes
from cflow_torch.data.log import FlowLabels
from cflow_torch.data.paths import PathLike, exist, read_bytes, remote_errors
from cflow_torch.data.trajectory import Trajectory
from cflow_torch.errors import CFlowError
from cflow_torch.transforms import transform_points
from cflow_torch.types import Sweep

_UNKNOWN_VIEW = np.radians(40.0)  # of the left colour camera, to each side, where its calibration is missing
_ANNOTATED_CAMERA = "02"
_COLOUR_CAMERAS = (_ANNOTATED_CAMERA, "03")


class KITTILog(ArraysLog):
    """One drive.

    Args:
        source: a drive from `find_kitti_drives`, or the folder of one.
        poses: "auto" = those of the layout (see Convention); None = no poses; or a file or array of poses of the LiDAR,
            as in `ArraysLog`.

    Attributes:
        log_id: 2011_09_26_drive_0027_sync in raw drives, 00 in sequences, 0000 in the tracking set.
        timestamps: nanoseconds, from velodyne_points/timestamps.txt or times.txt. Otherwise 0, 1, 2, ...
        poses: (K, 4, 4) float64 `T_world_lidar`; None = unknown.

    Convention:
        - Points are in the frame of the LiDAR: x ahead, y left, z up, 1.73 m above the road. There are no other frames.
        - Raw drives and the tracking set have poses from OXTS (GPS and IMU), moved to the LiDAR by the calibration
          (calib_imu_to_velo.txt in the folder of the drive or of its day; calib/NNNN.txt). Drives that are not
          synchronised (`_extract`) take them by the times in oxts/timestamps.txt. Without calibration or with
          measurements for less than half of the sweeps, we warn, and there are no poses. Other sweeps without one are
          left out, and we say so.
        - KITTI-360 has raw drives in `data_3d_raw`, and poses of the IMU in `data_poses/<drive>/poses.txt` (or of the
          camera in cam0_to_world.txt), moved to the LiDAR by `calibration`. Sweeps without a pose are left out, and we
          say so.
        - Poses of sequences (poses.txt, ../../poses/NN.txt) are of the camera, converted by `Tr` of calib.txt. If they
          drive along x (the LiDAR's axis ahead) and not along z (the camera's), they are the LiDAR's, and we say so.
        - Ground masks come from the classes of points in `labels`. Sweeps without a class of the ground, as in labels
          that tell only static (9) and moving (251), have none.
        - Truth of raw drives and the tracking set comes from tracked boxes (tracklet_labels.xml, label_02). Only the
          image of the left colour camera is annotated: elsewhere, and in regions DontCare, points are not valid.
        - Truth of SemanticKITTI: points of the classes 251 to 259 move, by an unknown flow, so they are not valid, see
          `moving`. All other labelled points are static.
    """

    _numbers_are_rows = True

    def __init__(self, source: KITTIDrive | PathLike, poses: Any = "auto") -> None:
        if not isinstance(source, KITTIDrive):
            drives = find_kitti_drives(source)
            if len(drives) != 1:
                raise CFlowError(f"{source} has {len(drives)} drives of KITTI; pass one of find_kitti_drives")
            source = drives[0]
        self.drive = source
        root, is_sequence = source.root, source.layout == "sequence"
        is_auto = isinstance(poses, str) and poses == "auto"
        with remote_errors(root):
            self._label_files = {file.stem: file for file in visible(root / "labels")} if is_sequence else {}
            if is_sequence:
                calibration = "auto" if is_auto else None
                super().__init__(root, poses, calibration=calibration, suffix=".bin")
            else:
                super().__init__(source.clouds, None if is_auto else poses, times=None, ground=None)
        self.log_id = source.name
        if source.layout == "raw":
            self._read_times()
        trajectory = None
        if is_auto and not is_sequence:
            trajectory = self._poses_of_oxts() if _kitti360(root) is None else self._poses_of_kitti360()
        if trajectory is not None:
            self._take_poses(trajectory)
            self.gaps |= frozenset(self._gaps_in_numbers())

    def frame_number(self, index: int) -> int:
        self._timestamp(index)
        return int(self.files[index].stem)

    def _gaps_in_numbers(self) -> list[int]:
        return [] if self.drive.layout == "raw" else super()._gaps_in_numbers()  # raw drives have times

    def sweep(self, index: int) -> Sweep:
        sweep = super().sweep(index)
        classes = self._classes(index, len(sweep.points)) if sweep.is_ground is None else None
        if classes is None:
            return sweep
        is_ground = np.isin(classes[0], stored_labels.GROUND)
        return Sweep(sweep.points, is_ground if is_ground.any() else None, sweep.pose, sweep.timestamp_ns)

    def columns(self, index: int) -> dict[str, np.ndarray]:
        """Read reflectance and other columns and, in SemanticKITTI, class and instance of the points of a sweep."""
        self._timestamp(index)
        points, stored = read_table(self.files[index], self._bin_columns)
        columns = {"reflectance" if name == "column_3" else name: values for name, values in stored.items()}
        classes = self._classes(index, len(points))
        return columns if classes is None else {**columns, "class": classes[0], "instance": classes[1]}

    def moving(self, index: int) -> np.ndarray | None:
        """Read which points of sweep `index` belong to a class of moving points, (N,) bool; None without labels."""
        classes = self.columns(index).get("class")
        return None if classes is None else np.isin(classes, stored_labels.MOVING)

    def _labels(self, index: int) -> FlowLabels | None:
        boxes = self._boxes
        if self.poses is None or not (self._label_files or boxes):
            return None
        points = np.asarray(super().sweep(index).points, np.float64)
        found = self._classes(index, len(points))
        if found is None and not boxes:
            return None
        T_ego1_ego0 = np.linalg.inv(self.poses[index + 1]) @ self.poses[index]
        if found is not None:
            classes, _ = found
            flow = (transform_points(points, T_ego1_ego0) - points).astype(np.float32)
            is_valid = ~np.isin(classes, (*stored_labels.MOVING, *stored_labels.UNLABELLED))
            return FlowLabels(flow, stored_labels.CATEGORY_OF_CLASS[classes], is_valid)
        pair = [boxes.get(self.frame_number(k), stored_labels.NO_BOXES) for k in (index, index + 1)]
        labels = flow_from_boxes(points, pair[0].boxes, pair[1].boxes, T_ego1_ego0)
        return FlowLabels(labels.flow, labels.category, labels.is_valid & self._is_annotated(points, pair[0]))

    @cached_property
    def _annotated_size(self) -> tuple[int, int]:
        return self._image_size(_ANNOTATED_CAMERA)

    def _is_annotated(self, points: np.ndarray, boxes: FrameBoxes) -> np.ndarray:
        camera = self._camera()
        if camera is not None:
            return in_image(points, camera[1] @ camera[0], self._annotated_size, boxes.ignored)
        return np.abs(np.arctan2(points[:, 1], points[:, 0])) < _UNKNOWN_VIEW  # type: ignore[no-any-return]

    def _classes(self, index: int, rows: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the class and the instance of each point, (N,) each; None = the sweep has no file of labels."""
        file = self._label_files.get(self.files[index].stem)
        return None if file is None else stored_labels.read_classes(file, rows)

    def _read_times(self) -> None:
        """Read the times of a raw drive: a line per frame, YYYY-MM-DD hh:mm:ss and 9 decimals."""
        file = self.drive.root / "velodyne_points" / "timestamps.txt"
        if not exist(file):
            return
        with file_errors(file):
            lines = read_bytes(file).splitlines()
            times = read_times(file).tolist()
            of_frame = dict(zip((frame for frame, line in enumerate(lines) if line.strip()), times))  # some are empty
            self.timestamps = [of_frame[int(file.stem)] for file in self.files]
        self._has_times = True

    def _poses_of_oxts(self) -> Trajectory | None:
        """Return the poses of the LiDAR, by number of the sweep; None, with a warning, if a file is missing.

        Raw drives may lack some measurements: then their sweeps have no pose.
        """
        root, name = self.drive.root, self.drive.clouds.name
        is_raw = self.drive.layout == "raw"
        times = self._times_of_oxts() if is_raw else None
        measured, count = self._measurements(times)
        calibration = self._calibration("imu_to_velo")
        if 2 * len(measured) <= count or calibration is None:
            what = f"there is no oxts/{name}.txt"
            if calibration is None:
                what = "calib_imu_to_velo.txt of its day is missing" if is_raw else f"calib/{name}.txt is missing"
            elif is_raw:
                what = f"oxts/data has {len(measured)} measurements for {count} sweeps"
            where = f"{root}{' or the folder of the day' if is_raw else ''}"
            self._note(f"{what}, so it has no poses. Download it to {where}, or set data.odometry=true")
            return None
        files = list(measured)
        poses = poses_from_oxts(np.concatenate(list(measured.values())), files[0])
        names = ("imu_to_velo.R imu_to_velo.T", "Tr_imu_velo", "Tr_imu_to_velo")
        T_world_lidar = poses @ np.linalg.inv(transform(calibration, root, *names))
        poses = np.linalg.inv(T_world_lidar[0]) @ T_world_lidar
        if times is not None:
            times, rows = np.unique(times[[int(file.stem) for file in files]], return_index=True)
            return Trajectory(poses[rows], times, False, str(files[0].parent))
        labels = [file.name for file in files] if is_raw else [f"{frame:06d}" for frame in range(len(poses))]
        return Trajectory(poses, None, False, str(files[0].parent), labels)

    def _measurements(self, times: np.ndarray | None) -> tuple[dict[Path, np.ndarray], int]:
        """Return the numbers of the measurements in each file that is not cut, (K, 6), and how many files we need.

        `times` are those of drives that are not synchronised.
        """
        is_raw = self.drive.layout == "raw"
        folder = self.drive.root / "oxts" / "data" if is_raw else self.drive.root / "oxts"
        with remote_errors(folder):
            known = [file for file in sorted(visible(folder)) if file.suffix == ".txt" and file.stat().st_size > 0]
        wanted = {file.stem for file in self.files} if is_raw else {self.drive.clouds.name}
        if times is not None:
            wanted = {file.stem for file in known if int(file.stem) < len(times)}
        read = read_all([file for file in known if file.stem in wanted], read_numbers, self._note)
        whole = {file: numbers for file, numbers in read.items() if numbers.shape[1] > NUM_USED}
        return {file: numbers[:, :NUM_USED] for file, numbers in whole.items()}, len(wanted)

    def _times_of_oxts(self) -> np.ndarray | None:
        """Return the nanoseconds of the measurements of a drive that is not synchronised; None = it is.

        Then each measurement has the number of a sweep, and there are as many of both.
        """
        of_sweeps, of_oxts = (self.drive.root / name / "timestamps.txt" for name in ("velodyne_points", "oxts"))
        if not self._has_times or not exist(of_oxts):
            return None
        times = read_times(of_oxts, is_sorted=False)
        return None if len(times) == len(read_times(of_sweeps)) else times

    def _poses_of_kitti360(self) -> Trajectory | None:
        """Return the poses of the LiDAR, by number of the sweep; None, with a warning, if a file is missing."""
        root: Any = _kitti360(self.drive.root)
        folder, calibration = root / "data_poses" / self.drive.name, root / "calibration"
        of_imu, of_camera = folder / "poses.txt", folder / "cam0_to_world.txt"
        mounts = calibration / "calib_cam_to_velo.txt", calibration / "calib_cam_to_pose.txt"
        has_imu = exist(of_imu, mounts[1])
        if not exist(mounts[0]) or not (has_imu or exist(of_camera)):
            self._note(
                f"there is no {of_imu} with {' and '.join(map(str, mounts))}, so it has no poses. Download them, or "
                "set data.odometry=true"
            )
            return None
        T_lidar_camera = transform({"cam_to_velo": read_numbers(mounts[0]).ravel()}, mounts[0], "cam_to_velo")
        trajectory = read_poses(of_imu if has_imu else of_camera)
        if has_imu:
            T_pose_camera = transform(read_calibration(mounts[1]), mounts[1], "image_00")
        else:
            perspective = calibration / "perspective.txt"
            values = read_calibration(perspective) if exist(perspective) else {"R_rect_00": np.eye(3).ravel()}
            T_pose_camera = transform(values, perspective, "R_rect_00")
        return trajectory._replace(poses=trajectory.poses @ T_pose_camera @ np.linalg.inv(T_lidar_camera))

    def _calibration(self, *names: str) -> dict[str, np.ndarray] | None:
        """Read the calibration of the drive: key of a line -> numbers; None if a file is missing.

        Raw drives have a file for each of the `names`, in their folder or that of their day, and its name is put in
        front of the keys: `velo_to_cam.R`. Other layouts have one file for all.
        """
        root, values = self.drive.root, {}
        single = (
            root / "calib.txt" if self.drive.layout == "sequence" else root / "calib" / f"{self.drive.clouds.name}.txt"
        )
        for name in names:
            places = [folder / f"calib_{name}.txt" for folder in (root, root.resolve().parent)]
            file = next(filter(exist, places if self.drive.layout == "raw" else [single]), None)
            if file is None:
                return None
            prefix = f"{name}." if self.drive.layout == "raw" else ""
            values.update({prefix + key: numbers for key, numbers in read_calibration(file).items()})
        return values

    def cameras(self, index: int) -> list[Camera]:
        """Return the colour cameras, image_02 and image_03, whose images are rectified."""
        self._timestamp(index)
        cameras = []
        for name in _COLOUR_CAMERAS:
            camera = self._camera(name)
            if camera is not None:
                T_camera0_lidar, projection = camera
                T_camera_camera0 = np.eye(4)
                T_camera_camera0[:3, 3] = np.linalg.solve(projection[:, :3], projection[:, 3])
                image = self.files[index].stem
                T_camera_lidar = T_camera_camera0 @ T_camera0_lidar
                size = self._image_size(name)
                cameras.append(Camera(f"image_{name}", image, size, projection[:, :3], T_camera_lidar))
        return cameras

    @cached_property
    def T_camera0_lidar(self) -> np.ndarray | None:
        """(4, 4) float64, to the frame of KITTI's labels: camera 0 after rectification. None without calibration."""
        camera = self._camera()
        return None if camera is None else camera[0]

    def _image_size(self, camera: str) -> tuple[int, int]:
        """Return width and height of the rectified images of a camera: of the drive's images, or of the calibration."""
        root = self.drive.root
        folders = {"raw": f"image_{camera}/data", "sequence": f"image_{int(camera)}"}
        folder = root / folders.get(self.drive.layout, f"image_{camera}/{self.drive.clouds.name}")
        with remote_errors(folder):
            image = next(iter(sorted(folder.glob("*.png"))), None) if folder.is_dir() else None
        if image is not None:
            return png_size(image)
        of_cameras = self._calibration("cam_to_cam") or {}
        width, height = of_cameras.get(f"cam_to_cam.S_rect_{camera}", IMAGE_SIZE)
        return int(width), int(height)

    def _camera(self, name: str = _ANNOTATED_CAMERA) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the (4, 4) `T_camera0_lidar` with rectification, and the (3, 4) projection of a camera."""
        values = self._calibration("cam_to_cam", "velo_to_cam")
        if values is None:
            return None
        root = self.drive.root
        rotation = np.eye(4)
        if self.drive.layout != "sequence":
            rotation = transform(values, root, "cam_to_cam.R_rect_00", "R_rect", "R0_rect")
        projection = values.get(f"cam_to_cam.P_rect_{name}", values.get(f"P{int(name)}"))
        if projection is None and name != _ANNOTATED_CAMERA:
            return None
        if projection is None or len(projection) != 12:
            raise CFlowError(
                f"{root}: its calibration has no projection of camera {int(name)} with 12 numbers; copy it again"
            )
        T_camera_lidar = transform(values, root, "velo_to_cam.R velo_to_cam.T", *CAMERA_KEYS)
        return rotation @ T_camera_lidar, projection.reshape(3, 4)

    @cached_property
    def _boxes(self) -> dict[int, FrameBoxes]:
        """Boxes by the number of the frame; {} if the drive has none."""
        root = self.drive.root
        tracklets = root / "tracklet_labels.xml"
        tracks = root / "label_02" / f"{self.drive.clouds.name}.txt"
        if self.drive.layout == "raw" and exist(tracklets):
            return stored_labels.read_tracklets(tracklets)
        if self.drive.layout == "tracking" and exist(tracks):
            camera = self._camera()
            if camera is None:
                raise CFlowError(f"{tracks} needs the calibration calib/{tracks.name}, which is missing; download it")
            return stored_labels.read_tracking_labels(tracks, np.linalg.inv(camera[0]))
        return {}


def _kitti360(drive: Path) -> Path | None:
    """Return the folder of KITTI-360 to which a drive belongs; None = it is another drive."""
    parent = drive.resolve().parent
    return parent.parent if parent.name == "data_3d_raw" else None
