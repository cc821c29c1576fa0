"""Points, colours, arrows and boxes of a drive, thinned and packed for a page."""

from __future__ import annotations

import base64
import zlib
from typing import Any, Mapping, Sequence

import numpy as np

from cflow_torch.viz import colorings
from cflow_torch.viz.clusters import PALETTE
from cflow_torch.viz.colorings import FIRST, GROUND, STATIC, UNKNOWN, ramp_entry, wheel_entry
from cflow_torch.viz.panel import ARROW_STEPS, EGO_OUTLINE, MAX_ERROR, MIN_ERROR, MOVING
from cflow_torch.viz.scene import Scene, ViewerFrame

_UNIT = 0.01  # metres; 16 bits reach to 327 m
_REACH = 32000 * _UNIT
_SORT = 2.0  # metres; points of a cell are stored together, which compresses better
_FLOOR_RADIUS = 15.0  # metres; the ground near the vehicle has the height of the rings


class PackedDrive:
    """Thinned scenes of one drive, with the colours of points as indices into palettes.

    A flow of `max_flow`, metres per sweep, has full colour. We keep one static point in each cube of `voxel` metres, on
    the ground of twice that side.
    """

    def __init__(self, max_flow: float, voxel: float) -> None:
        self.max_flow, self.voxel = max_flow, voxel
        self.frame = ViewerFrame()
        self.frames: list[dict[str, Any]] = []
        self.points: list[tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]] = []  # units, entries, cluster
        self.num_given = 0
        self.floor: list[float] = []

    def add(self, scene: Scene) -> None:
        """Thin one pair and choose its colours."""
        position, ground = scene.position, scene.is_ground
        speed = np.linalg.norm(scene.residual, axis=1)
        static = np.where(ground, GROUND, STATIC)
        moving = ~ground & (speed > MOVING)
        cluster = np.where(ground, -1, scene.cluster)
        entries = {
            "flow": np.where(moving, wheel_entry(scene.residual, self.max_flow), static),
            "speed": np.where(moving, ramp_entry(speed, self.max_flow), static),
            "object": colorings.object_entry(position, cluster, moving, ground),
        }
        important = moving
        if scene.confidence is not None:
            entries["confidence"] = np.where(ground, GROUND, ramp_entry(1 - scene.confidence, 1.0))
        if scene.truth is not None:
            length = np.linalg.norm(scene.truth, axis=1)
            error = np.linalg.norm(scene.residual - scene.truth, axis=1)
            unknown = np.where(ground, GROUND, UNKNOWN)
            known = ~ground & np.isfinite(length)
            moves, wrong = known & (length > MOVING), known & (error > MIN_ERROR)
            entry = np.where(moves, wheel_entry(scene.truth, self.max_flow), STATIC)
            entries["truth"] = np.where(known, entry, unknown)
            entries["error"] = np.where(known, np.where(wrong, ramp_entry(error, MAX_ERROR), STATIC), unknown)
            important = moving | moves | wrong
        kept = self._thin(position, important, ground)
        units = np.rint(position[kept] / _UNIT).astype(np.int16)
        entries = {name: entry[kept].astype(np.uint8) for name, entry in entries.items()}
        self.points.append((units, entries, cluster[kept]))
        self.num_given += len(position)
        near = np.hypot(position[:, 0], position[:, 1]) < _FLOOR_RADIUS
        height = position[near & ground, 2] if (near & ground).any() else np.sort(position[near, 2])[: near.sum() // 10]
        self.floor += [float(np.median(height))] if len(height) else []

        number, start, flow = scene.arrows()
        colors = wheel_entry(flow, self.max_flow).tolist()
        speeds = np.round(np.linalg.norm(flow, axis=1) / scene.interval, 1).tolist()
        pose = np.eye(4) if scene.pose is None else self.frame.move(scene.pose)
        self.frames.append(
            {
                "sweep": scene.index,
                "time": None if scene.timestamp_ns is None else scene.timestamp_ns * 1e-9,
                "interval": round(scene.interval, 4),
                "pose": np.round(pose[:3], 5).ravel().tolist(),  # row-major (3, 4)
                "count": len(units),
                "arrows": list(zip(number.tolist(), _rounded(start), _rounded(ARROW_STEPS * flow), colors, speeds)),
                "boxes": [],
            }
        )

    def add_tracks(self, tracks: Mapping[str, np.ndarray]) -> None:
        """Add the boxes of tracks, and give the points of a track its colour in all sweeps."""
        for frame, (_, entries, cluster) in zip(self.frames, self.points):
            is_now = tracks["sweep"] == frame["sweep"]
            rows = {name: values[is_now] for name, values in tracks.items()}
            centre, heading = self.frame.boxes(rows)
            size = np.stack([rows[name] for name in ("length", "width", "height")], 1)
            speed = np.hypot(rows["vx"], rows["vy"])
            columns = (_rounded(centre), _rounded(size), np.round(heading, 3).tolist(), np.round(speed, 1).tolist())
            frame["boxes"] = list(zip(rows["id"].tolist(), *columns))
            for track, number in zip(rows["id"].tolist(), rows["cluster_id"].tolist()):
                if number >= 0:
                    entries["object"][cluster == number] = FIRST + track % len(PALETTE)

    def content(self) -> dict[str, Any]:
        """The input of the page's script: frames, colourings, and the points of each frame, compressed."""
        interval = float(np.median([frame["interval"] for frame in self.frames]))
        present = set().union(*(entries for _, entries, _ in self.points))
        chosen = [row for row in colorings.make_colorings(self.max_flow, interval) if row["name"] in present]
        for frame, (units, entries, _) in zip(self.frames, self.points):
            missing = np.where(entries["flow"] == GROUND, GROUND, UNKNOWN).astype(np.uint8)
            frame["data"] = packed(_planes(units, [entries.get(c["name"], missing) for c in chosen]))
        shown, side = sum(frame["count"] for frame in self.frames), self.voxel
        T = self.frame.T_world_viewer
        return {
            "frames": self.frames,
            "colorings": chosen,
            "unit": _UNIT,
            "levels": colorings.LEVELS,
            "floor": float(np.median(self.floor)) if self.floor else 0.0,
            "ego": EGO_OUTLINE,
            "north": None if T is None else float(np.arctan2(T[1, 1], T[1, 0])),  # of the world's y axis, viewer frame
            "steps": ARROW_STEPS,
            "thinned": f"{shown:,} of {self.num_given:,} points are drawn: all that move, by estimate or truth, all "
            f"with an error above {MIN_ERROR:g} m, and one other point per voxel of {side:g} m ({2 * side:g} m on the "
            f"ground). Positions are rounded to {_UNIT * 100:g} cm.",
        }

    def _thin(self, position: np.ndarray, important: np.ndarray, ground: np.ndarray) -> np.ndarray:
        """Indices of the points to keep, neighbours together: all important ones, and the first other one per voxel."""
        in_reach = (np.abs(position) < _REACH).all(axis=1)
        other = np.flatnonzero(in_reach & ~important)
        side = np.where(ground[other], 2 * self.voxel, self.voxel)[:, None]
        voxel = np.floor(position[other] / side).astype(np.int64)
        key = ((voxel[:, 0] * (1 << 20) + voxel[:, 1]) * (1 << 20) + voxel[:, 2]) * 2 + ground[other]
        kept = np.concatenate([np.flatnonzero(in_reach & important), other[np.unique(key, return_index=True)[1]]])
        cell = np.floor(position[kept, :2] / _SORT)
        return kept[np.lexsort((position[kept, 2], cell[:, 1], cell[:, 0]))]


def _planes(units: np.ndarray, entries: Sequence[np.ndarray]) -> bytes:
    """Bytes of a frame: per axis the low and the high bytes of differences between points, then the entries."""
    steps = np.diff(units, axis=0, prepend=np.zeros((1, 3), np.int16)).astype("<i2")
    axes = [steps[:, axis].copy().view(np.uint8).reshape(-1, 2).T.tobytes() for axis in range(3)]
    return b"".join(axes + [entry.tobytes() for entry in entries])


def packed(content: bytes) -> str:
    """Compress bytes, and write them as text."""
    return base64.b64encode(zlib.compress(content, 9)).decode()


def _rounded(values: np.ndarray) -> list[Any]:
    return np.round(values, 2).tolist()
