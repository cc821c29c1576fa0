"""Score the boxes of tracks against true boxes of moving objects. docs/applications.md explains the columns.

python scripts/benchmarks/boxes.py --pandaset DATA/002                     sequences with cuboids in every sweep
python scripts/benchmarks/boxes.py --scene DATA/panda-002-c.h5 DATA/002    an HDF5 scene, cuboids of some of its sweeps
python scripts/benchmarks/boxes.py --kitti DATA/kitti-0000-c2.h5 KITTI 127   an HDF5 scene from sweep 127 of tracking
                                                           sequence 0000; KITTI has label_02/0000.txt and calib/0000.txt
python scripts/benchmarks/boxes.py --simulated av2 waymo                   a street and a crossing each

The simulated drives have the seeds 300 and 301. We chose settings on PandaSet 002, sweeps 72-79, and on simulated
drives of the seeds 320, 321, 400 and 401. An object is scored in a sweep if it moves at 0.5 m/s or more, has at least
20 points, and is within 50 m. Its box is the box of the sweep with the largest intersection over union (IoU), seen
from above.

AP is the average precision of moving boxes, by the mean confidence of their tracks: a box is right if its IoU with an
object that is scored, and has no better box, is above the threshold. Boxes on objects that move without being scored
are left out.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, Dict, NamedTuple

import numpy as np
import torch
from labelled import SENSORS, LabelledLog, SimulatedLog, true_residual
from table import markdown

from cflow_torch import VerifiedFlow, make_config, make_model
from cflow_torch.applications.track_table import score_of
from cflow_torch.applications.tracking import track
from cflow_torch.data.boxes import Boxes
from cflow_torch.data.catalog import GroundSegmentedLog
from cflow_torch.data.categories import CATEGORIES
from cflow_torch.data.log import Log, windows
from cflow_torch.data.pandaset import _POSITION, _SIZE, PandaSetLog, _columns

DRIVES = ((300, "street"), (301, "crossing"))
LEAST_SPEED = 0.1  # m/s; slower objects are static
SPEED, POINTS, RANGE = 0.5, 20, 50.0  # m/s, points and metres: least speed and points, most distance of a scored object
THRESHOLDS = (0.4, 0.7)  # of IoU
LIDAR = 0  # Pandar64
_CLASSES = {
    "pedestrian": ("PEDESTRIAN", "STROLLER", "OFFICIAL_SIGNALER"),
    "cyclist": ("BICYCLE", "BICYCLIST", "MOTORCYCLE", "MOTORCYCLIST", "WHEELED_DEVICE", "WHEELED_RIDER"),
    "truck": ("BUS", "BOX_TRUCK", "TRUCK", "TRUCK_CAB", "LARGE_VEHICLE", "VEHICULAR_TRAILER", "ARTICULATED_BUS"),
}
CLASS_OF = {name: kind for kind, names in _CLASSES.items() for name in names}
_KITTI = {"Pedestrian": "PEDESTRIAN", "Person": "PEDESTRIAN", "Cyclist": "BICYCLIST", "Truck": "TRUCK"}
_SHAKING = 10  # sweeps over which we take the velocities of KITTI's boxes
_IMAGE = (1242, 375)  # pixels, width and height of KITTI's camera 2
Row = Dict[str, Any]


class TrueBoxes(NamedTuple):
    """The K objects of one sweep that move, in the world."""

    name: list[str]
    kind: list[str]  # pedestrian, cyclist, car, truck
    size: np.ndarray  # (K, 3) metres
    pose: np.ndarray  # (K, 4, 4) `T_world_box`
    velocity: np.ndarray  # (K, 3) m/s
    is_scored: np.ndarray  # (K,) bool; False = too slow, too few points or too far

    @property
    def heading(self) -> np.ndarray:
        return np.arctan2(self.pose[:, 1, 0], self.pose[:, 0, 0])

    def corners(self, row: int) -> np.ndarray:
        return corners(*self.pose[row, :2, 3], *self.size[row, :2], self.heading[row])


def moving(
    boxes: Boxes, pose: np.ndarray, later: dict[str, np.ndarray], seconds: float, points: np.ndarray
) -> TrueBoxes:
    """Keep the boxes that move.

    Args:
        boxes: of a sweep, in its ego frame.
        pose: (4, 4) `T_world_ego`.
        later: track -> `T_world_box` in the next sweep.
        seconds: to the next sweep.
        points: (N, 3) in the ego frame, without ground.
    """
    poses = pose @ boxes.pose
    rows, velocities, is_scored = [], [], []
    for row, name in enumerate(boxes.track_id):
        if name not in later:
            continue
        velocity = (later[name][:3, 3] - poses[row, :3, 3]) / seconds
        local = (points - boxes.pose[row, :3, 3]) @ boxes.pose[row, :3, :3]
        num_points = (np.abs(local) <= boxes.size[row] / 2 + 0.1).all(1).sum()
        is_near = np.hypot(*boxes.pose[row, :2, 3]) <= RANGE
        if np.linalg.norm(velocity) >= LEAST_SPEED:
            rows.append(row)
            velocities.append(velocity)
            is_scored.append(np.linalg.norm(velocity) >= SPEED and num_points >= POINTS and is_near)
    names = [boxes.names[row] for row in rows]
    kinds = [CLASS_OF.get(name, "car") for name in names]
    ids = [boxes.track_id[row] for row in rows]
    return TrueBoxes(
        ids, kinds, boxes.size[rows], poses[rows], np.reshape(velocities, (-1, 3)), np.array(is_scored, bool)
    )


class SimulatedBoxes(SimulatedLog):
    """A simulated drive with the bodies as true boxes."""

    def true_boxes(self, index: int) -> TrueBoxes:
        now, later = (self._boxes(k) for k in (index, index + 1))
        sweep, after = self.sweep(index), self.sweep(index + 1)
        poses = dict(zip(later.track_id, after.pose @ later.pose))
        seconds = (self.timestamps[index + 1] - self.timestamps[index]) * 1e-9
        is_ground = self.drive.sweep(index * self.step).is_ground
        truth = moving(now, sweep.pose, poses, seconds, sweep.points[~is_ground])
        if sweep.point_times is not None:
            truth.pose[:, :3, 3] += truth.velocity * self._mean_times(index, truth.name)[:, None]
        return truth

    def _mean_times(self, index: int, names: list[str]) -> np.ndarray:
        """Seconds from the stamp of the sweep to the mean time of the points of each object."""
        returns = self.drive.returns(index * self.step)
        body = np.append(self.drive.scene.body_of_solid, -1)[returns.solid.numpy()]
        times = returns.offset_ns.numpy() * 1e-9
        bodies = [body == self.drive.track_ids.index(name) for name in names]
        return np.array([times[each].mean() if each.any() else 0.0 for each in bodies])

    def _boxes(self, index: int) -> Boxes:
        boxes = self.drive.boxes(index * self.step)
        row = {name: number for number, name in enumerate(self.drive.track_ids)}
        size = np.array([self.drive.scene.bodies[row[name]].size for name in boxes.track_id]).reshape(-1, 3)
        return Boxes(boxes.track_id, boxes.category, size, boxes.pose)


class PandaSetBoxes(PandaSetLog):
    """A PandaSet sequence with its cuboids for the Pandar64."""

    def true_boxes(self, index: int) -> TrueBoxes:
        now, later = (self.cuboids(k) for k in (index, index + 1))
        sweep = self.sweep(index)
        poses = dict(zip(later.track_id, self._poses[index + 1] @ later.pose))
        seconds = (self.timestamps[index + 1] - self.timestamps[index]) * 1e-9
        points = sweep.points if sweep.is_ground is None else sweep.points[~sweep.is_ground]
        return moving(now, self._poses[index], poses, seconds, points)

    def cuboids(self, index: int) -> Boxes:
        """Cuboids of a sweep in its ego frame."""
        file = self.folder / "annotations" / "cuboids" / self._files[index].name
        columns = _columns(file, ("uuid", "label", "yaw", "cuboids.sensor_id", *_POSITION, *_SIZE))
        return self._boxes(columns, file, index, LIDAR)


class SceneBoxes(LabelledLog):
    """An HDF5 scene of PandaSet. Cuboids of its first sweeps come from the raw sequence; labels move them further."""

    def __init__(self, scene: Path, sequence: Path) -> None:
        super().__init__(scene)
        raw = PandaSetBoxes(sequence)
        self._known: list[Any] = []
        for index in range(len(self.timestamps)):
            pose = self.sweep(index).pose
            if index < len(raw.timestamps):
                boxes = raw.cuboids(index)
                world = raw._poses[index] @ boxes.pose
            else:
                boxes = self._known[-1]
                world = self._moved(index - 1)
            self._known.append(Boxes(boxes.track_id, boxes.category, boxes.size, np.linalg.inv(pose) @ world))

    def _moved(self, index: int) -> np.ndarray:
        """Move the boxes of a sweep by the labels of the points inside; (K, 4, 4) `T_world_box` in the next sweep.

        A moving object with few points goes on as before.
        """
        boxes, sweep, after = self._known[index], self.sweep(index), self.sweep(index + 1)
        residual, labels = true_residual(self, index), self.labels(index)
        before = dict(zip(self._known[index - 1].track_id, self.sweep(index - 1).pose @ self._known[index - 1].pose))
        least = SPEED * (self.timestamps[index] - self.timestamps[index - 1]) * 1e-9
        world = sweep.pose @ boxes.pose
        for row, pose in enumerate(boxes.pose):
            local = (sweep.points[:, :3] - pose[:3, 3]) @ pose[:3, :3]
            inside = (
                (np.abs(local) <= boxes.size[row] / 2).all(1) & labels.is_valid & (np.linalg.norm(residual, axis=1) > 0)
            )
            if inside.sum() >= POINTS // 2:
                start = sweep.points[inside, :3].astype(np.float64) @ sweep.pose[:3, :3].T + sweep.pose[:3, 3]
                end = start + residual[inside] @ after.pose[:3, :3].T
                world[row] = fit(start, end) @ world[row]
            elif boxes.track_id[row] in before:
                step = world[row, :3, 3] - before[boxes.track_id[row]][:3, 3]
                world[row, :3, 3] += step if np.linalg.norm(step) >= least else 0
        return world

    def true_boxes(self, index: int) -> TrueBoxes:
        sweep = self.sweep(index)
        later = self._known[index + 1]
        poses = dict(zip(later.track_id, self.sweep(index + 1).pose @ later.pose))
        seconds = (self.timestamps[index + 1] - self.timestamps[index]) * 1e-9
        points = sweep.points[~sweep.is_ground]
        return moving(self._known[index], sweep.pose, poses, seconds, points[:, :3])


class KITTIBoxes(LabelledLog):
    """A part of KITTI's tracking sequence 0000 in HDF5, with its boxes, from `first` of the sequence.

    KITTI labels what is in the image of camera 2. Its boxes shake, so we take velocities over a second.
    """

    def __init__(self, scene: Path, folder: Path, first: int) -> None:
        super().__init__(scene)
        lines = (line.split() for line in (folder / "calib" / "0000.txt").read_text().splitlines())
        calibration = {line[0].rstrip(":"): np.array(line[1:], float) for line in lines if line}
        rectify = np.eye(4)
        rectify[:3, :3] = calibration["R0_rect"].reshape(3, 3)
        to_camera = np.vstack([calibration["Tr_velo_to_cam"].reshape(3, 4), [0, 0, 0, 1]])
        T_camera_ego = rectify @ to_camera
        self._projection = calibration["P2"].reshape(3, 4) @ T_camera_ego
        self._tracks: dict[str, dict[int, np.ndarray]] = {}  # track -> sweep -> (4, 4) T_world_box
        self._kinds: dict[str, tuple[int, np.ndarray]] = {}  # track -> category and size
        for line in (folder / "label_02" / "0000.txt").read_text().splitlines():
            frame, name, kind, *values = line.split()
            index = int(frame) - first
            if kind != "DontCare" and 0 <= index < len(self.timestamps):
                height, width, length, x, y, z, turn = map(float, values[7:14])
                middle = np.linalg.inv(T_camera_ego) @ [x, y - height / 2, z, 1]
                pose = np.eye(4)
                heading = -turn - np.pi / 2
                pose[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
                pose[:3, 3] = middle[:3]
                self._tracks.setdefault(name, {})[index] = self.sweep(index).pose @ pose
                category = _KITTI.get(kind, "REGULAR_VEHICLE")
                self._kinds[name] = CATEGORIES.index(category), np.array([length, width, height])

    def true_boxes(self, index: int) -> TrueBoxes:
        sweep = self.sweep(index)
        names = [name for name, track in self._tracks.items() if index in track]
        later = {}
        for name in names:
            near = [each for each in self._tracks[name] if abs(each - index) <= _SHAKING // 2]
            if len(near) > _SHAKING // 2:
                first, last = self._tracks[name][near[0]], self._tracks[name][near[-1]]
                later[name] = self._tracks[name][index].copy()
                later[name][:3, 3] += (last - first)[:3, 3] / (near[-1] - near[0])
        poses = np.array([self._tracks[name][index] for name in names]).reshape(-1, 4, 4)
        size = np.array([self._kinds[name][1] for name in names]).reshape(-1, 3)
        boxes = Boxes(names, [self._kinds[name][0] for name in names], size, np.linalg.inv(sweep.pose) @ poses)
        seconds = (self.timestamps[1] - self.timestamps[0]) * 1e-9
        return moving(boxes, sweep.pose, later, seconds, sweep.points[~sweep.is_ground][:, :3])

    def is_labelled(self, index: int, position: np.ndarray) -> np.ndarray:
        """(R,) bool: (R, 3) positions in the world are in the image."""
        T_ego_world = np.linalg.inv(self.sweep(index).pose)
        local = position @ T_ego_world[:3, :3].T + T_ego_world[:3, 3]
        u, v, depth = self._projection[:, :3] @ local.T + self._projection[:, 3:]
        inside = (u >= 0) & (u < _IMAGE[0] * depth) & (v >= 0) & (v < _IMAGE[1] * depth)
        return (depth > 0) & inside


def fit(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Fit a rotation about z and a translation to (N, 3) points and where they go; (4, 4)."""
    a, b = start - start.mean(0), end - end.mean(0)
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a[:, :2] * b[:, :2]).sum())
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = end.mean(0) - pose[:3, :3] @ start.mean(0)
    return pose


def corners(x: float, y: float, length: float, width: float, heading: float) -> np.ndarray:
    """(4, 2) corners of a rectangle, counter-clockwise."""
    local = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [length / 2, width / 2]
    cos, sin = np.cos(heading), np.sin(heading)
    return local @ [[cos, sin], [-sin, cos]] + [x, y]


def iou(first: np.ndarray, second: np.ndarray) -> float:
    """Intersection over union of two convex polygons, (N, 2) counter-clockwise each."""
    shared = area(clip(first, second))
    return shared / (area(first) + area(second) - shared)


def clip(polygon: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Cut a convex polygon by each edge of another one."""
    for start, end in zip(by, np.roll(by, -1, 0)):
        if len(polygon) == 0:
            break
        edge = end - start
        side = edge[0] * (polygon[:, 1] - start[1]) - edge[1] * (polygon[:, 0] - start[0])
        kept = []
        for k in range(len(polygon)):
            following = (k + 1) % len(polygon)
            if side[k] >= 0:
                kept.append(polygon[k])
            if (side[k] >= 0) != (side[following] >= 0):
                share = side[k] / (side[k] - side[following])
                kept.append(polygon[k] + share * (polygon[following] - polygon[k]))
        polygon = np.reshape(kept, (-1, 2))
    return polygon


def area(polygon: np.ndarray) -> float:
    x, y = polygon[:, 0], polygon[:, 1]
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2 if len(polygon) else 0.0


def score(log: Any, table: dict[str, np.ndarray], sweeps: range) -> list[Row]:
    """A row for each scored object and sweep."""
    rows: list[Row] = []
    for index in sweeps:
        chosen = np.flatnonzero(table["sweep"] == index)
        found = [found_corners(table, row) for row in chosen]
        truth = log.true_boxes(index)
        for k in np.flatnonzero(truth.is_scored):
            shares = [iou(truth.corners(k), each) for each in found]
            best = int(np.argmax(shares)) if shares else -1
            row = {"log": log.log_id, "sweep": index, "object": truth.name[k], "kind": truth.kind[k], "iou": 0.0}
            row.update(
                track=-1, true=truth.size[k], centre=truth.pose[k, :3, 3], speed=np.linalg.norm(truth.velocity[k])
            )
            row.update(yaw=truth.heading[k])
            if best >= 0 and shares[best] > 0:
                of_track = chosen[best]
                row.update(iou=shares[best], track=int(table["id"][of_track]))
                row.update(size=np.array([table[name][of_track] for name in ("length", "width", "height")]))
                turn = table["heading"][of_track] - truth.heading[k]
                row.update(heading=abs(np.degrees(np.arctan2(np.sin(turn), np.cos(turn)))))
                row.update(found="" if "class" not in table else str(table["class"][of_track]))
            rows.append(row)
    return rows


def found_corners(table: dict[str, np.ndarray], row: int) -> np.ndarray:
    """(4, 2) corners of a box of a table."""
    return corners(*(float(table[name][row]) for name in ("x", "y", "length", "width", "heading")))


class Detections(NamedTuple):
    """Moving boxes of drives, and what each one is at an IoU of 0.4 and of 0.7."""

    confidence: list[float]
    is_right: list[tuple[bool, ...]]
    num_true: int

    def average_precision(self, threshold: int) -> float:
        """Return the mean over all recalls of the best precision that is possible at this recall or a higher one."""
        order = np.argsort(-np.array(self.confidence), kind="stable")
        is_right = np.array([each[threshold] for each in self.is_right], bool)[order]
        precision = np.cumsum(is_right) / np.arange(1, len(order) + 1)
        best = np.maximum.accumulate(precision[::-1])[::-1]
        return float(best[is_right].sum() / max(self.num_true, 1))


def detections(drives: list[tuple[Any, dict[str, np.ndarray], range]]) -> Detections:
    """Compare the moving boxes of drives with the objects that move."""
    confidence: list[float] = []
    is_right: list[tuple[bool, ...]] = []
    num_true = 0
    for log, table, sweeps in drives:
        score = score_of(table)
        for index in sweeps:
            truth = log.true_boxes(index)
            num_true += int(truth.is_scored.sum())
            ego = log.sweep(index).pose[:2, 3]
            is_near = np.hypot(table["x"] - ego[0], table["y"] - ego[1]) <= RANGE
            is_counted = (table["sweep"] == index) & table["is_moving"] & is_near
            if isinstance(log, KITTIBoxes):
                is_counted &= log.is_labelled(index, np.stack([table[name] for name in "xyz"], 1))
            chosen = np.flatnonzero(is_counted)
            chosen = chosen[np.argsort(-score[chosen], kind="stable")]
            taken: list[set[int]] = [set() for _ in THRESHOLDS]
            for row in chosen.tolist():
                shares = np.array([iou(truth.corners(k), found_corners(table, row)) for k in range(len(truth.name))])
                of_objects = np.where(truth.is_scored, shares, 0)
                best = [np.where(np.isin(range(len(shares)), list(each)), 0, of_objects) for each in taken]
                hits = [bool(len(each) and each.max() >= least) for each, least in zip(best, THRESHOLDS)]
                for each, shares_left, hit in zip(taken, best, hits):
                    if hit:
                        each.add(int(shares_left.argmax()))
                if any(hits) or of_objects.max(initial=0) >= shares.max(initial=0):  # else it is on an unscored object
                    confidence.append(float(score[row]))
                    is_right.append(tuple(hits))
    return Detections(confidence, is_right, num_true)


def summary(name: str, rows: list[Row], found: Detections) -> Row:
    """The columns of docs/boxes.csv."""
    ious = np.array([row["iou"] for row in rows])
    hits = [row for row in rows if row["track"] >= 0]
    size = np.array([np.abs(row["size"] / row["true"] - 1) for row in hits]).reshape(-1, 3)
    is_vehicle = np.array([row["kind"] in ("car", "truck") for row in hits], bool)
    out: Row = {"drive": name, "objects x sweeps": len(rows), "missed": len(rows) - len(hits), "IoU": ious.mean()}
    out.update({f"> {least}, %": 100 * (ious > least).mean() for least in THRESHOLDS})
    out.update({f"AP {least}": found.average_precision(number) for number, least in enumerate(THRESHOLDS)})
    for kind in ("car", "truck", "cyclist", "pedestrian"):
        of_kind = ious[[row["kind"] == kind for row in rows]]
        out[f"IoU of {kind}"] = of_kind.mean() if len(of_kind) else "-"
        out[f"{kind}s"] = len(of_kind)
    for axis, side in enumerate(("length", "width")):
        out[f"{side} off by, %"] = 100 * np.median(size[is_vehicle, axis])
    out["within 15 %"] = 100 * (size[is_vehicle, :2] <= 0.15).all(1).mean()
    out["heading, degrees"] = float(np.median([row["heading"] for row in hits]))
    out["same size, %"] = constancy(hits)
    if hits and hits[0]["found"]:
        out["class, %"] = 100 * np.mean([row["found"] == row["kind"] for row in hits])
    return out


def constancy(hits: list[Row]) -> float:
    """Share of the boxes whose length and width are within 2 % of the median of their track."""
    tracks: dict[Any, list[np.ndarray]] = {}
    for row in hits:
        tracks.setdefault((row["log"], row["track"]), []).append(row["size"][:2])
    off = [np.abs(np.array(sizes) / np.median(sizes, 0) - 1).max(1) for sizes in tracks.values()]
    return float(100 * (np.concatenate(off) <= 0.02).mean()) if off else np.nan


def boxes_of(log: Log, model: VerifiedFlow) -> tuple[dict[str, np.ndarray], range]:
    """Track a drive."""
    seen = windows(GroundSegmentedLog(log), model.config.num_history, model.config.num_future)
    results = [(index, model([given])[0]) for index, given in enumerate(seen)]
    return track(GroundSegmentedLog(log), results), range(len(results))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pandaset", nargs="*", default=(), type=Path, help="sequence folders")
    parser.add_argument("--scene", nargs=2, action="append", default=[], type=Path, metavar=("H5", "SEQUENCE"))
    parser.add_argument("--kitti", nargs=3, action="append", default=[], metavar=("H5", "KITTI", "FIRST"))
    parser.add_argument("--simulated", nargs="*", default=(), choices=SENSORS, metavar="SENSOR")
    parser.add_argument("--num-sweeps", type=int, default=20, help="of a simulated drive")
    given = parser.parse_args()
    torch.set_num_threads(1)
    model = make_model(make_config("default"), "auto")
    drives: list[tuple[str, list[Any]]] = [(path.name, [PandaSetBoxes(path)]) for path in given.pandaset]
    drives += [(scene.stem, [SceneBoxes(scene, sequence)]) for scene, sequence in given.scene]
    for scene, folder, first in given.kitti:
        drives.append((Path(scene).stem, [KITTIBoxes(Path(scene), Path(folder), int(first))]))
    for sensor in given.simulated:
        logs = [SimulatedBoxes(sensor, seed, scene, given.num_sweeps) for seed, scene in DRIVES]
        drives.append((f"simulated {sensor}", logs))
    summaries = []
    for name, logs in drives:
        tracked = [(log, *boxes_of(log, model)) for log in logs]
        rows = [row for each in tracked for row in score(*each)]
        summaries.append(summary(name, rows, detections(tracked)))
        print(f"{name} is scored", file=sys.stderr)
    print(markdown(summaries))


if __name__ == "__main__":
    main()
