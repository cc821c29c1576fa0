"""Reader of the Waymo Open Dataset, version 2 (parquet), with pyarrow alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence, Tuple

import numpy as np
import pyarrow as pa

from cflow_torch.data.arrow_file import shortened, texts
from cflow_torch.data.boxes import Boxes, flow_from_boxes
from cflow_torch.data.categories import CATEGORY_INDEX
from cflow_torch.data.log import FlowLabels
from cflow_torch.data.paths import Place, as_path, remote_errors
from cflow_torch.data.waymo.parquet import (
    BOX,
    CALIBRATION,
    LASER,
    LIDAR,
    PIXEL_POSE,
    SEGMENT,
    TIME,
    TRACK,
    VEHICLE_POSE,
    cell_of,
    keys_of,
    matrix_of,
    numbers_of,
    read_columns,
    read_images,
)
from cflow_torch.data.waymo.range_image import LASERS, NO_LABEL_ZONE, TOP, LaserCalibration, range_image_points
from cflow_torch.types import CFlowError, Sweep
from cflow_torch.windows.ego_motion import relative_transform, rigid_transform

SEARCH_DEPTH = 3  # <root>/<data set>/<split>/lidar
BOX_CATEGORY = {
    0: 0,  # unknown
    1: CATEGORY_INDEX["REGULAR_VEHICLE"],  # trucks, buses and motorcycles too
    2: CATEGORY_INDEX["PEDESTRIAN"],
    3: CATEGORY_INDEX["SIGN"],
    4: CATEGORY_INDEX["BICYCLIST"],
}
"""Waymo's box type -> Argoverse 2 index."""

_KEPT_FRAMES = 2  # the labels of a pair are asked for after both of its sweeps
Row = Tuple[int, int]  # frame time in microseconds, laser


def find_waymo_segments(root: Place) -> List[Path]:
    """The LiDAR files `<split>/lidar/<segment>.parquet` of all segments under a folder, sorted.

    Args:
        root: such a file, a folder `lidar`, a split (holds `lidar`), or a folder at most three levels above `lidar`.

    Raises:
        CFlowError: `root` does not exist.
    """
    root = as_path(root)
    if root.is_file():
        return [root]
    if not root.is_dir():
        raise CFlowError(f"{root} is neither a file nor a folder; give <split>/lidar/<segment>.parquet or a split")
    found: List[Path] = []
    level = [root]
    for _ in range(SEARCH_DEPTH + 1):
        found += [file for folder in level if folder.name == "lidar" for file in folder.glob("*.parquet")]
        level = [
            child
            for folder in level
            if folder.name != "lidar"
            for child in ([folder / "lidar"] if (folder / "lidar").is_dir() else folder.iterdir())
            if child.is_dir() and not child.name.startswith(".")
        ]
    return sorted(found)


@dataclass(frozen=True)
class _Frame:
    """(N, 3) float32 points in the vehicle frame, (N,) bool whether each lies in a no-label zone."""

    points: np.ndarray
    in_no_label_zone: np.ndarray


class WaymoLog:
    """One segment; implements the `Log` protocol.

    Args:
        file: `<split>/lidar/<segment>.parquet`; the other components lie beside that folder, under the same name.
        lasers: which LiDARs, names in `waymo_range_image.LASERS`. Those that the segment does not have are left out.
        both_returns: also the second return of each pixel, after all first returns of its laser.

    Attributes:
        log_id: name of the segment.
        timestamps: start of the TOP scan of each frame, nanoseconds (stored in microseconds), ascending.

    Convention:
        - Points are float32 in the vehicle frame of their frame (x forward, y left, z up, origin at the rear axle),
          computed in float64: laser by laser, in each row by row of the range image.
        - `T_world_ego` is `world_from_vehicle`, about the middle of the TOP scan.
        - The data set has no ground masks: `is_ground` is None.
        - Truth comes from box tracks. Points in a no-label zone are invalid; boxes of unknown type are background.

    Cost: opening reads keys, calibration and vehicle poses. A sweep decodes the row groups that hold its rows; the
        released files are not sorted by time, so that can be the whole file (seconds).

    Raises:
        CFlowError: a file is missing, cannot be read, belongs to another segment or lacks columns; fewer than two
            frames; a frame without pose.
    """

    def __init__(self, file: Place, lasers: Sequence[str] = tuple(LASERS), both_returns: bool = False) -> None:
        self.file = as_path(file)
        unknown = sorted(set(lasers) - set(LASERS))
        if unknown or not lasers:
            raise CFlowError(f"lasers are some of {', '.join(LASERS)}; got {list(lasers)}")
        if self.file.parent.name != "lidar":
            raise CFlowError(f"{self.file} does not lie in a folder lidar; give <split>/lidar/<segment>.parquet")
        self.log_id = self.file.stem
        self._returns = (1, 2) if both_returns else (1,)
        self._rows = self._row_numbers("lidar")
        times = sorted({time for time, _ in self._rows})
        self.timestamps: Sequence[int] = [time * 1000 for time in times]
        if len(times) < 2:
            raise CFlowError(f"{self.file} has {len(times)} frames; scene flow needs two or more")
        present = {laser for _, laser in self._rows}
        self._lasers = [LASERS[name] for name in LASERS if name in lasers and LASERS[name] in present]
        if not self._lasers:
            raise CFlowError(f"{self.file} has lasers {sorted(present)}, none of {list(lasers)} ({LASERS})")
        self._calibration = self._read_calibration()
        self._poses = self._read_poses(times)
        self._pixel_pose_rows = self._row_numbers("lidar_pose") if TOP in self._lasers else {}
        self._boxes: Optional[Dict[int, Boxes]] = None
        self._recent: Dict[int, _Frame] = {}

    def __len__(self) -> int:
        return len(self.timestamps)

    def sweep(self, index: int) -> Sweep:
        """Sweep number `index`, without ground mask.

        Raises:
            CFlowError: no such sweep, a laser of it is missing, or it cannot be read.
        """
        time = self._time(index)
        return Sweep(self._frame(time).points.copy(), None, self._poses[time].copy(), time * 1000)

    def labels(self, index: int) -> Optional[FlowLabels]:
        """Truth of the pair (index, index + 1) from `lidar_box`; None for the last sweep and segments without boxes.

        Raises:
            CFlowError: no such sweep, or the boxes cannot be read.
        """
        time0 = self._time(index)
        if index == len(self) - 1:
            return None
        if self._boxes is None:
            self._boxes = self._read_boxes()
        if not self._boxes:
            return None
        time1 = self._time(index + 1)
        frame, nobody = self._frame(time0), upright_boxes([])
        labels = flow_from_boxes(
            frame.points,
            self._boxes.get(time0, nobody),
            self._boxes.get(time1, nobody),
            relative_transform(self._poses[time1], self._poses[time0]),
        )
        return FlowLabels(labels.flow, labels.category, labels.is_valid & ~frame.in_no_label_zone)

    def _time(self, index: int) -> int:
        if not 0 <= index < len(self):
            raise CFlowError(f"segment {self.log_id} has sweeps 0 ... {len(self) - 1}, asked for {index}")
        return self.timestamps[index] // 1000

    def _component(self, tag: str) -> Path:
        return self.file.parent.parent / tag / self.file.name

    def _frame(self, time: int) -> _Frame:
        if time not in self._recent:
            while len(self._recent) >= _KEPT_FRAMES:
                del self._recent[next(iter(self._recent))]
            self._recent[time] = self._read_frame(time)
        return self._recent[time]

    def _read_frame(self, time: int) -> _Frame:
        wanted = [(time, laser) for laser in self._lasers]
        images = [self._images("lidar", self._rows, wanted, f"{LIDAR}{number}", 4) for number in self._returns]
        pixel_poses: Dict[Row, Optional[np.ndarray]] = {}
        if TOP in self._lasers:
            pixel_poses = self._images("lidar_pose", self._pixel_pose_rows, [(time, TOP)], PIXEL_POSE, 6)
        points, zone = [np.zeros((0, 3))], [np.zeros(0, dtype=bool)]
        for key in wanted:
            for image in (of_return[key] for of_return in images):
                if image is None:  # a laser, or a second return, without any data
                    continue
                if key[1] == TOP and pixel_poses[key] is None:
                    raise CFlowError(f"{self._component('lidar_pose')}: the pixel poses of frame {time} are empty")
                try:
                    there, pixels = range_image_points(
                        image, self._calibration[key[1]], pixel_poses.get(key), self._poses[time]
                    )
                except CFlowError as error:
                    raise CFlowError(f"{self.file}, frame {time}, laser {key[1]}: {error}") from error
                points.append(there)
                zone.append(image.reshape(-1, image.shape[2])[pixels, NO_LABEL_ZONE] == 1)
        return _Frame(np.concatenate(points).astype(np.float32), np.concatenate(zone))

    def _images(
        self, tag: str, rows: Dict[Row, int], wanted: Sequence[Row], column: str, channels: int
    ) -> Dict[Row, Optional[np.ndarray]]:
        """(H, W, channels) images of the wanted rows, None where the file has none."""
        file = self._component(tag)
        missing = [key for key in wanted if key not in rows]
        if missing:
            raise CFlowError(f"{file} has no row for frame {missing[0][0]}, laser {missing[0][1]}; copy it again")
        images = read_images(file, [rows[key] for key in wanted], column, channels)
        return {key: images[rows[key]] for key in wanted}

    def _row_numbers(self, tag: str) -> Dict[Row, int]:
        """(time, laser) -> number of the row in the file."""
        table = self._keys(tag, (TIME, LASER))
        keys = list(zip(*(keys_of(table, name, self._component(tag)) for name in (TIME, LASER))))
        rows = {key: number for number, key in enumerate(keys)}
        if len(rows) < len(keys):
            raise CFlowError(f"{self._component(tag)} has two rows of the same frame and laser; copy it again")
        return rows

    def _keys(self, tag: str, columns: Sequence[str]) -> pa.Table:
        """Columns of a component, after checking that the file is of this segment."""
        file = self._component(tag)
        table = read_columns(file, (SEGMENT, *columns))
        strangers = sorted(set(texts(table.column(SEGMENT), file)) - {self.log_id})
        if strangers:
            raise CFlowError(
                f"{file} holds segment {shortened(strangers[0])}; a file is named after its segment: rename it, or "
                f"copy it again"
            )
        return table

    def _read_calibration(self) -> Dict[int, LaserCalibration]:
        file = self._component("lidar_calibration")
        names = ("extrinsic.transform", *(f"beam_inclination.{name}" for name in ("values", "min", "max")))
        table = self._keys("lidar_calibration", (LASER, *(CALIBRATION + name for name in names)))
        lasers = keys_of(table, LASER, file)
        missing = [laser for laser in self._lasers if laser not in lasers]
        if missing:
            raise CFlowError(f"{file} has lasers {lasers}; lasers {missing} are missing, copy it again")
        calibration = {}
        for laser in self._lasers:
            row = lasers.index(laser)
            transform, values, low, high = (cell_of(table, CALIBRATION + name, row, file) for name in names)
            where = f"{file}: extrinsic of laser {laser}"
            values, low, high = (None if cell is None or not len(cell) else cell for cell in (values, low, high))
            if values is None and (low is None or high is None):
                raise CFlowError(f"{file}: laser {laser} has neither beam inclinations nor their limits; copy it again")
            calibration[laser] = LaserCalibration(
                rigid_transform(matrix_of(transform, where), where),
                values,
                0.0 if low is None else float(low[0]),
                0.0 if high is None else float(high[0]),
            )
        return calibration

    def _read_poses(self, times: Sequence[int]) -> Dict[int, np.ndarray]:
        """Frame time -> (4, 4) float64 `T_world_ego`."""
        file = self._component("vehicle_pose")
        table = self._keys("vehicle_pose", (TIME, VEHICLE_POSE))
        row_of = {time: row for row, time in enumerate(keys_of(table, TIME, file))}
        missing = [time for time in times if time not in row_of]
        if missing:
            raise CFlowError(f"{file} has no pose for frame {missing[0]} ({len(missing)} missing); copy it again")
        poses = {}
        for time in times:
            where = f"{file}: the pose of frame {time}"
            poses[time] = rigid_transform(matrix_of(cell_of(table, VEHICLE_POSE, row_of[time], file), where), where)
        return poses

    def _read_boxes(self) -> Dict[int, Boxes]:
        """Frame time -> boxes; empty where the segment has no labels (the testing split)."""
        file = self._component("lidar_box")
        with remote_errors(file):
            if not file.exists():
                return {}
        numbers = tuple(f"{BOX}box.{name}" for name in ("size.x", "size.y", "size.z", "heading"))
        centre = tuple(f"{BOX}box.center.{axis}" for axis in "xyz")
        table = self._keys("lidar_box", (TIME, TRACK, f"{BOX}type", *numbers, *centre))
        times, kinds = (keys_of(table, name, file) for name in (TIME, f"{BOX}type"))
        unknown = sorted(set(kinds) - set(BOX_CATEGORY))
        if unknown:
            raise CFlowError(f"{file}: box types are {sorted(BOX_CATEGORY)}, got {shortened(unknown)}")
        values = np.stack([numbers_of(table, name, file) for name in (*numbers, *centre)], axis=1).astype(np.float64)
        rows: Dict[int, List[Any]] = {time: [] for time in times}
        for time, track, kind, value in zip(times, texts(table.column(TRACK), file), kinds, values):
            if BOX_CATEGORY[kind]:
                rows[time].append((track, BOX_CATEGORY[kind], value))
        try:
            return {time: upright_boxes(of_frame) for time, of_frame in rows.items()}
        except CFlowError as error:
            raise CFlowError(f"{file}: {error}") from error


def upright_boxes(rows: Sequence[Tuple[str, int, Sequence[float]]]) -> Boxes:
    """Boxes that turn about z only.

    Args:
        rows: track, Argoverse 2 index, and length, width, height (metres), heading (radians), centre x, y, z (metres).
    """
    values = np.array([value for _, _, value in rows], dtype=np.float64).reshape(-1, 7)
    pose = np.tile(np.eye(4), (len(values), 1, 1))
    cos, sin = np.cos(values[:, 3]), np.sin(values[:, 3])
    pose[:, 0, 0], pose[:, 0, 1], pose[:, 1, 0], pose[:, 1, 1] = cos, -sin, sin, cos
    pose[:, :3, 3] = values[:, 4:]
    category = np.array([category for _, category, _ in rows], dtype=np.uint8)
    return Boxes([track for track, _, _ in rows], category, values[:, :3], pose)
