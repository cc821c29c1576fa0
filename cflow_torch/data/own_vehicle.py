"""Leave out returns of the own vehicle: points that stay in place in its frame while it drives."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from cflow_torch.data.finding import FOUND, RIGHT, Finding
from cflow_torch.data.log import FlowLabels, LogWrapper, known_poses
from cflow_torch.diagnosis.point_frame import frame_problem, tilt_problem
from cflow_torch.diagnosis.stillness import IN_PLACE, Structure, are_finite, cell_keys, thinned_rows
from cflow_torch.errors import CFlowError
from cflow_torch.ground.segmentation import find_ground
from cflow_torch.transforms import transform_points
from cflow_torch.types import Sweep, as_numpy

_NEAR, _CELL = 2.7, 0.25  # metres from the origin along x and y, and side of a cell
_LEAST_MOTION, _FEWEST_SWEEPS, _MOST_SWEEPS = 2.0, 3, 4  # metres between the compared sweeps, and their number
_SHARE = 0.7  # of these sweeps that have a point in a cell of the vehicle
_IN_PLACE = 0.3  # share of the points of a cell that the static world explains, as those of a wall along the road
_FEWEST_POINTS = 12  # in a sweep
_MOST_RETURNS = 0.5  # share of the returns of a sweep that may be those of the vehicle
_THINNED = 0.02  # metres between the points that are compared, because dense clouds would cost minutes


class OwnVehicleLog(LogWrapper):
    """A log in which the returns of the own vehicle are NaN, so rows stay as they are. Their labels are not valid.

    Attributes:
        own_cells: (C, 3) int64, cells of 0.25 m that hold returns of the vehicle. It is found at first use from
            three or four sweeps at least 2 m apart: cells near the origin that most of them have points in, other than
            ground, and that are not in place under the ego motion. Empty if the vehicle does not drive, if poses are
            unknown before points are read, or if there are fewer than twelve such points. Also empty if more than half
            of the returns of a sweep would be left out, as in rooms, where poses may be wrong.
    """

    def sweep(self, index: int) -> Sweep:
        sweep = self.log.sweep(index)
        if len(self.own_cells) == 0:
            return sweep
        points = as_numpy(sweep.points)
        rows = _rows_in(self.own_cells, points)
        self._note(
            f"{len(rows)} returns within {_NEAR:g} m ride along with the vehicle, so we leave them out, also in other "
            "sweeps. data.own_vehicle=null keeps them",
            "own vehicle",
        )
        points = points.copy()
        points[rows] = np.nan
        return replace(sweep, points=points)

    def labels(self, index: int) -> FlowLabels | None:
        labels = self.log.labels(index)
        if labels is None or len(self.own_cells) == 0:
            return labels
        is_valid = labels.is_valid.copy()
        is_valid[_rows_in(self.own_cells, as_numpy(self.log.sweep(index).points))] = False
        return replace(labels, is_valid=is_valid)

    def findings(self) -> list[Finding]:
        count = len(self.own_cells)
        text = f"returns in {count} cells near the origin ride along, so we leave them out"
        own = Finding("own vehicle", *((FOUND, text) if count else (RIGHT, "no returns are seen")))
        return [*self.log.findings(), own]

    @cached_property
    def own_cells(self) -> np.ndarray:
        try:
            return self._find_cells()
        except (CFlowError, OSError):  # `sweep` raises the error of the sweep that cannot be read
            return np.zeros((0, 3), np.int64)

    def _find_cells(self) -> np.ndarray:
        nothing = np.zeros((0, 3), np.int64)
        poses = known_poses(self.log)
        chosen = [] if poses is None else _spread(poses[:, :3, 3])
        sweeps: list[np.ndarray] = []
        clouds: list[np.ndarray] = []
        for index in chosen:
            sweep = self.log.sweep(index)
            sweeps.append(as_numpy(sweep.points))
            clouds.append(_structure(sweep))
            if _are_near(clouds[-1]).sum() < _FEWEST_POINTS and index == chosen[0]:
                return nothing  # no other sweep needs to be read
        if poses is None or not clouds:
            return nothing
        near = [_thinned(points[_are_near(points)]) for points in clouds]
        in_sweeps = np.concatenate([np.unique(_cells_of(points), axis=0) for points in near])
        cells, count = np.unique(in_sweeps, axis=0, return_counts=True)
        cells = cells[count >= _SHARE * len(clouds)]
        rides = np.concatenate([_contains(cells, _cells_of(points)) for points in near])
        explained = np.concatenate(
            [
                _in_place(points, np.linalg.inv(poses[other]) @ poses[index], clouds[k - 1], cells)
                for k, (points, index, other) in enumerate(zip(near, chosen, [chosen[-1], *chosen[:-1]]))
            ]
        )
        of_all = _cells_of(np.concatenate(near))
        if rides.sum() < _FEWEST_POINTS * len(clouds) or explained[rides].mean() > _IN_PLACE:
            return nothing
        if frame_problem(sweeps[0])[1] or tilt_problem(sweeps[:1]):
            return nothing  # then other points than those of the ground were taken for ground
        cells = np.unique(of_all[rides & ~explained], axis=0)
        shares = [len(_rows_in(cells, points)) / max(are_finite(points).sum(), 1) for points in sweeps]
        return nothing if max(shares) > _MOST_RETURNS else cells


def _spread(positions: np.ndarray) -> list[int]:
    """Choose sweeps along the path, in order, neighbours at least 2 m apart; [] if the vehicle hardly drives."""
    travelled = np.append(0.0, np.linalg.norm(np.diff(positions, axis=0), axis=1).cumsum())
    count = int(np.clip(travelled[-1] / _LEAST_MOTION, _FEWEST_SWEEPS, _MOST_SWEEPS))
    chosen = np.searchsorted(travelled, np.linspace(0, travelled[-1], count) - 1e-9)
    away = np.linalg.norm(np.diff(positions[chosen], axis=0), axis=1)
    return chosen.tolist() if (away >= _LEAST_MOTION).all() else []  # type: ignore[no-any-return]


def _structure(sweep: Sweep) -> np.ndarray:
    """Return the finite points of a sweep that are not ground, (N, 3) float64."""
    points = as_numpy(sweep.points)[:, :3].astype(np.float64)
    finite = are_finite(points)
    if (_are_near(points) & finite).sum() < _FEWEST_POINTS:
        return points[:0]
    mask = find_ground(points, "grid") if sweep.is_ground is None else sweep.is_ground
    return points[finite & ~as_numpy(mask)]


def _rows_in(cells: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the rows of points in cells of the vehicle or next to them, (K,) int64."""
    near = np.flatnonzero(_are_near(points))
    offsets = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), -1).reshape(-1, 3)
    around = (cells[:, None] + offsets).reshape(-1, 3)
    return near[_contains(around, _cells_of(points[near]))]  # type: ignore[no-any-return]


def _thinned(points: np.ndarray) -> np.ndarray:
    return points[thinned_rows(points, _THINNED)]  # type: ignore[no-any-return]


def _are_near(points: np.ndarray) -> np.ndarray:
    return (np.abs(points[:, 0]) < _NEAR) & (np.abs(points[:, 1]) < _NEAR)  # False for NaN


def _cells_of(points: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        cell = np.floor(np.nan_to_num(points[:, :3].astype(np.float64)) / _CELL)
    return cell.clip(-(1 << 19), 1 << 19).astype(np.int64)


def _contains(cells: np.ndarray, of_points: np.ndarray) -> np.ndarray:
    return np.isin(cell_keys(of_points), cell_keys(cells))


def _in_place(points: np.ndarray, T_other: np.ndarray, other: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Test which points are in place in another sweep under the ego motion, without the cells of the vehicle."""
    if len(points) == 0:
        return np.zeros(0, bool)
    moved = transform_points(points, T_other)
    reach = 2 * IN_PLACE
    around = ((other > moved.min(0) - reach) & (other < moved.max(0) + reach)).all(1)  # the search costs less
    other = _thinned(other[around])
    return Structure(other[~_contains(cells, _cells_of(other))]).in_place(moved)
