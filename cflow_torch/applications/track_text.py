"""Tracks as text, for tools of the MOT Challenge and of KITTI."""

from __future__ import annotations

import numpy as np

from cflow_torch.applications.track_table import Table
from cflow_torch.data.atomic import write_text
from cflow_torch.data.log import Log
from cflow_torch.data.paths import PathLike, as_path
from cflow_torch.types import as_numpy


def write_mot(path: PathLike, table: Table, log: Log) -> None:
    """Write tracks in the format of the MOT Challenge 3D.

    Args:
        path: text file with a line `frame,id,-1,-1,-1,-1,confidence,x,y,z` per row of the table.
        table: of `track`.
        log: not used.

    Convention: frames and ids count from 1; x, y, z is the centre of the box, metres in the world; confidence 1 where
        the method has none.
    """
    confidence = np.where(np.isnan(table["confidence"]), 1.0, table["confidence"])
    rows = zip(table["sweep"] + 1, table["id"] + 1, confidence, *(table[axis] for axis in "xyz"))
    lines = (
        f"{frame},{number},-1,-1,-1,-1,{sure:.3f},{x:.3f},{y:.3f},{z:.3f}" for frame, number, sure, x, y, z in rows
    )
    write_text(as_path(path), "".join(line + "\n" for line in lines))


def write_kitti(path: PathLike, table: Table, log: Log) -> None:
    """Write tracks in the format of KITTI's tracking benchmark.

    Args:
        path: text file with a line of 18 columns per row of the table.
        table: of `track`.
        log: the drive, for its poses.

    Convention: frames and ids count from 0; the type is Misc, because tracks have no class; unknown columns are -1. The
        camera is at the origin of the ego frame of the sweep, looks to +x, and has KITTI's axes: x to the right, y
        down, z ahead. The position is the middle of the lower face of the box.

    Cost: reads every sweep that has tracks.

    Source: development kit of the KITTI tracking benchmark (2012).
    """
    lines = []
    for index in np.unique(table["sweep"]).tolist():
        rows = {name: values[table["sweep"] == index] for name, values in table.items()}
        pose = log.sweep(index).pose
        T_ego_world = np.eye(4) if pose is None else np.linalg.inv(as_numpy(pose, np.float64))
        centre = np.stack([rows[axis] for axis in "xyz"], 1) @ T_ego_world[:3, :3].T + T_ego_world[:3, 3]
        ahead = np.stack([np.cos(rows["heading"]), np.sin(rows["heading"])]).T @ T_ego_world[:2, :2].T
        x, y, z = -centre[:, 1], rows["height"] / 2 - centre[:, 2], centre[:, 0]
        rotation = _wrapped(-np.arctan2(ahead[:, 1], ahead[:, 0]) - np.pi / 2)
        alpha = _wrapped(rotation - np.arctan2(x, z))
        score = np.where(np.isnan(rows["confidence"]), 1.0, rows["confidence"])
        size = (rows["height"], rows["width"], rows["length"])
        for number, angle, *numbers in zip(rows["id"], alpha, *size, x, y, z, rotation, score):
            box = " ".join(f"{value:.6f}" for value in numbers)
            lines.append(f"{index} {number} Misc -1 -1 {angle:.6f} -1 -1 -1 -1 {box}\n")
    write_text(as_path(path), "".join(lines))


def _wrapped(angle: np.ndarray) -> np.ndarray:
    """Angles in -pi ... pi."""
    return np.arctan2(np.sin(angle), np.cos(angle))
