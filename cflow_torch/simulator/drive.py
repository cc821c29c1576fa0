"""A simulated drive: a `Log` with exact poses, ground masks and flow."""

from __future__ import annotations

import uuid
from collections import OrderedDict
from dataclasses import replace
from typing import Callable, Mapping, TypeVar

import numpy as np
import torch

from cflow_torch.data.av2 import GroundRaster
from cflow_torch.data.boxes import Boxes
from cflow_torch.data.categories import CATEGORY_INDEX
from cflow_torch.data.log import FlowLabels, Log
from cflow_torch.simulator.car_park import build_car_park
from cflow_torch.simulator.crossing import build_crossing
from cflow_torch.simulator.highway import build_highway
from cflow_torch.simulator.lidar import Returns, scan, scan_rolling
from cflow_torch.simulator.motion import SceneMotion
from cflow_torch.simulator.narrow import build_narrow
from cflow_torch.simulator.objects import own_truck
from cflow_torch.simulator.profiles import PROFILES, WEATHER, in_weather
from cflow_torch.simulator.recording import UnitReturns
from cflow_torch.simulator.rolling import Shots
from cflow_torch.simulator.scene import Scene
from cflow_torch.simulator.sensors import LidarProfile, SpinningLidar
from cflow_torch.simulator.street import build_street
from cflow_torch.transforms import transform_each
from cflow_torch.types import CFlowError, Sweep

SCENES: dict[str, Callable[[np.random.Generator], Scene]] = {
    "street": build_street,
    "highway": build_highway,
    "crossing": build_crossing,
    "narrow": build_narrow,
    "car_park": build_car_park,
}
_FIRST_STAMP_NS = 315_970_000_000_000_000
_CACHED_SWEEPS = 8  # a window of five sweeps and its neighbours; a sweep of 100,000 points takes 3 MB
_BOX_SLACK = 0.1  # metres by which boxes are larger than bodies, so that they hold noisy points
_ROUNDING = 1e-4  # metres by which boxes are enlarged to hold their points after rounding to float32
_RASTER_STEP = 0.3  # metres per cell of the ground raster, as in Argoverse 2
T = TypeVar("T")


class Drive(Log):
    """A drive through a simulated scene.

    Each sweep is simulated on demand from its own random stream, so sweeps do not depend on the order of the calls. In
    the profiles av2 and demo, all shots of a sweep are simultaneous. In the others, every shot has its own time. We
    compensate the ego motion within a sweep if the data set does. Moving objects stay distorted, and their boxes are
    enlarged to hold the distorted points.

    Args:
        scene: ground, bodies and the route of the recording vehicle.
        profile: the LiDARs.
        seed: seed of the noise and of the track ids.
        num_sweeps: number of sweeps, at the rate of the profile.
        log_id: name of the log.

    Attributes:
        log_id, timestamps: name and sweep times in nanoseconds.
        poses: (num_sweeps, 4, 4) float64 `T_world_ego`.
        calibration: sensor name -> (4, 4) float64 `T_ego_sensor`.
        track_ids: one UUID per body of the scene; only bodies with a category are annotated.
    """

    poses: np.ndarray

    def __init__(self, scene: Scene, profile: LidarProfile, seed: int, num_sweeps: int, log_id: str) -> None:
        self.log_id = log_id
        self.timestamps = tuple(_FIRST_STAMP_NS + i * profile.sweep_interval_ns for i in range(num_sweeps))
        self.scene = scene
        self.calibration: dict[str, np.ndarray] = {unit.name: unit.T_ego_sensor for unit in profile.units}
        self._profile = profile
        self._seed = seed
        self._seconds = np.arange(num_sweeps) * (profile.sweep_interval_ns * 1e-9)
        self._motion = SceneMotion(scene, profile, self._seconds)
        self._body_poses = scene.body_poses(self._seconds)
        self.poses = self._motion.ego_poses(self._seconds)
        self._is_annotated = self._annotated(scene)
        self._category = np.array([CATEGORY_INDEX[body.category or "NONE"] for body in scene.bodies], np.uint8)
        identity = np.random.default_rng([seed, 1])
        self.track_ids = tuple(str(uuid.UUID(bytes=identity.bytes(16), version=4)) for _ in scene.bodies)
        self._cache: OrderedDict[int, Returns] = OrderedDict()

    def poses_at(self, index: int, offset_ns: np.ndarray) -> np.ndarray:
        """(M, 4, 4) float64 true `T_world_ego` at `offset_ns` (M,) after the time stamp of sweep `index`."""
        return self._motion.ego_poses(self._seconds[index] + 1e-9 * np.asarray(offset_ns, np.float64))

    def sweep(self, index: int) -> Sweep:
        """Sweep `index`: (N, 3) float32 points in its ego frame, exact ground mask, float64 pose and time stamp. It has
        point times if the profile is rolling (`LidarProfile.is_rolling`)."""
        returns = self.returns(index)
        return Sweep(
            points=returns.points.numpy().copy(),
            is_ground=(returns.solid < 0).numpy(),
            pose=self.poses[index].copy(),
            timestamp_ns=self.timestamps[index],
            point_times=returns.offset_ns.numpy() * 1e-9 if self._profile.is_rolling else None,
        )

    def labels(self, index: int) -> FlowLabels | None:
        """Ground truth of the pair (index, index + 1), None for the last sweep.

        A point belongs to the body that its ray hit. It moves with this body from one time stamp to the next, even if
        it was measured before or after the time stamp: p' = inv(pose1) B1 inv(B0) pose0 p in float64, where B0, B1 are
        the poses `T_world_body`. We ignore the swing of legs. A body with a category is annotated in a sweep if its
        middle is within the LiDARs' range. Points of a body are invalid unless it is annotated in both sweeps. Points
        of a body that is not annotated at `index` have category 0.
        """
        returns = self.returns(index)
        if index == len(self.timestamps) - 1:
            return None
        world_ego = np.linalg.inv(self.poses[index + 1])
        static = world_ego @ self.poses[index]
        moved = world_ego @ self._body_poses[index + 1] @ np.linalg.inv(self._body_poses[index]) @ self.poses[index]
        is_background = self._category == 0
        moved[is_background] = static
        motions = np.concatenate([moved, static[None]])  # the last row is for the ground

        body = self._body_of(returns)
        points = returns.points.numpy().astype(np.float64)
        motion = motions[body]
        flow = transform_each(points, motion) - points
        now = np.append(self._is_annotated[index], True)
        then = np.append(self._is_annotated[index + 1], True)
        category = np.where(now, np.append(self._category, 0), 0).astype(np.uint8)
        return FlowLabels(flow.astype(np.float32), category[body], (now & then)[body])

    def boxes(self, index: int) -> Boxes:
        """Annotation boxes of sweep `index`, in its ego frame."""
        returns = self.returns(index)
        chosen = np.flatnonzero(self._is_annotated[index] & (self._category > 0))
        size = np.array([self.scene.bodies[i].size for i in chosen]).reshape(-1, 3) + _BOX_SLACK
        pose = np.linalg.inv(self.poses[index]) @ self._body_poses[index, chosen]
        if self._profile.is_rolling:
            size = np.maximum(size, self._extent(index, returns)[chosen])
        pose[:, :3, 3] += pose[:, :3, 2] * size[:, 2:] / 2
        return Boxes(
            track_id=tuple(self.track_ids[i] for i in chosen),
            category=self._category[chosen],
            size=size,
            pose=pose,
            num_points=np.bincount(self._body_of(returns), minlength=len(self.scene.bodies) + 1)[chosen],
        )

    def channels(self, index: int) -> dict[str, np.ndarray]:
        """Intensity, laser number and firing time of every point of sweep `index`."""
        returns = self.returns(index)
        return {name: getattr(returns, name).numpy() for name in ("intensity", "laser_number", "offset_ns")}

    def units(self, index: int) -> list[UnitReturns]:
        """Returns of each LiDAR in sweep `index`. Concatenated in this order, they match the rows of `sweep(index)`."""
        returns = self.returns(index)
        parts = []
        begin = 0
        counts = torch.bincount(returns.unit, minlength=len(self._profile.units)).tolist()
        for unit, count in zip(self._profile.units, counts):
            rows = slice(begin, begin + count)
            parts.append(
                UnitReturns(
                    name=unit.name,
                    T_ego_sensor=unit.T_ego_sensor,
                    points=returns.local[rows].numpy().copy(),
                    ring=returns.ring[rows].numpy().copy(),
                    column=returns.column[rows].numpy().copy(),
                    offset_ns=returns.offset_ns[rows].numpy().astype(np.int64),
                    intensity=returns.intensity[rows].numpy().copy(),
                    elevations=np.radians(np.sort(np.array(unit.elevations, np.float64))),
                    num_columns=unit.num_columns,
                )
            )
            begin += count
        return parts

    def ground_raster(self) -> GroundRaster:
        """Ground height of the area within the LiDARs' range."""
        reach = self._profile.max_range + 1
        low = np.floor(self.poses[:, :2, 3].min(0) - reach)
        count = np.ceil((self.poses[:, :2, 3].max(0) + reach - low) / _RASTER_STEP).astype(int)
        x, y = (low[k] + _RASTER_STEP * (np.arange(count[k]) + 0.5) for k in (0, 1))
        height = self.scene.ground.height(*np.meshgrid(x, y))
        return GroundRaster(height, np.eye(2), -low, 1 / _RASTER_STEP)

    def returns(self, index: int) -> Returns:
        """Returns of all LiDARs in sweep `index`; an index that does not exist is a `CFlowError`."""
        self._timestamp(index)
        if index not in self._cache:
            self._cache[index] = self._scan(index)
            if len(self._cache) > _CACHED_SWEEPS:
                self._cache.popitem(last=False)
        return self._cache[index]

    def _scan(self, index: int) -> Returns:
        stream = np.random.SeedSequence([self._seed, 2, index]).generate_state(1, np.uint32)[0]
        generator = torch.Generator().manual_seed(int(stream))
        seconds = float(self._seconds[index])
        ground = self.scene.ground
        pose = torch.from_numpy(self.poses[index])
        if not self._profile.is_rolling:
            return scan(self._profile, self.scene.solids(seconds, self._body_poses[index]), ground, pose, generator)
        solids = self._motion.solids(index)

        def shots_of(unit: SpinningLidar, phase: float) -> Shots:
            return self._motion.shots(unit, seconds, phase, solids.origin)

        return scan_rolling(self._profile, solids, ground, pose, shots_of, generator)

    def _extent(self, index: int, returns: Returns) -> np.ndarray:
        """(num_bodies, 3) float64 size of the smallest upright box, centred on a body's axis, that holds its points."""
        points = returns.points.numpy().astype(np.float64)
        if not self._profile.is_deskewed:
            moved = np.linalg.inv(self.poses[index]) @ self.poses_at(index, returns.offset_ns.numpy())
            points = transform_each(points, moved)
        body = self._body_of(returns)
        chosen = np.append(self._category > 0, False)[body]
        points = points[chosen]
        body = body[chosen]
        T_body_ego = (np.linalg.inv(self._body_poses[index]) @ self.poses[index])[body]
        local = np.abs(transform_each(points, T_body_ego))
        extent = np.zeros((len(self.scene.bodies), 3))
        np.maximum.at(extent, body, local * (2, 2, 1))
        return extent + _ROUNDING

    def _body_of(self, returns: Returns) -> np.ndarray:
        """(N,) int64 index of each point's body; ground points have the number of bodies."""
        return np.append(self.scene.body_of_solid, len(self.scene.bodies))[returns.solid.numpy()]

    def _annotated(self, scene: Scene) -> np.ndarray:
        """(num_sweeps, num_bodies) bool: the body is background, or its middle is within the LiDARs' range."""
        offset = self._body_poses[:, :, :2, 3] - self.poses[:, None, :2, 3]
        is_background = np.array([body.category is None for body in scene.bodies])
        return is_background | (np.hypot(offset[..., 0], offset[..., 1]) < self._profile.max_range)


def make_drive(
    seed: int = 0, num_sweeps: int = 20, profile: str = "av2", scene: str = "street", weather: str = "clear"
) -> Drive:
    """Simulate a drive past houses, trees, traffic and people.

    Args:
        seed: >= 0; the same seed gives the same bytes on the same machine.
        num_sweeps: >= 1, at the rate of the profile. After the first seconds, vehicles may drive through each other.
        profile: the LiDARs of a data set, `av2`, `nuscenes`, `truckscenes`, `waymo` or `aevascenes`; `demo` (one LiDAR
            with 28,800 rays); or `av2_rolling` (as av2, but every shot has its own time).
        scene: `street`, `highway`, `crossing`, `narrow`, `car_park`.
        weather: `clear`, `rain`, `snow`, `fog`.

    Returns:
        The drive, a `Log`.

    Raises:
        CFlowError: an argument is out of range, or there is no profile, scene or weather of that name.

    Examples:
        >>> drive = make_drive(seed=1, num_sweeps=2, profile="demo")
        >>> drive.sweep(0).points.shape == drive.labels(0).flow.shape
        True
    """
    are_whole = all(isinstance(number, (int, np.integer)) for number in (seed, num_sweeps))
    if not are_whole or seed < 0 or num_sweeps < 1:
        raise CFlowError(f"seed={seed}, num_sweeps={num_sweeps}: give whole numbers, seed >= 0 and num_sweeps >= 1")
    lidars = in_weather(_choose("sensor profile", profile, PROFILES), *_choose("weather", weather, WEATHER))
    world = _choose("scene", scene, SCENES)(np.random.default_rng([seed, 0]))
    if lidars.has_trailer:
        own = own_truck(world.ego)
        world = replace(world, bodies=(*world.bodies, *own), num_own=len(own))
    return Drive(world, lidars, seed, num_sweeps, drive_name(seed, profile, scene, weather))


def drive_name(seed: int, profile: str, scene: str, weather: str = "clear") -> str:
    """Return the `log_id` of a drive."""
    parts = [profile, *([scene] if scene != "street" else []), *([weather] if weather != "clear" else [])]
    return f"synthetic-{'-'.join(parts)}-{seed:04d}"


def _choose(kind: str, name: str, options: Mapping[str, T]) -> T:
    if name not in options:
        raise CFlowError(f"{kind} {name!r} does not exist; choose one of {', '.join(sorted(options))}")
    return options[name]
