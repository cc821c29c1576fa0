"""The tables of nuScenes and of MAN TruckScenes: JSON lists of flat rows that refer to each other by tokens."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Collection, Dict, NamedTuple, Sequence

import numpy as np

from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.folders import find_folders
from cflow_torch.data.json_file import read_json
from cflow_torch.data.paths import PathLike, as_path, safe_name
from cflow_torch.transforms import interpolate_poses, poses_from_quaternions
from cflow_torch.types import CFlowError

SEARCH_DEPTH = 3  # levels of folders that are searched for a scene.json
_SENSOR_FOLDERS = ("samples", "sweeps", "maps")  # next to the tables, with very many files
_COPY = "copy the tables again"
Row = Dict[str, Any]
# The fields that we read; every other field of the format may be missing.
FIELDS: dict[str, tuple[str, ...]] = {
    "scene": ("token", "name"),
    "sample": ("token", "timestamp", "scene_token"),
    "sensor": ("token", "channel", "modality"),
    "calibrated_sensor": ("token", "sensor_token", "translation", "rotation"),
    "sample_data": (
        *("sample_token", "ego_pose_token", "calibrated_sensor_token"),
        *("timestamp", "is_key_frame", "filename"),
    ),
    "ego_pose": ("token", "translation", "rotation"),
    "category": ("token", "name"),
    "instance": ("token", "category_token"),
    "sample_annotation": ("sample_token", "instance_token", "translation", "size", "rotation"),
}


@dataclass(frozen=True)
class SceneSource:
    """The location of a scene."""

    root: Path  # data root, to which `sample_data.filename` is relative
    version: str  # folder of the tables, for example "v1.0-mini"
    name: str  # name of the scene
    # The tables of `version`. Scenes share them, so they are read once; None = read them again.
    tables: Tables | None = field(default=None, repr=False, compare=False)


class LidarChain(NamedTuple):
    """The M sweeps of one LiDAR in one scene, ordered by time."""

    times: np.ndarray  # (M,) int64, microseconds
    is_key_frame: np.ndarray  # (M,) bool
    files: tuple[str, ...]  # relative to the data root
    ego: np.ndarray  # (M, 4, 4) float64 `T_world_ego` at each sweep's own time
    mount: np.ndarray  # (M, 4, 4) float64 `T_ego_sensor`
    samples: tuple[str, ...]  # token of the sample that each sweep belongs to


class CameraChain(NamedTuple):
    """The M images of one camera in one scene, ordered by time."""

    times: np.ndarray  # (M,) int64, microseconds
    files: tuple[str, ...]  # relative to the data root
    sizes: np.ndarray  # (M, 2) int64 width and height, pixels
    ego: np.ndarray  # (M, 4, 4) float64 `T_world_ego` at each image's own time
    mount: np.ndarray  # (M, 4, 4) float64 `T_ego_camera`
    matrix: np.ndarray  # (M, 3, 3) float64 intrinsic matrix


class Annotations(NamedTuple):
    """A number A of boxes: those of a scene at all its samples (key frames), or those at one time (`Tracks.at`)."""

    time: np.ndarray  # (A,) int64, microseconds
    track: Sequence[str]  # A instance tokens
    category: Sequence[str]  # A names of the data set
    size: np.ndarray  # (A, 3) float64, metres: length, width, height
    pose: np.ndarray  # (A, 4, 4) float64 `T_world_box`


def find_scenes(root: PathLike, foreign: Collection[str], data_set: str) -> list[SceneSource]:
    """Find the scenes of all versions under a folder, sorted by folder and name. Scenes of a version share its tables.

    The root is a data root (it holds `v1.0-mini` or the like), the folder of one version, or a folder up to two levels
    above data roots. We skip versions with one of the `foreign` tables, which belong to the other data set. If we skip
    all versions, that is a `CFlowError`.
    """
    what = "the data root, which holds v1.0-mini or the like"
    versions = find_folders(
        *(as_path(root), lambda folder: (folder / "scene.json").is_file(), SEARCH_DEPTH, what),
        lambda child: child.name not in _SENSOR_FOLDERS,
    )
    alien = [v for v in versions if any((v / f"{table}.json").exists() for table in foreign)]
    if alien and len(alien) == len(versions):
        raise CFlowError(f"{alien[0]} is not {data_set}: it has one of {sorted(foreign)}; choose the other reader")
    found = []
    for version in sorted(set(versions) - set(alien)):
        tables = Tables(version)
        found += [SceneSource(version.parent, version.name, name, tables) for name in sorted(tables.scenes)]
    return found


def read_table(
    folder: Path, table: str, key: str = "", values: Collection[str] = (), more: Sequence[str] = ()
) -> list[Row]:
    """Read the rows of a table with the fields of `FIELDS` and `more`.

    With a `key`, we read only rows whose `key` is one of `values`.

    Cost: memory of twice the file, and of the rows that are kept.
    """
    file = folder / f"{table}.json"

    def use(row: Row) -> Row | None:  # called while parsing, so dropped rows and fields need no memory
        if key and row[key] not in values:
            return None
        return {name: row[name] for name in (*FIELDS[table], *more)}

    with file_errors(file, "copy all tables of the version"):
        rows = read_json(file, use)
        if not isinstance(rows, list) or not all(row is None or type(row) is dict for row in rows):
            raise ValueError("it is not a list of rows")
        return [row for row in rows if row is not None]


class Tables:
    """The tables of one version, `<data root>/<version>`. We read them once, when they are first needed.

    Cost: about 5 s per million rows (measured on one core). We drop rows of cameras and radars while we read.
    """

    def __init__(self, folder: PathLike) -> None:
        self.folder = as_path(folder)
        self._rows: dict[str, dict[str, list[Row]]] = {}  # table -> token of the scene -> its rows
        self._by_token: dict[str, dict[str, Row]] = {}
        self._images: dict[str, list[Row]] | None = None  # token of the scene -> its images

    @cached_property
    def scenes(self) -> dict[str, str]:
        """Name of each scene -> its token."""
        rows = read_table(self.folder, "scene")
        file = self.folder / "scene.json"
        scenes = {safe_name(row["name"], f"{file}: the scene"): row["token"] for row in rows}
        if len(scenes) < len(rows):
            raise CFlowError(f"{file} has {len(rows)} scenes but {len(scenes)} names; {_COPY}")
        return scenes

    def scene(self, name: str) -> tuple[np.ndarray, dict[str, LidarChain], Annotations]:
        """Return the rows of a scene, linked and checked: sample times, LiDARs by channel as in sensor.json, and boxes.

        The times are ascending int64 microseconds. If a row refers to a missing one, or if two sweeps of a LiDAR or two
        samples have the same time, that is a `CFlowError`.
        """
        with file_errors(f"{self.folder}, {name}", _COPY):
            if not self._rows:
                self._load()
            rows = {table: by_scene[self.scenes[name]] for table, by_scene in self._rows.items()}
            samples = self._ordered("sample", rows["sample"])
            channels: dict[str, list[Row]] = {row["channel"]: [] for row in self._by_token["sensor"].values()}
            for row in self._ordered("sample_data", rows["sample_data"], "calibrated_sensor_token"):
                mount = self._by_token["calibrated_sensor"][row["calibrated_sensor_token"]]
                channels[self._by_token["sensor"][mount["sensor_token"]]["channel"]].append(row)
            lidars = {channel: self._chain(sweeps) for channel, sweeps in channels.items() if sweeps}
            return _times(samples), lidars, self._annotations(rows["sample_annotation"])

    def cameras(self, name: str) -> dict[str, CameraChain]:
        """Read the cameras of a scene, by channel. The tables of images are read when this is first called."""
        with file_errors(f"{self.folder}, {name}", _COPY):
            if self._images is None:
                self._images = self._load_images()
            channels: dict[str, list[Row]] = defaultdict(list)
            for row in self._ordered("sample_data", self._images[self.scenes[name]], "calibrated_sensor_token"):
                sensor = row["mount"]["sensor_token"]
                channels[self._by_token["sensor"][sensor]["channel"]].append(row)
            return {channel: self._camera_chain(rows) for channel, rows in sorted(channels.items())}

    def _load_images(self) -> dict[str, list[Row]]:
        """Return the rows of images of each scene, each with the rows of its mount and its ego pose."""
        if not self._rows:
            self._load()
        cameras = [token for token, row in self._by_token["sensor"].items() if row["modality"] == "camera"]
        rows = read_table(self.folder, "calibrated_sensor", "sensor_token", cameras, ("camera_intrinsic",))
        mounts = {row["token"]: row for row in rows}
        images = read_table(self.folder, "sample_data", "calibrated_sensor_token", mounts, ("width", "height"))
        poses = read_table(self.folder, "ego_pose", "token", {row["ego_pose_token"] for row in images})
        pose_of = {row["token"]: row for row in poses}
        grouped: dict[str, list[Row]] = defaultdict(list)
        for row in images:
            row["mount"] = mounts[row["calibrated_sensor_token"]]
            row["ego"] = pose_of[row["ego_pose_token"]]
            grouped[self._by_token["sample"][row["sample_token"]]["scene_token"]].append(row)
        return grouped

    def _camera_chain(self, rows: Sequence[Row]) -> CameraChain:
        return CameraChain(
            times=_times(rows),
            files=tuple(row["filename"] for row in rows),
            sizes=np.array([(row["width"], row["height"]) for row in rows], dtype=np.int64),
            ego=self._poses("ego_pose", [row["ego"] for row in rows]),
            mount=self._poses("calibrated_sensor", [row["mount"] for row in rows]),
            matrix=np.array([row["mount"]["camera_intrinsic"] for row in rows], dtype=np.float64).reshape(-1, 3, 3),
        )

    def _load(self) -> None:
        by_token = self._by_token
        for table in ("sensor", "category", "instance", "sample"):
            by_token[table] = {row["token"]: row for row in read_table(self.folder, table)}
        lidars = [token for token, row in by_token["sensor"].items() if row["modality"] == "lidar"]
        mounts = read_table(self.folder, "calibrated_sensor", "sensor_token", lidars)
        by_token["calibrated_sensor"] = {row["token"]: row for row in mounts}
        sweeps = read_table(self.folder, "sample_data", "calibrated_sensor_token", by_token["calibrated_sensor"])
        poses = read_table(self.folder, "ego_pose", "token", {row["ego_pose_token"] for row in sweeps})
        by_token["ego_pose"] = {row["token"]: row for row in poses}
        rows = {"sample_data": sweeps, "sample_annotation": read_table(self.folder, "sample_annotation")}
        for table, content in (*rows.items(), ("sample", list(by_token["sample"].values()))):
            grouped: dict[str, list[Row]] = defaultdict(list)
            for row in content:
                sample = row if table == "sample" else by_token["sample"][row["sample_token"]]
                grouped[sample["scene_token"]].append(row)
            self._rows[table] = grouped

    def _ordered(self, table: str, rows: Sequence[Row], key: str = "scene_token") -> list[Row]:
        """Sort rows by time. Two rows with the same time and `key` are an error."""
        if len({(row["timestamp"], row[key]) for row in rows}) < len(rows):
            raise CFlowError(f"{self.folder / table}.json has two rows of one {key} and one time; {_COPY}")
        return sorted(rows, key=lambda row: row["timestamp"])

    def _chain(self, rows: Sequence[Row]) -> LidarChain:
        mounts = [self._by_token["calibrated_sensor"][row["calibrated_sensor_token"]] for row in rows]
        return LidarChain(
            times=_times(rows),
            is_key_frame=np.array([row["is_key_frame"] for row in rows], dtype=bool),
            files=tuple(row["filename"] for row in rows),
            ego=self._poses("ego_pose", [self._by_token["ego_pose"][row["ego_pose_token"]] for row in rows]),
            mount=self._poses("calibrated_sensor", mounts),
            samples=tuple(row["sample_token"] for row in rows),
        )

    def _annotations(self, rows: Sequence[Row]) -> Annotations:
        instances = [self._by_token["instance"][row["instance_token"]] for row in rows]
        width_length_height = np.array([row["size"] for row in rows], dtype=np.float64).reshape(-1, 3)
        return Annotations(
            time=_times([self._by_token["sample"][row["sample_token"]] for row in rows]),
            track=[row["instance_token"] for row in rows],
            category=[self._by_token["category"][row["category_token"]]["name"] for row in instances],
            size=width_length_height[:, [1, 0, 2]],
            pose=self._poses("sample_annotation", rows),
        )

    def _poses(self, table: str, rows: Sequence[Row]) -> np.ndarray:
        """Return (K, 4, 4) float64."""
        translation, rotation = ([row[key] for row in rows] for key in ("translation", "rotation"))
        return poses_from_quaternions(translation, rotation, lambda _: f"{self.folder / table}.json: a pose")


def _times(rows: Sequence[Row]) -> np.ndarray:
    """Return (K,) int64, microseconds."""
    return np.array([row["timestamp"] for row in rows], dtype=np.int64)


class Tracks:
    """The boxes of a scene at any time from its first to its last sample, interpolated between samples.

    `sample_times` are (S,), microseconds, ascending. The attributes `start` and `end` are the first and the last one;
    without boxes, `end` is before `start`.
    """

    def __init__(self, sample_times: np.ndarray, annotations: Annotations) -> None:
        self._times = sample_times
        self._annotations = annotations
        has_boxes = len(annotations.time) > 0
        self.start = int(sample_times[0]) if has_boxes else 0
        self.end = int(sample_times[-1]) if has_boxes else -1
        self._rows: list[dict[str, int]] = [{} for _ in sample_times]  # per sample: track -> row
        for row, sample in enumerate(np.searchsorted(sample_times, annotations.time)):
            self._rows[int(sample)][annotations.track[row]] = row

    def at(self, time: int) -> tuple[Annotations, np.ndarray]:
        """Return the K boxes at a time, and whether each is known, (K,) bool; K is 0 outside the annotated time.

        A box is a guess, not known, if only one of the two samples around the time has the object. Guesses come first.

        Convention: at a sample, we return its own boxes. Between two samples the centre and the size change linearly,
            and the rotation at a constant rate. If only one of the two samples has an object, we extrapolate the motion
            between that sample and its other neighbour. If the neighbour lacks the object, too, the box does not move.
        """
        if not self.start <= time <= self.end:
            return self._boxes(time, [])
        times = self._times
        left = int(np.searchsorted(times, time, side="right")) - 1
        rows = dict(enumerate(self._rows))
        if times[left] == time:
            return self._boxes(time, [_Between(row, row, 0.0, True) for row in rows[left].values()])
        between = []
        for track, row in {**rows[left], **rows[left + 1], **rows[left]}.items():  # tracks of `left` come first
            both = [k for k in (left, left - 1, left + 1) if track in rows.get(k, ()) and track in rows.get(k + 1, ())]
            start = both[0] if both else None
            if start is None:
                between.append(_Between(row, row, 0.0, False))
            else:
                fraction = float((time - times[start]) / (times[start + 1] - times[start]))
                between.append(_Between(rows[start][track], rows[start + 1][track], fraction, start == left))
        return self._boxes(time, sorted(between, key=lambda box: box.is_known))

    def _boxes(self, time: int, between: list[_Between]) -> tuple[Annotations, np.ndarray]:
        """Interpolate the boxes, and tell which of them are known, (K,) bool."""
        table = self._annotations
        before = [box.before for box in between]
        after = [box.after for box in between]
        fraction = np.array([box.fraction for box in between], dtype=np.float64)
        boxes = Annotations(
            time=np.full(len(between), time),
            track=[table.track[row] for row in before],
            category=[table.category[row] for row in before],
            size=table.size[before] + np.clip(fraction, 0, 1)[:, None] * (table.size[after] - table.size[before]),
            pose=interpolate_poses(table.pose[before], table.pose[after], fraction),
        )
        return boxes, np.array([box.is_known for box in between], dtype=bool)


class _Between(NamedTuple):
    """A box at a time, from two rows of its track."""

    before: int  # row
    after: int  # row
    fraction: float  # of the time from `before` to `after`; below 0 or above 1 = extrapolated
    is_known: bool  # both samples around the time have the object
