"""Ground points from the ground height raster of an Argoverse 2 map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable

import numpy as np

from cflow_torch.data.files import file_errors, read_npy
from cflow_torch.data.json_file import read_json
from cflow_torch.types import CFlowError

# Rule -> largest distance of a ground point from the surface, metres; rounding of grid positions to cells (towards
# zero, or half to even).
GROUND_RULES: dict[str, tuple[float, Callable[[np.ndarray], Any]]] = {
    "av2-api": (0.3, np.trunc),
    "bsfe": (0.4, np.round),
}


@dataclass(frozen=True)
class GroundRaster:
    """Ground height on a grid of the city.

    Source: layout of the Argoverse 2 map folder, `*_ground_height_surface____*.npy` and `*___img_Sim2_city.json`.
    """

    heights: np.ndarray  # (H, W) float64, metres, row from y, column from x; NaN = unknown
    rotation: np.ndarray  # (2, 2) float64
    translation: np.ndarray  # (2,) float64
    scale: float  # cells per metre. The grid position of a city point is scale * (rotation @ xy + translation).

    def is_ground(self, points: np.ndarray, rule: str = "av2-api") -> np.ndarray:
        """Return (N,) bool: which of (N, 3) points, metres in the CITY frame, are on or below the ground by a rule.

        False outside the raster and where its height is NaN.
        """
        threshold, to_cell = GROUND_RULES[rule]
        xyz: np.ndarray = np.asarray(points, dtype=np.float64)
        inside = np.isfinite(xyz[:, :2]).all(axis=1)
        position = (np.where(inside[:, None], xyz[:, :2], 0.0) @ self.rotation.T + self.translation) * self.scale
        cell = to_cell(position).astype(np.int64)
        inside &= (cell >= 0).all(axis=1) & (cell < self.heights.shape[::-1]).all(axis=1)
        height = np.full(len(xyz), np.nan)
        height[inside] = self.heights[cell[inside, 1], cell[inside, 0]]
        with np.errstate(invalid="ignore"):
            above = xyz[:, 2] - height
            return (np.abs(above) <= threshold) | (above < 0)


def read_ground_raster(map_folder: Path) -> GroundRaster | None:
    """Read the raster of a log from its folder `map`; None if there is none, a `CFlowError` if there are several."""
    rasters = sorted(map_folder.glob("*_ground_height_surface____*.npy"))
    if not rasters:
        return None
    alignments = sorted(map_folder.glob("*___img_Sim2_city.json"))
    if len(rasters) > 1 or len(alignments) != 1:
        raise CFlowError(
            f"{map_folder} must hold one *_ground_height_surface____*.npy and one *___img_Sim2_city.json, "
            f"found {len(rasters)} and {len(alignments)}"
        )
    heights = read_npy(rasters[0], "copy the map folder again")
    if heights.ndim != 2 or heights.dtype.kind not in "fiu":
        raise CFlowError(f"{rasters[0]} must hold (H, W) numbers, got shape {heights.shape} and dtype {heights.dtype}")
    with file_errors(alignments[0], "copy the map folder again"):
        alignment = read_json(alignments[0])
        raster = GroundRaster(
            heights=heights.astype(np.float64),
            rotation=np.array(alignment["R"], dtype=np.float64).reshape(2, 2),
            translation=np.array(alignment["t"], dtype=np.float64).reshape(2),
            scale=float(alignment["s"]),
        )
    if not all(np.isfinite(value).all() for value in (raster.rotation, raster.translation, raster.scale)):
        raise CFlowError(f"{alignments[0]} has numbers that are not finite; copy the map folder again")
    return raster
