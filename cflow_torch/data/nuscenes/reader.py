"""Reader of raw nuScenes: its JSON tables and `.pcd.bin` sweeps, with numpy alone."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import ClassVar, Literal, Mapping, NamedTuple, Sequence

import numpy as np

from cflow_torch.data.boxes import Boxes, category_indices, flow_from_boxes, rows_in_box
from cflow_torch.data.camera import Camera, at_image
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.log import FlowLabels, Log
from cflow_torch.data.nuscenes.tables import Chain, SceneSource, Tables, Tracks, find_scenes
from cflow_torch.data.paths import PathLike, as_path, exist, path_inside, read_bytes
from cflow_torch.transforms import poses_at, transform_each, transform_points
from cflow_torch.types import CFlowError, Sweep
from cflow_torch.windows.returns import missing_returns

MAX_UNIT_LAG = 60_000  # microseconds from another LiDAR's sweep to the reference's: a bit more than half a revolution
_TIME_SLICE = 10_000  # microseconds during which we use one position of a moving box: 0.15 m off at most at 30 m/s
MAX_SHOT_LAG = 1_000_000  # microseconds from a shot to its sweep; larger values mean another unit or clock
_COLUMNS = 5  # float32 numbers per point: x, y, z, intensity, ring
OWN_TRAILER = "vehicle.ego_trailer"  # the trailer of the recording truck of TruckScenes

NUSCENES_CATEGORIES: dict[str, str] = {
    "animal": "ANIMAL",
    "human.pedestrian.adult": "PEDESTRIAN",
    "human.pedestrian.child": "PEDESTRIAN",
    "human.pedestrian.construction_worker": "PEDESTRIAN",
    "human.pedestrian.personal_mobility": "PEDESTRIAN",
    "human.pedestrian.police_officer": "PEDESTRIAN",
    "human.pedestrian.stroller": "STROLLER",
    "human.pedestrian.wheelchair": "WHEELCHAIR",
    "movable_object.barrier": "NONE",
    "movable_object.debris": "NONE",
    "movable_object.pushable_pullable": "NONE",
    "movable_object.trafficcone": "CONSTRUCTION_CONE",
    "static_object.bicycle_rack": "NONE",
    "vehicle.bicycle": "BICYCLE",
    "vehicle.bus.bendy": "ARTICULATED_BUS",
    "vehicle.bus.rigid": "BUS",
    "vehicle.car": "REGULAR_VEHICLE",
    "vehicle.construction": "LARGE_VEHICLE",
    "vehicle.emergency.ambulance": "LARGE_VEHICLE",
    "vehicle.emergency.police": "REGULAR_VEHICLE",
    "vehicle.motorcycle": "MOTORCYCLE",
    "vehicle.trailer": "VEHICULAR_TRAILER",
    "vehicle.truck": "TRUCK",
}
"""Category of a box -> name in Argoverse 2; NONE = background, although its points move with the box."""


class Footprint(NamedTuple):
    """The area of the recording vehicle, metres in the ego frame: x from `rear` to `front`, |y| up to `half_width`."""

    rear: float
    front: float
    half_width: float


def find_nuscenes_scenes(root: PathLike) -> list[SceneSource]:
    """Find all scenes under a folder, see `nuscenes.tables.find_scenes`."""
    return find_scenes(root, ("ego_motion_cabin", "ego_motion_chassis"), "nuScenes")


class NuScenesLog(Log):
    """One nuScenes scene.

    Args:
        source: the scene, from `find_nuscenes_scenes`.
        sweep_step: 1 = all sweeps (20 Hz); 2 = every second one after each key frame, and every key frame (10 Hz, as
            OpenSceneFlow thins nuScenes).
        lidars: channels to merge; None = every LiDAR of the scene.
        own_vehicle: `Footprint` whose points are removed; "auto" = `OWN_VEHICLE`, None = keep them. Points at the
            sensor itself mean "no return" and are always removed.
        deskew: transform each point by the pose of the vehicle at the time of the point; False = at the time of its
            LiDAR's sweep. Ignored for nuScenes, whose files have no times of points.

    Attributes:
        log_id: name of the scene.
        poses: (K, 4, 4) float64 `T_world_ego` of every sweep.
        timestamps: sweep times, in nanoseconds; the tables have microseconds.
        sample_tokens: token of each key frame; None = the sweep is not a key frame.

    Convention:
        - Points are in the ego frame at the sweep's time stamp (x forward, y left, z up, origin on the ground below the
          rear axle); nuScenes itself has compensated ego motion. It has no ground masks.
        - Truth comes from boxes, which are annotated at 2 Hz. `tables.Tracks.at` interpolates them. If an object is
          annotated at only one of the two samples around either sweep, its points are not valid. There is no truth
          outside the annotated time.
    """

    _categories: ClassVar[Mapping[str, str]] = NUSCENES_CATEGORIES
    _reference: ClassVar[str] = "LIDAR_TOP"  # the log has the times of this LiDAR
    _has_times: ClassVar[bool] = False  # of points
    # 4.084 m x 1.730 m around the LiDAR at x = 0.944 m, as OpenSceneFlow has it.
    OWN_VEHICLE: ClassVar[Footprint] = Footprint(rear=-1.098, front=2.986, half_width=0.865)

    def __init__(
        self,
        source: SceneSource,
        sweep_step: int = 1,
        lidars: Sequence[str] | None = None,
        own_vehicle: Footprint | Literal["auto"] | None = "auto",
        deskew: bool = True,
    ) -> None:
        if sweep_step < 1:
            raise CFlowError(f"sweep_step={sweep_step}: pass 1 for all sweeps, 2 for every second one")
        self.log_id = source.name
        self._root = as_path(source.root)
        self._deskew = deskew
        self.is_compensated = deskew and self._has_times
        self._own_vehicle = self.OWN_VEHICLE if own_vehicle == "auto" else own_vehicle
        folder = self._root / source.version
        self._tables = source.tables or Tables(folder)
        sample_times, annotations = self._tables.scene(source.name)
        known = self._tables.chains(source.name, "lidar")
        category_indices(annotations.category, self._categories)  # says which are unknown
        missing = [] if lidars is None else [name for name in lidars if name not in known]
        if missing or not known:
            raise CFlowError(f"scene {self.log_id} in {folder} has no LiDAR {missing or ''}; it has {list(known)}")
        self._lidars = {name: known[name] for name in lidars or known}
        reference = self._lidars[self._reference if self._reference in self._lidars else next(iter(self._lidars))]
        self._keep_sweeps(reference, sweep_step, folder)
        self.lidar_position = reference.mount[0, :3, 3]
        self.turn_seconds = float(np.median(np.diff(reference.times))) * 1e-6  # of all sweeps, not only of those kept
        self._odometry = (reference.times, reference.ego)
        self._tracks = Tracks(sample_times, annotations)

    def _keep_sweeps(self, reference: Chain, sweep_step: int, folder: Path) -> None:
        """Keep key frames, and every `sweep_step`-th sweep counted from the last key frame."""
        row = np.arange(len(reference.times))
        last_key = np.maximum.accumulate(np.where(reference.is_key_frame, row, 0))
        kept = np.flatnonzero((row - last_key) % sweep_step == 0)
        self.timestamps = (1000 * reference.times[kept]).tolist()
        self._check_count(f"scene {self.log_id} in {folder}")
        self._check_files(reference, kept, int((row - last_key).max()) + 1)
        self.poses: np.ndarray = reference.ego[kept]
        self.sample_tokens = [reference.samples[k] if reference.is_key_frame[k] else None for k in kept.tolist()]
        self._T_ego_world = np.linalg.inv(self.poses)

    def _check_files(self, chain: Chain, kept: np.ndarray, step: int) -> None:
        """Say in one error if only key frames are there, or no file of the scene. We look at a few files of a kind."""
        has = {}
        for is_key_frame in (True, False):
            rows = kept[chain.is_key_frame[kept] == is_key_frame]
            has[is_key_frame] = any(self._has_file(chain.files[row]) for row in rows[:: len(rows) // 2 or 1])
        if not any(has.values()):
            raise CFlowError(
                f"scene {self.log_id}: its files are not in {self._root}; another part of the set has them"
            )
        if not has[False] and not chain.is_key_frame[kept].all():
            raise CFlowError(
                f"scene {self.log_id}: only its key frames are in {self._root}. Pass sweep_step={step} (in commands "
                f"data.sweep_step={step}) to use them alone, at 2 Hz, or download the folder sweeps"
            )

    def _has_file(self, name: str) -> bool:
        """Test whether a file exists. For a name that may not be read, `sweep` raises the error."""
        try:
            return exist(path_inside(self._root, name, self.log_id))
        except CFlowError:
            return True

    def _microseconds(self, index: int) -> int:
        """Return the time of a sweep as the tables have it."""
        return self._timestamp(index) // 1000

    def sweep(self, index: int) -> Sweep:
        """Read sweep `index`: all LiDARs in one ego frame, in the order of `lidars`, else of sensor.json."""
        points, lag = self._cloud(index)
        times = lag * 1e-6 if lag.any() else None
        return Sweep(points, None, self.poses[index].copy(), self.timestamps[index], times)

    def cameras(self, index: int) -> list[Camera]:
        """Return all cameras of the scene, each with its image nearest in time."""
        time = self._microseconds(index)
        cameras = []
        for name, chain in self._camera_chains:
            row = int(np.abs(chain.times - time).argmin())
            image = Path(chain.files[row]).stem
            width, height = chain.sizes[row].tolist()
            T_camera_ego = at_image(chain.mount[row], chain.ego[row], self.poses[index])
            seconds = int(chain.times[row] - time) * 1e-6
            cameras.append(Camera(name, image, (width, height), chain.matrix[row], T_camera_ego, seconds))
        return cameras

    @cached_property
    def _camera_chains(self) -> list[tuple[str, Chain]]:
        return sorted(self._tables.chains(self.log_id, "camera").items())

    def _labels(self, index: int) -> FlowLabels | None:
        time0, time1 = self._microseconds(index), self._microseconds(index + 1)
        if time0 < self._tracks.start or time1 > self._tracks.end:
            return None
        points, lag = self._cloud(index)
        T_ego1_ego0 = self._T_ego_world[index + 1] @ self.poses[index]
        flow = np.zeros((len(points), 3), dtype=np.float32)
        category, is_valid = np.zeros(len(points), dtype=np.uint8), np.zeros(len(points), dtype=bool)
        # A shot hits an object where its box is at the time of the shot, so we add the lag to the times of both boxes.
        slices, group = np.unique(lag // _TIME_SLICE, return_inverse=True)
        for position, middle in enumerate(slices * _TIME_SLICE + (_TIME_SLICE // 2 if lag.any() else 0)):
            rows = np.flatnonzero(group == position)
            shift = int(np.clip(middle, self._tracks.start - time0, self._tracks.end - time1))
            boxes0, boxes1 = self._boxes(time0 + shift, index), self._boxes(time1 + shift, index + 1)
            found = flow_from_boxes(points[rows], boxes0, boxes1, T_ego1_ego0)
            flow[rows], category[rows], is_valid[rows] = found.flow, found.category, found.is_valid
        return FlowLabels(flow, category, is_valid)

    def _boxes(self, time: int, index: int) -> Boxes:
        """Return the boxes at a time in the ego frame of sweep `index`; a guessed box is renamed, so its track ends."""
        tracks, is_known = self._tracks.at(time)
        rows = [row for row, name in enumerate(tracks.category) if name != OWN_TRAILER]
        return Boxes(
            [tracks.track[row] if is_known[row] else f"{tracks.track[row]} guessed in {index}" for row in rows],
            category_indices([tracks.category[row] for row in rows], self._categories),
            tracks.size[rows],
            self._T_ego_world[index] @ tracks.pose[rows],
        )

    def _cloud(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Read (N, 3) float32 points in the ego frame, and (N,) int64 microseconds from the time stamp; 0 = unknown."""
        time = self._microseconds(index)
        clouds = []
        for chain in self._lidars.values():
            row = int(np.abs(chain.times - time).argmin())
            if abs(int(chain.times[row]) - time) <= MAX_UNIT_LAG:
                clouds.append(self._lidar_points(chain, row, index))
        return np.concatenate([points for points, _ in clouds]), np.concatenate([lag for _, lag in clouds])

    def _lidar_points(self, chain: Chain, row: int, index: int) -> tuple[np.ndarray, np.ndarray]:
        file = path_inside(self._root, chain.files[row], f"scene {self.log_id}: the filename in sample_data.json")
        local, times = self._points_of(file)
        points = transform_points(local, chain.mount[row])
        # We remove the own vehicle before compensation, because it moves with its LiDARs.
        kept = ~missing_returns(local) & ~self._is_own(points, index)
        points, T_ego_world = points[kept], self._T_ego_world[index]
        if times is None:
            at = np.broadcast_to(T_ego_world @ chain.ego[row], (len(points), 4, 4))
            return transform_each(points, at).astype(np.float32), np.zeros(len(points), dtype=np.int64)
        times = times[kept]
        lag = np.abs(times - float(chain.times[row])).max(initial=0)
        if lag > MAX_SHOT_LAG:
            raise CFlowError(
                f"{file}: time stamps of points differ by up to {lag:.0f} microseconds from the sweep's; they must be "
                "microseconds since 1970. Pass deskew=False to ignore them"
            )
        distinct, group = np.unique(times, return_inverse=True)
        at = (T_ego_world @ poses_at(distinct, *self._odometry))[group]
        return transform_each(points, at).astype(np.float32), times - self._microseconds(index)

    def _points_of(self, file: Path) -> tuple[np.ndarray, np.ndarray | None]:
        """Return (N, 3) points in the frame of the LiDAR, and the (N,) int64 microseconds of shots; None = unknown."""
        with file_errors(file):
            rows = np.frombuffer(read_bytes(file), "<f4").reshape(-1, _COLUMNS)
        if len(rows) == 0:
            raise CFlowError(f"{file} is empty; copy it again")
        if not np.isin(rows[:, 4], np.arange(256)).all():
            raise CFlowError(f"{file}: column 5 is not a ring index (0 ... 255); is it a .pcd.bin of nuScenes?")
        return rows[:, :3].astype(np.float32), None

    def _is_own(self, points: np.ndarray, index: int) -> np.ndarray:
        """Return (N,) bool: in the footprint of the recording vehicle or the box of its trailer. Points: ego frame."""
        if self._own_vehicle is None:
            return np.zeros(len(points), dtype=bool)
        rear, front, half_width = self._own_vehicle
        own = (points[:, 0] > rear) & (points[:, 0] < front) & (np.abs(points[:, 1]) < half_width)
        if OWN_TRAILER in self._categories:
            tracks, _ = self._tracks.at(self._microseconds(index))
            for name, size, pose in zip(tracks.category, tracks.size, tracks.pose):
                if name == OWN_TRAILER:
                    own[rows_in_box(points, size, self._T_ego_world[index] @ pose)] = True
        return own
