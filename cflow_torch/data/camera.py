"""Calibrated cameras of a log: where a point of a sweep is in an image."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cflow_torch.transforms import transform_points

_NEAREST = 0.1  # metres; nearer points are not projected


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
        depth = np.where(positions[:, 2:] > _NEAREST, positions[:, 2:], np.nan)
        pixels: np.ndarray = (positions @ self.matrix.T)[:, :2] / depth
        return pixels


def intrinsic_matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """Return the (3, 3) float64 matrix of focal lengths and principal point, pixels."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)


def at_image(T_ego_camera: np.ndarray, image_pose: np.ndarray, sweep_pose: np.ndarray) -> np.ndarray:
    """Return `T_camera_ego` of a camera, given its mount and `T_world_ego` at the times of the image and the sweep."""
    T_image_sweep: np.ndarray = np.linalg.inv(image_pose) @ sweep_pose
    return np.linalg.inv(T_ego_camera) @ T_image_sweep
