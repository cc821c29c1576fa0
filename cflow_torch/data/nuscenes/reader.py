"""Reader of raw nuScenes: its JSON tables and `.pcd.bin` sweeps, with numpy alone."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, List, Mapping, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from cflow_torch.data.boxes import Boxes, flow_from_boxes, points_in_box
from cflow_torch.data.categories import CATEGORY_INDEX
from cflow_torch.data.json_file import shown
from cflow_torch.data.log import FlowLabels
from cflow_torch.data.names import inside
from cflow_torch.data.nuscenes.categories import NUSCENES_CATEGORIES, OWN_TRAILER
from cflow_torch.data.nuscenes.tables import LidarChain, SceneSource, Tables, find_scenes
from cflow_torch.data.nuscenes.tracks import TrackBoxes, Tracks, poses_at, transforms
from cflow_torch.data.paths import Place, as_path, read_bytes
from cflow_torch.types import CFlowError, Sweep

MAX_UNIT_LAG = 60_000  # microseconds from the sweep of another LiDAR to that of the reference; half a turn and a bit
_TIME_SLICE = 10_000  # microseconds for which one place of a moving box is good enough: 0.15 m off at most at 30 m/s
MAX_SHOT_LAG = 1_000_000  # microseconds from a shot to its sweep; beyond it, the times are not what they should be
_BLOCK = 65536  # points moved at once: their transforms take 8 MB
_ROW = np.dtype("<f4")
_COLUMNS = 5  # x, y, z, intensity, ring


class Footprint(NamedTuple):
    """The ground that the recording vehicle stands on, metres in the ego frame: x from `rear` to `front`, y to both
    sides."""

    rear: float
    front: float
    half_width: float


def find_nuscenes_scenes(root: Place) -> List[SceneSource]:
    """All scenes under a folder.

    Args:
        root: data root (it holds `v1.0-mini` or the like), the folder of one version, or a folder up to two levels
            above data roots.

    Returns:
        Scenes, sorted by folder and name; empty if there are none. Scenes of one version share their tables.

    Raises:
        CFlowError: `root` is no folder, a scene.json cannot be read, or what is there is TruckScenes.
    """
    return find_scenes(root, ("ego_motion_cabin", "ego_motion_chassis"), "nuScenes")


class NuScenesLog:
    """One nuScenes scene; implements the `Log` protocol.

    Args:
        source: the scene, from `find_nuscenes_scenes`.
        sweep_step: 1 = all sweeps (20 Hz); 2 = every second one after each key frame, and every key frame (10 Hz, as
            OpenSceneFlow thins nuScenes).
        lidars: channels to merge; None = every LiDAR of the scene.
        own_vehicle: points above it are removed; None = keep them. Points at the sensor itself mean "no return" and
            are always removed.

    Attributes:
        log_id: name of the scene.
        timestamps: sweep times as the data set has them, in microseconds; `Sweep.timestamp_ns` is in nanoseconds.

    Convention: points are float32 in the ego frame at the sweep's time stamp (x ahead, y left, z up, origin below the
        rear axle on the ground), which nuScenes itself compensated for ego motion; poses are float64 `T_world_ego`.
        Points are read when asked for. `is_ground` is None: nuScenes has no ground mask.

    Raises:
        CFlowError: see `nuscenes_tables.Tables.scene`; fewer than two sweeps, an unknown category, no such LiDAR.
    """

    _categories: ClassVar[Mapping[str, str]] = NUSCENES_CATEGORIES
    _reference: ClassVar[str] = "LIDAR_TOP"  # the LiDAR whose times are those of the log
    # 4.084 m x 1.730 m around the LiDAR at x = 0.944 m, as OpenSceneFlow has it.
    OWN_VEHICLE: ClassVar[Footprint] = Footprint(rear=-1.098, front=2.986, half_width=0.865)

    def __init__(
        self,
        source: SceneSource,
        sweep_step: int = 1,
        lidars: Optional[Sequence[str]] = None,
        own_vehicle: Optional[Footprint] = OWN_VEHICLE,
    ) -> None:
        if sweep_step < 1:
            raise CFlowError(f"sweep_step={sweep_step}: it is 1 for all sweeps, 2 for every second one")
        self.log_id, self._root, self._own_vehicle = source.scene, as_path(source.root), own_vehicle
        folder = self._root / source.version
        scene = (source.tables or Tables(folder)).scene(source.scene)
        unknown = sorted(set(scene.annotations.category) - set(self._categories))
        if unknown:
            raise CFlowError(
                f"{folder}: unknown categories {shown(unknown)}; the known ones are {sorted(self._categories)}"
            )
        missing = [] if lidars is None else [name for name in lidars if name not in scene.lidars]
        if missing or not scene.lidars:
            raise CFlowError(
                f"scene {self.log_id} in {folder} has no LiDAR {missing or ''}; it has {list(scene.lidars)}"
            )
        self._lidars = {name: scene.lidars[name] for name in lidars or scene.lidars}
        reference = self._lidars[self._reference if self._reference in self._lidars else next(iter(self._lidars))]
        kept = np.flatnonzero(_is_kept(reference.is_key_frame, sweep_step))
        if len(kept) < 2:
            raise CFlowError(f"scene {self.log_id} in {folder} has {len(kept)} sweeps; scene flow needs two or more")
        self.timestamps: Sequence[int] = reference.times[kept].tolist()
        self._poses = transforms(reference.ego[kept])
        self._odometry = (reference.times, reference.ego)
        self._tracks = Tracks(scene.sample_times, scene.annotations)

    def __len__(self) -> int:
        return len(self.timestamps)

    def sweep(self, index: int) -> Sweep:
        """Sweep number `index`: LiDAR after LiDAR, in the order of sensor.json, moved to one ego frame.

        Raises:
            CFlowError: no such sweep, or a file of it cannot be read.
        """
        points, _ = self._cloud(index)
        return Sweep(points, None, self._poses[index].copy(), self.timestamps[index] * 1000)

    def labels(self, index: int) -> Optional[FlowLabels]:
        """Truth of the pair (index, index + 1), from the boxes at both times.

        Boxes are annotated at 2 Hz; between, see `nuscenes_tracks.Tracks.at`. Where an object is annotated at only one
        of the two samples around either sweep, its points are not valid.

        Returns:
            The labels; None for the last sweep, outside the annotated time, and where the data set has no annotations.

        Raises:
            CFlowError: no such sweep, or a file of it cannot be read.
        """
        time0 = self._timestamp(index)
        if index == len(self.timestamps) - 1:
            return None
        time1 = self.timestamps[index + 1]
        if self._tracks.at(time0) is None or self._tracks.at(time1) is None:
            return None
        points, lag = self._cloud(index)
        flow = np.zeros((len(points), 3), dtype=np.float32)
        category, is_valid = np.zeros(len(points), dtype=np.uint8), np.zeros(len(points), dtype=bool)
        # An object is where its box was when the shot hit it: boxes of both ends are taken as much later.
        slices, group = np.unique(lag // _TIME_SLICE, return_inverse=True)
        for number, middle in enumerate(slices * _TIME_SLICE + (_TIME_SLICE // 2 if lag.any() else 0)):
            rows = np.flatnonzero(group == number)
            part = self._labels_of(points[rows], index, int(middle))
            flow[rows], category[rows], is_valid[rows] = part.flow, part.category, part.is_valid
        return FlowLabels(flow, category, is_valid)

    def _labels_of(self, points: np.ndarray, index: int, lag: int) -> FlowLabels:
        """Labels of points that were measured `lag` microseconds after the time stamp of sweep `index`."""
        time0, time1 = self.timestamps[index], self.timestamps[index + 1]
        lag = int(np.clip(lag, self._tracks.start - time0, self._tracks.end - time1))
        tracks0, tracks1 = self._tracks.at(time0 + lag), self._tracks.at(time1 + lag)
        assert tracks0 is not None and tracks1 is not None
        T_ego0_world, T_ego1_world = np.linalg.inv(self._poses[index]), np.linalg.inv(self._poses[index + 1])
        boxes0 = self._boxes(tracks0, T_ego0_world, np.ones(len(tracks0.track), dtype=bool))
        boxes1 = self._boxes(tracks1, T_ego1_world, tracks1.is_known)
        return flow_from_boxes(points, boxes0, boxes1, T_ego1_world @ self._poses[index])

    def _boxes(self, tracks: TrackBoxes, T_ego_world: np.ndarray, use: np.ndarray) -> Boxes:
        """Boxes in the ego frame. A guessed box gets a name that no box of another sweep has: its track ends there."""
        rows = [row for row in np.flatnonzero(use) if tracks.category[row] != OWN_TRAILER]
        categories = [CATEGORY_INDEX[self._categories[tracks.category[row]]] for row in rows]
        return Boxes(
            track_id=[tracks.track[row] if tracks.is_known[row] else f"{tracks.track[row]} guessed" for row in rows],
            category=np.array(categories, dtype=np.uint8),
            size=tracks.size[rows],
            pose=T_ego_world @ tracks.pose[rows],
        )

    def _timestamp(self, index: int) -> int:
        if not 0 <= index < len(self.timestamps):
            raise CFlowError(f"log {self.log_id} has sweeps 0 ... {len(self.timestamps) - 1}, asked for {index}")
        return self.timestamps[index]

    def _cloud(self, index: int) -> Tuple[np.ndarray, np.ndarray]:
        """(N, 3) float32 points, ego frame of the sweep; (N,) int64 microseconds from its time stamp to each shot, 0
        where the format does not tell."""
        time = self._timestamp(index)
        parts = []
        for chain in self._lidars.values():
            row = int(np.abs(chain.times - time).argmin())
            if abs(int(chain.times[row]) - time) <= MAX_UNIT_LAG:
                parts.append(self._unit_points(chain, row, index))
        return np.concatenate([points for points, _ in parts]), np.concatenate([lag for _, lag in parts])

    def _unit_points(self, chain: LidarChain, row: int, index: int) -> Tuple[np.ndarray, np.ndarray]:
        """`_cloud` of one sweep of one LiDAR."""
        file = inside(self._root, chain.files[row], f"scene {self.log_id}: the filename in sample_data.json")
        try:
            content = read_bytes(file)
        except FileNotFoundError:
            raise CFlowError(
                f"{file} is missing; copy the sensor data of scene {self.log_id} beside the tables"
            ) from None
        except OSError as error:
            raise CFlowError(f"cannot read {file} ({error}); copy it again") from error
        local, times = self._points_of(content, file)
        returned = np.isfinite(local).all(axis=1) & (local != 0).any(axis=1)
        mount = transforms(chain.mount[row : row + 1])[0]
        points = local.astype(np.float64) @ mount[:3, :3].T + mount[:3, 3]
        kept = returned & ~self._is_own(points, index)  # the vehicle moves with its LiDARs, so before compensation
        points = points[kept]
        T_ego_world = np.linalg.inv(self._poses[index])
        if times is None:
            motion, group = T_ego_world @ transforms(chain.ego[row : row + 1]), np.zeros(len(points), dtype=np.int64)
            since = np.zeros(len(points), dtype=np.int64)
        else:
            first, last = int(times[kept].min(initial=chain.times[row])), int(times[kept].max(initial=chain.times[row]))
            lag = max(int(chain.times[row]) - first, last - int(chain.times[row]))
            if lag > MAX_SHOT_LAG:
                raise CFlowError(
                    f"{file}: timestamps of points lie up to {lag} microseconds off the sweep's; they must be "
                    "microseconds since 1970. Open the log with deskew=False to do without"
                )
            distinct, group = np.unique(times[kept], return_inverse=True)
            motion = T_ego_world @ transforms(poses_at(distinct, *self._odometry))
            since = times[kept] - self.timestamps[index]
        for first in range(0, len(points), _BLOCK):
            rows = slice(first, first + _BLOCK)
            at = motion[group[rows]]
            points[rows] = np.einsum("nij,nj->ni", at[:, :3, :3], points[rows]) + at[:, :3, 3]
        return points.astype(np.float32), since

    def _points_of(self, content: bytes, file: Path) -> Tuple[np.ndarray, Optional[np.ndarray]]:
        """(N, 3) points in the frame of the LiDAR; (N,) int64 microseconds, times of the shots, None = all at once."""
        return pcd_bin_points(content, file), None

    def _is_own(self, points: np.ndarray, index: int) -> np.ndarray:
        """(N,) bool, above the recording vehicle or in the box of its trailer; points in the ego frame."""
        own = np.zeros(len(points), dtype=bool)
        if self._own_vehicle is None:
            return own
        rear, front, half_width = self._own_vehicle
        own |= (points[:, 0] > rear) & (points[:, 0] < front) & (np.abs(points[:, 1]) < half_width)
        tracks = self._tracks.at(self.timestamps[index]) if OWN_TRAILER in self._categories else None
        if tracks is not None:
            T_ego_world = np.linalg.inv(self._poses[index])
            for row in [row for row, name in enumerate(tracks.category) if name == OWN_TRAILER]:
                own |= points_in_box(points, tracks.size[row], T_ego_world @ tracks.pose[row])
        return own


def read_pcd_bin(file: Place) -> np.ndarray:
    """Points of a nuScenes LiDAR sweep.

    Args:
        file: `.pcd.bin`: rows of little-endian float32 x, y, z (metres, frame of the LiDAR), intensity, ring.

    Returns:
        (N, 3) float32.

    Raises:
        CFlowError: the file is empty, has no whole number of rows, or its last column holds no ring numbers.
    """
    try:
        content = read_bytes(as_path(file))
    except OSError as error:
        raise CFlowError(f"cannot read {file} ({error}); give a .pcd.bin file") from error
    return pcd_bin_points(content, file)


def pcd_bin_points(content: bytes, file: Place) -> np.ndarray:
    """As `read_pcd_bin`, of what is in the file."""
    if not content or len(content) % (_COLUMNS * _ROW.itemsize):
        raise CFlowError(
            f"{file} has {len(content)} bytes, which is no whole number of rows of five float32 (x, y, z, intensity, "
            "ring): it is truncated or another format; copy it again"
        )
    rows = np.frombuffer(content, dtype=_ROW).reshape(-1, _COLUMNS)
    ring = rows[:, 4]
    if not (np.isfinite(ring) & (ring >= 0) & (ring < 256) & (ring == np.floor(ring))).all():
        raise CFlowError(f"{file}: the fifth number of a point is no ring 0 ... 255; is it a .pcd.bin of nuScenes?")
    return rows[:, :3].astype(np.float32)


def _is_kept(is_key_frame: np.ndarray, step: int) -> np.ndarray:
    """(M,) bool: key frames, and every `step`-th sweep counted from the last one."""
    kept = np.zeros(len(is_key_frame), dtype=bool)
    since = 0
    for row, is_key in enumerate(is_key_frame):
        since = 0 if is_key else since
        kept[row] = since % step == 0
        since += 1
    return kept
