"""Calibrated cameras of a log: where a point of a sweep is in an image."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cflow_torch.transforms import transform_points

NEAREST = 0.1  # metres; nearer points are not projected
_FACES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))  # corners of a box


class Camera(NamedTuple):
    """A camera and its image that is nearest in time to a sweep. Images are undistorted.

    Args:
        name: of the camera, such as "ring_front_center".
        image: name of the file of the image, without its suffix.
        size: width and height, pixels.
        matrix: (3, 3) float64, intrinsic matrix.
        T_camera_ego: (4, 4) float64, from the frame of the sweep's points to the camera at the time of the image. The
            camera looks along z, x is to the right, y down.
        seconds: from the time of the sweep to that of the image.
    """

    name: str
    image: str
    size: tuple[int, int]
    matrix: np.ndarray
    T_camera_ego: np.ndarray
    seconds: float = 0.0

    def see(self, points: np.ndarray) -> np.ndarray:
        """Return (N, 3) float64 positions of points of the sweep, in the frame of the camera, metres."""
        return transform_points(points, self.T_camera_ego)

    def project(self, positions: np.ndarray) -> np.ndarray:
        """Return (N, 2) float64 pixels, column and row, of positions in the frame of the camera; NaN = behind it."""
        depth = np.where(positions[:, 2:] > NEAREST, positions[:, 2:], np.nan)
        pixels: np.ndarray = (positions @ self.matrix.T)[:, :2] / depth
        return pixels

    def project_box(self, corners: np.ndarray) -> list[np.ndarray]:
        """Return the faces of a box in front of the camera: polygons of (V, 2) float64 pixels.

        The corners are (8, 3) metres in the frame of the sweep's points, in the order of x, y and z: the last one
        changes fastest. What is nearer than 0.1 m, or behind the camera, is cut off.
        """
        positions = self.see(corners)
        polygons = [_in_front(positions[list(face)]) for face in _FACES]
        return [self.project(polygon) for polygon in polygons if len(polygon) > 2]


def _in_front(polygon: np.ndarray) -> np.ndarray:
    """Cut off what is nearer to the camera than `NEAREST`; (N, 3) vertices in its frame."""
    kept = []
    for here, there in zip(polygon, np.roll(polygon, -1, axis=0)):
        is_near, is_next_near = here[2] <= NEAREST, there[2] <= NEAREST
        if not is_near:
            kept.append(here)
        if is_near != is_next_near:
            share = (1.001 * NEAREST - here[2]) / (there[2] - here[2])
            kept.append(here + share * (there - here))
    return np.array(kept).reshape(-1, 3)


def intrinsic_matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """Return the (3, 3) float64 matrix of focal lengths and principal point, pixels."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)


def at_image(T_ego_camera: np.ndarray, image_pose: np.ndarray, sweep_pose: np.ndarray) -> np.ndarray:
    """Return `T_camera_ego` of a camera, given its mount and `T_world_ego` at the times of the image and the sweep."""
    T_image_sweep: np.ndarray = np.linalg.inv(image_pose) @ sweep_pose
    return np.linalg.inv(T_ego_camera) @ T_image_sweep
