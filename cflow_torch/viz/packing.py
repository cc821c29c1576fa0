"""Points, colours, arrows and boxes of a drive, thinned and packed for a page.

Each colouring of a page has a palette. A point has one byte per colouring: the index of its colour in the palette.
"""

from __future__ import annotations

import base64
import zlib
from typing import Any, Iterator, Mapping, Sequence

import numpy as np

from cflow_torch.types import CENTRE, MIN_MOVING, SIZE, CFlowError, vectors
from cflow_torch.viz.clusters import PALETTE, cluster_colors
from cflow_torch.viz.panel import ARROW_STEPS, EGO_OUTLINE, MAX_ERROR, MIN_ERROR, has_flow
from cflow_torch.viz.scene import ViewedPair, ViewerFrame
from cflow_torch.viz.wheel import flow_to_rgb

_UNIT = 0.01  # metres; 16 bits reach to 327 m
_REACH = 32000 * _UNIT
_SORT = 2.0  # metres, side of a cell; we store the points of a cell together, which compresses better
_FLOOR_RADIUS = 15.0  # metres; the points this near the vehicle give the height of the range rings
STATIC, GROUND, UNKNOWN, FIRST = 0, 1, 2, 3  # indices of greys that the page chooses; a palette begins at FIRST
_HUES, _LEVELS = 36, 6  # hues, and levels of length; one more level is for flow longer than max_flow
_PALEST = 0.35  # least saturation, so that slow motion is visible on a light page
_FADED, _GREY = 0.15, 140  # we mix this share of a static object's colour with a grey that both themes show
_TRACK_COLUMNS = ("id", "sweep", "cluster_id", "class", "num_points", *CENTRE, *SIZE, "heading", "vx", "vy")
_STEPS = 64  # colours of a ramp
_RAMP = np.array([(66, 125, 245), (38, 190, 205), (112, 205, 80), (250, 200, 40), (235, 60, 45)], float)


class PackedDrive:
    """Thinned scenes of one drive, with the colours of points as indices into palettes.

    A flow of `max_flow`, metres per sweep, has full colour. We keep one static point in each voxel of side `voxel`,
    metres; voxels on the ground have twice that side.
    """

    def __init__(self, max_flow: float, voxel: float) -> None:
        for name, value in {"max_flow": max_flow, "voxel": voxel}.items():
            if not 0 < value < np.inf:
                raise CFlowError(f"{name}={value}: give a positive length in metres")
        self.max_flow = max_flow
        self.voxel = voxel
        self.frame = ViewerFrame()
        self.frames: list[dict[str, Any]] = []
        self.points: list[tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]] = []  # units, colours, cluster
        self.moving: list[dict[int, float]] = []  # P(moving) of each cluster of each frame, mean of its points
        self.num_given = 0
        self.floor: list[float] = []

    def add(self, scene: ViewedPair) -> None:
        """Thin one pair and choose its colours."""
        ground = scene.is_ground
        cluster = np.where(ground, -1, scene.cluster)
        entries, important = self._entries(scene, cluster)
        kept = self._thin(scene.position, important, ground)
        units = np.rint(scene.position[kept] / _UNIT).astype(np.int16)
        self.points.append(
            (units, {name: entry[kept].astype(np.uint8) for name, entry in entries.items()}, cluster[kept])
        )
        self.moving.append(_cluster_means(cluster, scene.moving))
        self.num_given += len(scene.position)
        self.floor += _floor_height(scene.position, ground)
        pose = np.eye(4) if scene.pose is None else self.frame.move(scene.pose)
        self.frames.append(
            {
                "sweep": scene.index,
                "time": None if scene.timestamp_ns is None else scene.timestamp_ns * 1e-9,
                "interval": round(scene.interval, 4),
                "pose": np.round(pose[:3], 5).ravel().tolist(),  # row-major (3, 4)
                "count": len(units),
                "arrows": self._arrows(scene),
                "boxes": [],
            }
        )

    def _entries(self, scene: ViewedPair, cluster: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Choose the colours of all points, and return which points must not be thinned, (N,) bool."""
        ground = scene.is_ground
        speed = np.linalg.norm(scene.residual, axis=1)
        static = np.where(ground, GROUND, STATIC)
        moving = ~ground & has_flow(scene.residual)  # the page asks for P(moving), too
        entries = {
            "flow": np.where(moving, _wheel_entry(scene.residual, self.max_flow), static),
            "speed": np.where(moving, _ramp_entry(speed, self.max_flow), static),
            "object": _object_entry(scene.position, cluster, ~ground & scene.is_moving, static),
        }
        if scene.confidence is not None:
            entries["confidence"] = np.where(ground, GROUND, _ramp_entry(1 - scene.confidence, 1.0))
        if scene.moving is not None:
            entries["moving"] = np.where(ground, GROUND, _ramp_entry(scene.moving, 1.0))
        if scene.truth is None:
            return entries, moving

        length = np.linalg.norm(scene.truth, axis=1)
        error = np.linalg.norm(scene.residual - scene.truth, axis=1)
        unknown = np.where(ground, GROUND, UNKNOWN)
        known = ~ground & np.isfinite(length)
        moves = known & has_flow(scene.truth)
        wrong = known & (error > MIN_ERROR)
        true_entry = np.where(moves, _wheel_entry(scene.truth, self.max_flow), STATIC)
        entries["truth"] = np.where(known, true_entry, unknown)
        entries["error"] = np.where(known, np.where(wrong, _ramp_entry(error, MAX_ERROR), STATIC), unknown)
        return entries, moving | moves | wrong

    def _arrows(self, scene: ViewedPair) -> list[dict[str, Any]]:
        """List the arrows: one per cluster with enough moving points."""
        number, start, flow = scene.arrows(has_flow(scene.residual))
        columns = {
            "cluster": number.tolist(),
            "start": _rounded(start),
            "ahead": _rounded(ARROW_STEPS * flow),
            "entry": _wheel_entry(flow, self.max_flow).tolist(),
            "speed": np.round(np.linalg.norm(flow, axis=1) / scene.interval, 1).tolist(),
            "moving": [self.moving[-1].get(cluster) for cluster in number.tolist()],
        }
        return _records(columns)

    def add_tracks(self, tracks: Mapping[str, np.ndarray]) -> None:
        """Add the boxes of tracks. The points of a track get the same colour in all sweeps."""
        missing = [name for name in _TRACK_COLUMNS if name not in tracks]
        if missing:
            raise CFlowError(f"tracks lack {', '.join(missing)}: give the table that `cflow_torch.track` returns")
        for frame, moving, (_, entries, cluster) in zip(self.frames, self.moving, self.points):
            is_now = tracks["sweep"] == frame["sweep"]
            rows = {name: values[is_now] for name, values in tracks.items()}
            centre, heading = self.frame.boxes(rows)
            clusters = rows["cluster_id"].tolist()
            columns = {
                "id": rows["id"].tolist(),
                "kind": rows["class"].tolist(),
                "centre": _rounded(centre),
                "size": _rounded(vectors(rows, SIZE)),
                "heading": np.round(heading, 3).tolist(),
                "speed": np.round(np.hypot(rows["vx"], rows["vy"]), 1).tolist(),
                "points": rows["num_points"].tolist(),
                "moving": [moving.get(number) for number in clusters],
            }
            frame["boxes"] = _records(columns)
            for track, number in zip(columns["id"], clusters):
                if number >= 0:
                    entries["object"][cluster == number] = FIRST + track % len(PALETTE)

    def clouds(self) -> Iterator[str]:
        """The points of each frame and their entries in the colourings of `content`, compressed, as texts."""
        names = [coloring["name"] for coloring in self._shown_colorings()]
        for units, entries, _ in self.points:
            missing = np.where(entries["flow"] == GROUND, GROUND, UNKNOWN).astype(np.uint8)
            yield packed(_planes(units, [entries.get(name, missing) for name in names]))

    def _shown_colorings(self) -> list[dict[str, Any]]:
        """Return the colourings that the page offers."""
        interval = float(np.median([frame["interval"] for frame in self.frames]))
        present = set().union(*(entries for _, entries, _ in self.points))
        return [row for row in _colorings(self.max_flow, interval) if row["name"] in present]

    def content(self) -> dict[str, Any]:
        """The input of the page's script: frames without their points, colourings, and texts."""
        chosen = self._shown_colorings()
        shown = sum(frame["count"] for frame in self.frames)
        side = self.voxel
        T = self.frame.T_world_viewer
        return {
            "frames": self.frames,
            "colorings": chosen,
            "unit": _UNIT,
            "levels": _LEVELS,
            "floor": float(np.median(self.floor)) if self.floor else 0.0,
            "ego": EGO_OUTLINE,
            "north": None if T is None else float(np.arctan2(T[1, 1], T[1, 0])),  # of the world's y axis, viewer frame
            "steps": ARROW_STEPS,
            "chances": _STEPS if any(each["name"] == "moving" for each in chosen) else 0,
            "likely": MIN_MOVING,
            "thinned": f"{shown:,} of {self.num_given:,} points are drawn: within {_REACH:g} m, all that move, by "
            f"estimate or truth, all with an error above {MIN_ERROR:g} m, and one other point per voxel of {side:g} m "
            f"({2 * side:g} m on the ground). Positions are rounded to {_UNIT * 100:g} cm.",
        }

    def _thin(self, position: np.ndarray, important: np.ndarray, ground: np.ndarray) -> np.ndarray:
        """Return the rows to keep, neighbours together: all important ones, and the first other one of each voxel."""
        in_reach = (np.abs(position) < _REACH).all(axis=1)
        other = np.flatnonzero(in_reach & ~important)
        side = np.where(ground[other], 2 * self.voxel, self.voxel)[:, None]
        voxel = np.floor(position[other] / side).astype(np.int64)
        key = ((voxel[:, 0] * (1 << 20) + voxel[:, 1]) * (1 << 20) + voxel[:, 2]) * 2 + ground[other]
        kept = np.concatenate([np.flatnonzero(in_reach & important), other[np.unique(key, return_index=True)[1]]])
        cell = np.floor(position[kept, :2] / _SORT)
        return kept[np.lexsort((position[kept, 2], cell[:, 1], cell[:, 0]))]


def _cluster_means(cluster: np.ndarray, values: np.ndarray | None) -> dict[int, float]:
    """Return cluster -> mean of the (N,) values of its points, to 2 decimals; {} without values."""
    if values is None:
        return {}
    is_known = (cluster >= 0) & np.isfinite(values)
    numbers, group = np.unique(cluster[is_known], return_inverse=True)
    means = np.bincount(group, values[is_known]) / np.bincount(group)
    return dict(zip(numbers.tolist(), np.round(means, 2).tolist()))


def _records(columns: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """Return a dictionary for each row of a table."""
    return [dict(zip(columns, row)) for row in zip(*columns.values())]


def _floor_height(position: np.ndarray, ground: np.ndarray) -> list[float]:
    """Return the height of the floor near the vehicle, metres; nothing if there are no points."""
    near = np.hypot(position[:, 0], position[:, 1]) < _FLOOR_RADIUS
    height = np.sort(position[near, 2])[: near.sum() // 10]
    if (near & ground).any():
        height = position[near & ground, 2]
    return [float(np.median(height))] if len(height) else []


def _planes(units: np.ndarray, entries: Sequence[np.ndarray]) -> bytes:
    """Return the low, then the high bytes of the steps from point to point, axis by axis; then the entries."""
    steps = np.diff(units, axis=0, prepend=np.zeros((1, 3), np.int16)).astype("<i2")
    axes = [steps[:, axis].copy().view(np.uint8).reshape(-1, 2).T.tobytes() for axis in range(3)]
    return b"".join(axes + [entry.tobytes() for entry in entries])


def packed(content: bytes) -> str:
    """Compress bytes, and write them as text."""
    return base64.b64encode(zlib.compress(content, 9)).decode()


def _rounded(values: np.ndarray) -> list[Any]:
    return np.round(values, 2).tolist()


def _colorings(max_flow: float, interval: float) -> list[dict[str, Any]]:
    """All colourings of the page, with palettes and legends; the rim of the wheel is `max_flow`, metres per sweep."""
    speed = max_flow / interval
    rim = f"right: ahead of the vehicle; rim: {max_flow:.4g} m per sweep, {speed:.3g}\u00a0m/s"
    faded = np.rint(_FADED * PALETTE + (1 - _FADED) * _GREY).astype(np.uint8)
    wheel = _wheel().tolist()
    ramp = _ramp().tolist()
    objects = np.concatenate([PALETTE, faded]).tolist()
    likely = "probability of an error below 0.1 m"
    rows = (
        # name, text, palette, scale, note, meaning of the greys
        ("flow", "residual flow", wheel, None, rim, ("static", "ground", "")),
        ("speed", "speed over ground", ramp, (0, speed, "m/s"), "", ("static", "ground", "")),
        ("object", "object", objects, None, "bright: moving or tracked; pale: static", ("no object", "ground", "")),
        ("confidence", "confidence", ramp, (1, 0, ""), likely, ("", "ground", "unknown")),
        ("moving", "P(moving)", ramp, (0, 1, ""), "probability that a point moves", ("", "ground", "unknown")),
        ("truth", "true flow", wheel, None, rim, ("static", "ground", "unknown")),
        ("error", "end-point error", ramp, (0, MAX_ERROR, "m"), "", (f"below {MIN_ERROR:g} m", "ground", "unknown")),
    )
    return [dict(zip(("name", "text", "palette", "scale", "note", "keys"), row)) for row in rows]


def _wheel() -> np.ndarray:
    """(_HUES * (_LEVELS + 1), 3) uint8 colours of the wheel: for each hue, from slow to longer than max_flow."""
    angle = (np.arange(_HUES) + 0.5) * (2 * np.pi / _HUES)
    length = np.append(np.maximum(np.arange(1, _LEVELS + 1) / _LEVELS, _PALEST), 1.3)
    flow = np.stack([np.cos(angle)[:, None] * length, np.sin(angle)[:, None] * length], axis=-1)
    return flow_to_rgb(flow, 1.0).reshape(-1, 3)


def _wheel_entry(flow: np.ndarray, max_flow: float) -> np.ndarray:
    """(N,) int64 entries of `_wheel`."""
    flow = np.nan_to_num(flow)
    hue = np.floor(np.arctan2(flow[:, 1], flow[:, 0]) % (2 * np.pi) * (_HUES / (2 * np.pi))).astype(np.int64)
    level = np.ceil(np.hypot(flow[:, 0], flow[:, 1]) / max_flow * _LEVELS).astype(np.int64)
    return FIRST + hue.clip(0, _HUES - 1) * (_LEVELS + 1) + (level - 1).clip(0, _LEVELS)


def _ramp() -> np.ndarray:
    """(_STEPS, 3) uint8 colours, from low to high values."""
    at = np.linspace(0, len(_RAMP) - 1, _STEPS)
    return np.stack([np.interp(at, np.arange(len(_RAMP)), c) for c in _RAMP.T], axis=1).astype(np.uint8)


def _ramp_entry(value: np.ndarray, most: float) -> np.ndarray:
    """(N,) int64 entries of `_ramp`."""
    return FIRST + (np.nan_to_num(value) / most * _STEPS).clip(0, _STEPS - 1).astype(np.int64)


def _object_entry(position: np.ndarray, cluster: np.ndarray, moving: np.ndarray, static: np.ndarray) -> np.ndarray:
    """(N,) int64 entries; `static` for points in no cluster. A cluster is pale if less than half of it moves."""
    colors = cluster_colors(position, cluster, (0, 0, 0))
    _, number, size = np.unique(cluster, return_inverse=True, return_counts=True)
    is_pale = 2 * np.bincount(number, moving) < size
    entry = FIRST + (colors[:, None] == PALETTE).all(axis=2).argmax(axis=1) + len(PALETTE) * is_pale[number]
    return np.where(cluster >= 0, entry, static)
