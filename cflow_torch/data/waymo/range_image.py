"""Waymo's range images: the ray of each pixel, and the position of its return in the vehicle frame."""

from __future__ import annotations

from typing import NamedTuple, Sequence

import numpy as np

from cflow_torch.transforms import rotations_of, transform_points
from cflow_torch.types import CFlowError

LASERS = {"TOP": 1, "FRONT": 2, "SIDE_LEFT": 3, "SIDE_RIGHT": 4, "REAR": 5}
"""Laser name -> number in the files; 0 is unknown."""

TOP = LASERS["TOP"]
RANGE, INTENSITY, ELONGATION, NO_LABEL_ZONE = range(4)
"""Channels of a range image. Range is in metres, > 0 where there is a return. Inside a no-label zone, the flag is 1."""


class LaserCalibration(NamedTuple):
    """Mounting of one laser and the inclinations of its rows."""

    T_ego_sensor: np.ndarray  # (4, 4) float64, laser coordinates to the vehicle's
    # (H,) radians, ascending; None = evenly spaced between `low` and `high`.
    inclinations: Sequence[float] | np.ndarray | None = None
    low: float | None = None  # radians, outer edge of the lowest row, used if `inclinations` is None
    high: float | None = None  # radians, outer edge of the highest row, used if `inclinations` is None

    def row_inclinations(self, num_rows: int) -> np.ndarray:
        """Return (H,) float64 radians above the laser's xy plane; row 0 is the highest. A wrong H is a `CFlowError`."""
        ascending = np.array(self.inclinations, np.float64)
        if self.inclinations is None:
            low, high = np.array([self.low, self.high], np.float64)
            ascending = low + (np.arange(num_rows) + 0.5) / num_rows * (high - low)
        if ascending.shape != (num_rows,) or not np.isfinite(ascending).all():
            raise CFlowError(
                f"a range image of {num_rows} rows needs {num_rows} finite beam inclinations, but the calibration has "
                f"{np.isfinite(ascending).sum()}; take both files from the same segment"
            )
        return ascending[::-1]

    def column_azimuths(self, num_columns: int) -> np.ndarray:
        """Return (W,) float64 radians about the laser's z axis, descending; column 0 points backwards."""
        yaw = np.arctan2(self.T_ego_sensor[1, 0], self.T_ego_sensor[0, 0])
        share = (num_columns - np.arange(num_columns) - 0.5) / num_columns
        return (2 * share - 1) * np.pi - yaw


def directions(azimuth: np.ndarray, inclination: np.ndarray) -> np.ndarray:
    """Return (..., 3) float64 unit vectors in the laser frame."""
    flat = np.cos(inclination)
    return np.stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(inclination)], axis=-1)


def range_image_points(
    image: np.ndarray,
    calibration: LaserCalibration,
    T_world_ego: np.ndarray,
    pixel_poses: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of all pixels with a return, (N, 3) float64, and the index of each pixel, (N,) int64.

    Points are in metres, in the vehicle frame at the time of the image. Indices are row * W + column, ascending. We
    compute in float64, because world coordinates are about 10 km, where float32 has steps of 1 mm.

    Args:
        image: (H, W, 4) float: range (metres), intensity, elongation, no-label-zone flag.
        calibration: calibration of the laser.
        T_world_ego: (4, 4) float64 vehicle pose at the time of the image, ignored without `pixel_poses`.
        pixel_poses: (H, W, 6) roll, pitch, yaw, x, y, z of `T_world_ego` at the time of each pixel. Only the TOP laser
            has them. Images of the other lasers are already made for one vehicle pose.
    """
    num_rows, num_columns = image.shape[:2]
    pixels = np.flatnonzero(image[..., RANGE] > 0)
    row, column = np.divmod(pixels, num_columns)
    azimuth, inclination = calibration.column_azimuths(num_columns), calibration.row_inclinations(num_rows)
    distance = image[..., RANGE].reshape(-1)[pixels].astype(np.float64)
    in_laser = distance[:, None] * directions(azimuth[column], inclination[row])
    points = transform_points(in_laser, calibration.T_ego_sensor)
    if pixel_poses is None:
        return points, pixels
    if pixel_poses.shape != (num_rows, num_columns, 6):
        raise CFlowError(f"pixel poses have shape {pixel_poses.shape}, they must have ({num_rows}, {num_columns}, 6)")
    poses = pixel_poses.reshape(-1, 6)[pixels].astype(np.float64)
    world = np.einsum("nij,nj->ni", rotations_of(poses[:, :3].T), points) + poses[:, 3:]
    return transform_points(world, np.linalg.inv(T_world_ego)), pixels
