"""The tables of nuScenes and of MAN TruckScenes: JSON lists of flat rows that refer to each other by tokens."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Collection, Dict, Mapping, NamedTuple, Sequence

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
_CAMERA_FIELDS = {"calibrated_sensor": ("camera_intrinsic",), "sample_data": ("width", "height")}


@dataclass(frozen=True)
class SceneSource:
    """The location of a scene."""

    root: Path  # data root, to which `sample_data.filename` is relative
    version: str  # folder of the tables, for example "v1.0-mini"
    name: str  # name of the scene
    # The tables of `version`. Scenes share them, so they are read once; None = read them again.
    tables: Tables | None = field(default=None, repr=False, compare=False)


class Chain(NamedTuple):
    """The M sweeps of one LiDAR, or images of one camera, in one scene, ordered by time."""

    times: np.ndarray  # (M,) int64, microseconds
    is_key_frame: np.ndarray  # (M,) bool
    files: tuple[str, ...]  # relative to the data root
    ego: np.ndarray  # (M, 4, 4) float64 `T_world_ego` at each one's own time
    mount: np.ndarray  # (M, 4, 4) float64 `T_ego_sensor`
    samples: tuple[str, ...]  # token of the sample that each belongs to
    sizes: np.ndarray  # (M, 2) int64 width and height of images, pixels; 0 for LiDARs
    matrix: np.ndarray  # (M, 3, 3) float64 intrinsic matrices of a camera; (0, 3, 3) for LiDARs


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
    is_version, is_passed = (
        (lambda folder: (folder / "scene.json").is_file()),
        (lambda c: c.name not in _SENSOR_FOLDERS),
    )
    versions = find_folders(as_path(root), is_version, SEARCH_DEPTH, what, is_passed=is_passed)
    alien = [v for v in versions if any((v / f"{table}.json").exists() for table in foreign)]
    if alien and len(alien) == len(versions):
        raise CFlowError(f"{alien[0]} is not {data_set}: it has one of {sorted(foreign)}; choose the other reader")
    found = []
    for version in sorted(set(versions) - set(alien)):
        tables = Tables(version)
        found += [SceneSource(version.parent, version.name, name, tables) for name in sorted(tables.scenes)]
    return found


def read_json_table(
    folder: Path, table: str, key: str = "", values: Collection[str] = (), more: Mapping[str, Sequence[str]] = {}
) -> list[Row]:
    """Read the rows of a table with the fields of `FIELDS`, and `more` of some tables.

    With a `key`, we read only rows whose `key` is one of `values`.

    Cost: memory of twice the file, and of the rows that are kept.
    """
    file = folder / f"{table}.json"

    def use(row: Row) -> Row | None:  # called while parsing, so dropped rows and fields need no memory
        if key and row[key] not in values:
            return None
        return {name: row[name] for name in (*FIELDS[table], *more.get(table, ()))}

    with file_errors(file, "copy all tables of the version"):
        rows = read_json(file, use)
        if not isinstance(rows, list) or not all(row is None or type(row) is dict for row in rows):
            raise ValueError("it is not a list of rows")
        return [row for row in rows if row is not None]


class _Measured(NamedTuple):
    """What all sensors of one modality measured."""

    rows: dict[str, list[Row]]  # token of the scene -> rows of sample_data
    mounts: dict[str, Row]
    poses: dict[str, Row]


class Tables:
    """The tables of one version, `<data root>/<version>`. We read each once, when it is first needed.

    Cost: about 5 s per million rows (measured on one core). We drop rows of other modalities while we read.
    """

    def __init__(self, folder: PathLike) -> None:
        self.folder = as_path(folder)
        self._measured: dict[str, _Measured] = {}

    @cached_property
    def scenes(self) -> dict[str, str]:
        """Name of each scene -> its token."""
        rows = read_json_table(self.folder, "scene")
        file = self.folder / "scene.json"
        scenes = {safe_name(row["name"], f"{file}: the scene"): row["token"] for row in rows}
        if len(scenes) < len(rows):
            raise CFlowError(f"{file} has {len(rows)} scenes but {len(scenes)} names; {_COPY}")
        return scenes

    def scene(self, name: str) -> tuple[np.ndarray, Annotations]:
        """Return the times of the samples of a scene, ascending int64 microseconds, and its boxes.

        If a row refers to a missing one, or two samples have the same time, that is a `CFlowError`.
        """
        with file_errors(f"{self.folder}, {name}", _COPY):
            token = self.scenes[name]
            samples = [row for row in self._by_token["sample"].values() if row["scene_token"] == token]
            return _times(self._ordered("sample", samples)), self._annotations(self._boxes_of_scene[token])

    def chains(self, name: str, modality: str) -> dict[str, Chain]:
        """Return what the sensors of a modality, "lidar" or "camera", measured in a scene, as in sensor.json.

        If a row refers to a missing one, or two rows of a sensor have the same time, that is a `CFlowError`.
        """
        with file_errors(f"{self.folder}, {name}", _COPY):
            if modality not in self._measured:
                self._measured[modality] = self._read_measured(modality)
            rows, mounts, poses = self._measured[modality]
            sensors = self._by_token["sensor"]
            channels: dict[str, list[Row]] = {row["channel"]: [] for row in sensors.values()}
            for row in self._ordered("sample_data", rows[self.scenes[name]], "calibrated_sensor_token"):
                sensor = mounts[row["calibrated_sensor_token"]]["sensor_token"]
                channels[sensors[sensor]["channel"]].append(row)
            return {channel: self._chain(of_one, mounts, poses) for channel, of_one in channels.items() if of_one}

    @cached_property
    def _by_token(self) -> dict[str, dict[str, Row]]:
        tables = ("sensor", "category", "instance", "sample")
        return {table: _by_token(read_json_table(self.folder, table)) for table in tables}

    @cached_property
    def _boxes_of_scene(self) -> dict[str, list[Row]]:
        return self._by_scene(read_json_table(self.folder, "sample_annotation"))

    def _by_scene(self, rows: Sequence[Row]) -> dict[str, list[Row]]:
        grouped: dict[str, list[Row]] = defaultdict(list)
        for row in rows:
            grouped[self._by_token["sample"][row["sample_token"]]["scene_token"]].append(row)
        return grouped

    def _read_measured(self, modality: str) -> _Measured:
        sensors = [token for token, row in self._by_token["sensor"].items() if row["modality"] == modality]
        more = _CAMERA_FIELDS if modality == "camera" else {}
        read = partial(read_json_table, self.folder, more=more)
        mounts = _by_token(read("calibrated_sensor", "sensor_token", sensors))
        rows = read("sample_data", "calibrated_sensor_token", mounts)
        poses = _by_token(read("ego_pose", "token", {row["ego_pose_token"] for row in rows}))
        return _Measured(self._by_scene(rows), mounts, poses)

    def _ordered(self, table: str, rows: Sequence[Row], key: str = "scene_token") -> list[Row]:
        """Sort rows by time. Two rows with the same time and `key` are an error."""
        if len({(row["timestamp"], row[key]) for row in rows}) < len(rows):
            raise CFlowError(f"{self.folder / table}.json has two rows of one {key} and one time; {_COPY}")
        return sorted(rows, key=lambda row: row["timestamp"])

    def _chain(self, rows: Sequence[Row], mounts: Mapping[str, Row], poses: Mapping[str, Row]) -> Chain:
        of_rows = [mounts[row["calibrated_sensor_token"]] for row in rows]
        matrices = [mount["camera_intrinsic"] for mount in of_rows if "camera_intrinsic" in mount]
        return Chain(
            times=_times(rows),
            is_key_frame=np.array([row["is_key_frame"] for row in rows], dtype=bool),
            files=tuple(row["filename"] for row in rows),
            ego=self._poses("ego_pose", [poses[row["ego_pose_token"]] for row in rows]),
            mount=self._poses("calibrated_sensor", of_rows),
            samples=tuple(row["sample_token"] for row in rows),
            sizes=np.array([(row.get("width", 0), row.get("height", 0)) for row in rows], dtype=np.int64),
            matrix=np.array(matrices, dtype=np.float64).reshape(-1, 3, 3),
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


def _by_token(rows: Sequence[Row]) -> dict[str, Row]:
    return {row["token"]: row for row in rows}


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
