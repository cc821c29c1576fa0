"""Draw masks of dynamic objects in the images of a log's cameras, for the reconstruction of its static world."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Iterable, NamedTuple, Sequence

import numpy as np

from cflow_torch.applications.association import of_own_vehicle
from cflow_torch.applications.moving_groups import MovingGroups, pose_of
from cflow_torch.applications.track_table import Table, box_corners, boxes_in_sweeps, poses_of
from cflow_torch.data.atomic import atomic_file
from cflow_torch.data.camera import NEAREST, Camera
from cflow_torch.data.log import Log, TimedLog
from cflow_torch.errors import import_optional
from cflow_torch.types import SIZE, VELOCITY, CFlowError, FlowResult, Window, as_numpy, vectors

DYNAMIC, STATIC = 255, 0  # values of pixels
_RADIUS = 0.15  # metres around a moving point
_MARGIN = 0.1  # metres, added to each side of a box


def write_masks(folder: Path, log: Log, results: Iterable[tuple[int, FlowResult]], table: Table) -> None:
    """Write `folder/CAMERA/IMAGE.png` for each camera of each sweep with a flow: 255 = dynamic, 0 = static.

    Args:
        folder: created if it does not exist.
        log: a log whose reader knows the calibration of its cameras (`Log.cameras`). Sweeps without
            time stamps are taken to be 0.1 s apart; give a `TimedLog` for another interval.
        results: (index, flow of sweep `index` to `index + 1`).
        table: tracks of the log, see `track`.

    Convention: a pixel is dynamic if it shows a disc of 0.15 m around a moving point (`FlowResult.is_moving`), or the
        box of a track, 0.1 m larger on each side, which may be at rest in this sweep. Points and boxes are moved to the
        time of the image by their velocities. We do not test whether something hides them. If an image is that of
        several sweeps, because a camera is slower than the LiDAR, it has the mask of the sweep that is nearest in time.

    Raises:
        CFlowError: the log has no calibration of cameras, or Pillow is not installed.
    """
    log = TimedLog(log)
    distance: dict[Path, float] = {}  # seconds from an image to the nearest sweep so far
    for index, result in results:
        cameras = log.cameras(index)
        check_cameras(log, cameras)
        shapes = DynamicShapes.of(log, index, result, table)
        for camera in cameras:
            file = folder / camera.name / f"{camera.image}.png"
            if abs(camera.seconds) < distance.get(file, np.inf):
                distance[file] = abs(camera.seconds)
                write_mask(file, shapes.draw(camera))


def check_cameras(log: Log, cameras: Sequence[Camera]) -> None:
    """Raise an error if a log has no calibrated cameras."""
    if not cameras:
        raise CFlowError(
            f"log {log.log_id} has no calibration of cameras, which masks need: Argoverse 2, PandaSet, nuScenes, "
            "TruckScenes and KITTI have it in the files of their cameras"
        )


class DynamicShapes(NamedTuple):
    """The P moving points of a sweep and the K boxes of its tracks, in the frame of its points, and their motion."""

    points: np.ndarray  # (P, 3) float64 metres
    point_velocity: np.ndarray  # (P, 3) float64 m/s
    corners: np.ndarray  # (K, 8, 3) float64 metres, in the order of `box_corners`
    box_velocity: np.ndarray  # (K, 3) float64 m/s
    kind: np.ndarray  # (K,) class of each track

    @classmethod
    def of(cls, log: Log, index: int, result: FlowResult, table: Table) -> DynamicShapes:
        """Collect those of sweep `index` of a `TimedLog`, given its flow and the table of tracks."""
        rows = {name: values[table["sweep"] == index] for name, values in table.items()}
        return cls(*_moving_points(log, index, result), *_corners(log, rows), rows["class"])

    def boxes(self, kinds: Sequence[str]) -> DynamicShapes:
        """Keep the boxes of tracks of some classes, and no points."""
        is_kept = np.isin(self.kind, kinds)
        no_points = np.zeros((0, 3))
        return DynamicShapes(
            no_points, no_points, self.corners[is_kept], self.box_velocity[is_kept], self.kind[is_kept]
        )

    def draw(self, camera: Camera) -> np.ndarray:
        """Draw the shapes where they are at the time of the camera's image, see `dynamic_mask`."""
        points = self.points + camera.seconds * self.point_velocity
        return dynamic_mask(camera, points, self.corners + camera.seconds * self.box_velocity[:, None])


def write_mask(path: Path, mask: np.ndarray) -> None:
    """Write a mask, (height, width) uint8, as PNG."""
    with atomic_file(path) as file:
        load_pillow().fromarray(mask).save(file, "PNG")


def dynamic_mask(camera: Camera, points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Draw moving points, (P, 3), and boxes, (K, 8, 3) corners, both in metres in the frame of the sweep's points.

    Corners are in the order of `box_corners`. Returns (height, width) uint8.
    """
    image = load_pillow().new("L", camera.size, STATIC)
    brush = import_optional("PIL.ImageDraw", _NEEDS_PILLOW).Draw(image)
    width, height = camera.size
    positions = camera.see(points)
    pixels = camera.project(positions)
    radius = _RADIUS * camera.matrix[0, 0] / np.maximum(positions[:, 2], NEAREST)
    nearest = np.clip(pixels, 0, (width, height))
    is_seen = np.abs(pixels - nearest).max(axis=1, initial=0) <= radius  # False for NaN
    for (x, y), r in zip(pixels[is_seen].tolist(), radius[is_seen].tolist()):
        brush.ellipse((x - r, y - r, x + r, y + r), fill=DYNAMIC)
    for box in corners:
        for polygon in camera.project_box(box):
            brush.polygon([tuple(pixel) for pixel in polygon.tolist()], fill=DYNAMIC)
    return np.asarray(image)


def _moving_points(log: Log, index: int, result: FlowResult) -> tuple[np.ndarray, np.ndarray]:
    """Return moving points, (P, 3) metres, and their velocities, (P, 3) m/s, in the frame of the sweep's points."""
    sweep, after = log.sweep(index), log.sweep(index + 1)
    points = as_numpy(sweep.points, np.float64)[:, :3]
    if len(points) != len(result.residual_flow):
        rows = len(result.residual_flow)
        raise CFlowError(f"sweep {index} has {len(points)} points, but its flow {rows} rows: give both of one log")
    sweeps = Window(sweep, after)
    groups = MovingGroups.of(sweeps, result)
    moves = as_numpy(result.is_moving) & np.isfinite(points).all(axis=1)
    moves[as_numpy(groups.row[of_own_vehicle(groups, sweeps)])] = False
    rotation = pose_of(sweep)[:3, :3].T @ pose_of(after)[:3, :3]  # from the axes of t+1 to those of t
    flow = as_numpy(result.residual_flow, np.float64)[moves] @ rotation.T
    seconds = (after.timestamp_ns - sweep.timestamp_ns) * 1e-9  # type: ignore[operator]  # of a `TimedLog`
    return points[moves], flow / seconds


def _corners(log: Log, rows: Table) -> tuple[np.ndarray, np.ndarray]:
    """Return corners, (K, 8, 3) metres, and velocities, (K, 3) m/s, of boxes of a sweep, in the frame of its points."""
    if not len(rows["sweep"]):
        return np.zeros((0, 8, 3)), np.zeros((0, 3))
    centre, heading = boxes_in_sweeps(rows, log)
    corners = box_corners(centre, heading, vectors(rows, SIZE) + 2 * _MARGIN)
    return corners, vectors(rows, VELOCITY) @ poses_of(log, rows["sweep"][:1].tolist())[0, :3, :3]


_NEEDS_PILLOW = "masks need Pillow (extra viz): pip install Pillow"


def load_pillow() -> Any:
    """Import Pillow's images; a missing package is a `CFlowError`."""
    return import_optional("PIL.Image", _NEEDS_PILLOW)
