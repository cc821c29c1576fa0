"""The tables of nuScenes and of MAN TruckScenes: JSON lists of flat rows that name each other by tokens."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Collection, Dict, List, Mapping, Optional, Sequence, Tuple

import numpy as np

from cflow_torch.data.folders import find_folders
from cflow_torch.data.json_file import shown
from cflow_torch.data.names import safe_name
from cflow_torch.data.nuscenes.json_tables import Row, read_table
from cflow_torch.data.paths import Place, as_path
from cflow_torch.types import CFlowError

QUATERNION_TOLERANCE = 1e-3  # a quaternion is a rotation only if its length is 1; stored values are within 1e-6
SEARCH_DEPTH = 3  # levels of folders below the one that is searched, to one that holds a scene.json
_SENSOR_FOLDERS = ("samples", "sweeps", "maps")  # lie beside the tables and hold very many files
_COPY = "copy the tables again"


@dataclass(frozen=True)
class SceneSource:
    """Where a scene is.

    Args:
        root: data root, which `sample_data.filename` is relative to.
        version: folder of the tables, for example "v1.0-mini".
        scene: name of the scene.
        tables: the tables of that version, shared by its scenes so that they are read once; None = read them anew.
    """

    root: Path
    version: str
    scene: str
    tables: Optional[Tables] = field(default=None, repr=False, compare=False)

    @property
    def name(self) -> str:
        """Name of the scene."""
        return self.scene


@dataclass(frozen=True)
class LidarChain:
    """The M sweeps of one LiDAR in one scene, in the order of time.

    Args:
        times: (M,) int64, microseconds.
        is_key_frame: (M,) bool.
        files: relative to the data root.
        ego: (M, 7) float64 `T_world_ego` at each sweep's own time: translation, quaternion (scalar first).
        mount: (M, 7) float64 `T_ego_sensor`, the same way.
    """

    times: np.ndarray
    is_key_frame: np.ndarray
    files: Tuple[str, ...]
    ego: np.ndarray
    mount: np.ndarray


@dataclass(frozen=True)
class Annotations:
    """The A boxes of one scene, at its samples.

    Args:
        time: (A,) int64, microseconds.
        track, category: A instance tokens, A names of the data set.
        size: (A, 3) float64, metres: length, width, height.
        pose: (A, 7) float64 `T_world_box`: translation, quaternion (scalar first).
    """

    time: np.ndarray
    track: Sequence[str]
    category: Sequence[str]
    size: np.ndarray
    pose: np.ndarray


@dataclass(frozen=True)
class SceneTables:
    """One scene: sample times (ascending int64, microseconds), LiDARs by channel in the order of sensor.json, boxes."""

    sample_times: np.ndarray
    lidars: Mapping[str, LidarChain]
    annotations: Annotations


def find_scenes(root: Place, foreign: Collection[str], data_set: str) -> List[SceneSource]:
    """The scenes of all versions under a folder, by folder and name.

    Args:
        root: folder of the tables, data root, or up to two levels above data roots.
        foreign: tables of the related data set; a version that has one of them is not this data set.
        data_set: its name.

    Raises:
        CFlowError: `root` is no folder, a scene.json cannot be read, or all that is there is of the other data set.
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
        found += [SceneSource(version.parent, version.name, name, tables) for name in tables.scene_names()]
    return found


class Tables:
    """The tables of one version.

    Args:
        folder: `<data root>/<version>`.

    Convention: nothing is read before it is asked for, each table once. Only rows of LiDARs are kept.

    Cost: about 5 s per million rows (measured on one core); rows of cameras and radars are dropped while reading.
    """

    def __init__(self, folder: Place) -> None:
        self.folder = as_path(folder)
        self._rows: Dict[str, Dict[str, List[Row]]] = {}  # table -> token of the scene -> its rows
        self._by_token: Dict[str, Dict[str, Row]] = {}
        self._scenes: Optional[Dict[str, str]] = None  # name -> token

    def scene_names(self) -> List[str]:
        """Sorted names.

        Raises:
            CFlowError: scene.json cannot be read, has two scenes of one name, or a name that no folder can have.
        """
        if self._scenes is None:
            rows, file = read_table(self.folder, "scene"), self.folder / "scene.json"
            scenes = {safe_name(row["name"], f"{file}: the scene"): row["token"] for row in rows}
            if len(scenes) < len(rows):
                raise CFlowError(f"{file} has {len(rows)} scenes, but {len(scenes)} names; {_COPY}")
            self._scenes = scenes
        return sorted(self._scenes)

    def scene(self, name: str) -> SceneTables:
        """All rows of a scene, linked and checked.

        Raises:
            CFlowError: no such scene; a table that is missing, truncated, or no table of this format; a row that names
                another one which does not exist; sweeps that are no chain.
        """
        names = self.scene_names()
        if name not in names or self._scenes is None:
            raise CFlowError(f"{self.folder / 'scene.json'} has no scene {name!r}; it has {names[:5]} ...")
        if not self._rows:
            self._load()
        token = self._scenes[name]
        samples = sorted(row["timestamp"] for row in self._rows["sample"].get(token, []))
        if len(set(samples)) < len(samples):
            raise CFlowError(f"{self.folder / 'sample.json'} has two samples of {name} at one time; {_COPY}")
        sweeps: Dict[str, List[Row]] = defaultdict(list)
        for row in self._rows["sample_data"].get(token, []):
            mount = self._by_token["calibrated_sensor"][row["calibrated_sensor_token"]]
            sweeps[self._by_token["sensor"][mount["sensor_token"]]["channel"]].append(row)
        channels = [row["channel"] for row in self._by_token["sensor"].values() if row["channel"] in sweeps]
        return SceneTables(
            sample_times=np.array(samples, dtype=np.int64),
            lidars={channel: self._chain(f"{name}, {channel}", sweeps[channel]) for channel in channels},
            annotations=self._annotations(self._rows["sample_annotation"].get(token, [])),
        )

    def _load(self) -> None:
        by_token = self._by_token
        for table in ("sensor", "calibrated_sensor", "category", "instance", "sample"):
            by_token[table] = {row["token"]: row for row in read_table(self.folder, table)}
        lidars = {token for token, row in by_token["sensor"].items() if row["modality"] == "lidar"}
        mounts = by_token["calibrated_sensor"]
        mounts = {token: row for token, row in mounts.items() if row["sensor_token"] in lidars}
        by_token["calibrated_sensor"] = mounts
        sweeps = read_table(self.folder, "sample_data", "calibrated_sensor_token", mounts)
        poses = read_table(self.folder, "ego_pose", "token", {row["ego_pose_token"] for row in sweeps})
        by_token["ego_pose"] = {row["token"]: row for row in poses}
        rows = {"sample": list(by_token["sample"].values()), "sample_data": sweeps}
        rows["sample_annotation"] = read_table(self.folder, "sample_annotation")
        for table, content in rows.items():
            grouped: Dict[str, List[Row]] = defaultdict(list)
            for row in content:
                sample = row if table == "sample" else self._linked(table, row, "sample_token", "sample")
                grouped[sample["scene_token"]].append(row)
            self._rows[table] = grouped

    def _chain(self, name: str, rows: Sequence[Row]) -> LidarChain:
        """Sweeps from the row without `prev` along `next`. There may be several such chains, one after the other."""
        file = self.folder / "sample_data.json"
        by_token = {row["token"]: row for row in rows}
        chained: List[Row] = []
        for start in sorted((row for row in rows if not row["prev"]), key=lambda row: row["timestamp"]):
            token = start["token"]
            while token and len(chained) <= len(rows):
                if token not in by_token:
                    raise CFlowError(
                        f"{file}: {name}: a sweep's next is {token[:80]}, which is no sweep of it; {_COPY}"
                    )
                chained.append(by_token[token])
                token = by_token[token]["next"]
        times = np.array([row["timestamp"] for row in chained], dtype=np.int64)
        if len(chained) != len(rows) or (np.diff(times) <= 0).any():
            raise CFlowError(f"{file}: {name}: prev and next do not chain its sweeps in the order of time; {_COPY}")
        link, mounts = self._linked, self._by_token["calibrated_sensor"]
        return LidarChain(
            times=times,
            is_key_frame=np.array([row["is_key_frame"] for row in chained], dtype=bool),
            files=tuple(row["filename"] for row in chained),
            ego=self._poses("ego_pose", [link("sample_data", row, "ego_pose_token", "ego_pose") for row in chained]),
            mount=self._poses("calibrated_sensor", [mounts[row["calibrated_sensor_token"]] for row in chained]),
        )

    def _annotations(self, rows: Sequence[Row]) -> Annotations:
        names, times = [], []
        for row in rows:
            instance = self._linked("sample_annotation", row, "instance_token", "instance")
            names.append(self._linked("instance", instance, "category_token", "category")["name"])
            times.append(self._by_token["sample"][row["sample_token"]]["timestamp"])
        width_length_height = np.array([row["size"] for row in rows], dtype=np.float64).reshape(-1, 3)
        return Annotations(
            time=np.array(times, dtype=np.int64),
            track=[row["instance_token"] for row in rows],
            category=names,
            size=width_length_height[:, [1, 0, 2]],
            pose=self._poses("sample_annotation", rows),
        )

    def _linked(self, table: str, row: Row, key: str, target: str) -> Row:
        linked = self._by_token[target].get(row[key])
        if linked is None:
            raise CFlowError(
                f"{self.folder / table}.json names {target} {shown(row[key])}, which {target}.json does not have; "
                f"{_COPY}"
            )
        return linked

    def _poses(self, table: str, rows: Sequence[Row]) -> np.ndarray:
        """(K, 7) float64, quaternions of length 1."""
        poses = np.array([[*row["translation"], *row["rotation"]] for row in rows], dtype=np.float64).reshape(-1, 7)
        length = np.linalg.norm(poses[:, 3:], axis=1)
        for bad in np.flatnonzero(~np.isfinite(poses).all(1) | ~(np.abs(length - 1) <= QUATERNION_TOLERANCE)):
            raise CFlowError(
                f"{self.folder / table}.json: {poses[bad].tolist()} is no rigid motion: translation and rotation must "
                f"be finite, the rotation a quaternion w, x, y, z of length 1; {_COPY}"
            )
        poses[:, 3:] /= length[:, None]
        return poses
