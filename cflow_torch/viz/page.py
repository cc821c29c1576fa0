"""One self-contained .html of a drive (extra `html`): points and flow in 3-D with a time slider, drawn by k3d."""

from __future__ import annotations

import base64
import json
import zlib
from functools import lru_cache
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Callable, Iterable, Mapping, Sequence

import numpy as np

from cflow_torch import __version__
from cflow_torch.data.atomic import write_text
from cflow_torch.data.log import FlowLabels, Log
from cflow_torch.types import CFlowError, FlowResult, Window
from cflow_torch.viz.clusters import PALETTE
from cflow_torch.viz.colorings import (
    FIRST,
    GROUND,
    LEVELS,
    STATIC,
    UNKNOWN,
    make_colorings,
    object_entry,
    ramp_entry,
    wheel_entry,
)
from cflow_torch.viz.panel import ARROW_STEPS, MAX_ERROR, MIN_ERROR, MOVING
from cflow_torch.viz.scene import EGO_OUTLINE, MAX_FLOW, Scene, ViewerFrame

VOXEL = 0.1  # metres
_UNIT = 0.01  # metres; 16 bits reach to 327 m
_REACH = 32000 * _UNIT
_SORT = 2.0  # metres; points of a cell are stored together, which compresses better
_FLOOR_RADIUS = 15.0  # metres; the ground near the vehicle has the height of the rings
_TEMPLATE = Path(__file__).parent / "page.html"

Labels = FlowLabels
Tracks = Mapping[str, np.ndarray]


class Page:
    """A page with a drive. In a notebook it shows itself; `html` is its text.

    Args:
        html: the whole page.
        num_pairs: number of pairs in it.
    """

    def __init__(self, html: str, num_pairs: int) -> None:
        self.html, self.num_pairs = html, num_pairs

    def save(self, path: str | Path) -> Path:
        """Write the page. The file appears complete or not at all; an older one is replaced.

        Raises:
            CFlowError: the path does not end in .html.
            OSError: the file cannot be written.
        """
        write_text(_checked(path), self.html)
        return Path(path)

    def _repr_html_(self) -> str:
        frame = "width:100%;height:600px;border:0;border-radius:8px"
        return f'<iframe srcdoc="{escape(self.html)}" style="{frame}" allowfullscreen></iframe>'


def show(
    windows: Window | Sequence[Window],
    results: FlowResult | Sequence[FlowResult],
    *,
    labels: FlowLabels | None | Sequence[FlowLabels | None] = None,
    tracks: Tracks | None = None,
    title: str = "CorrelationFlow",
    preset: str | None = None,
    max_flow: float = MAX_FLOW,
    voxel: float = VOXEL,
) -> Page:
    """Show one pair or several consecutive ones in 3-D: in a notebook inline, elsewhere with `show(...).save(path)`.

    Args:
        windows: one window, or a list; only pc0 and pc1 are used.
        results: its flow, or a list of the same length.
        labels: its labels, or a list of the same length; None = no labels.
        tracks: table of `cflow_torch.track`, whose column `sweep` counts the windows from 0.
        title, preset: in the heading.
        max_flow: residual flow with the full colour, metres per sweep. Faster flow is darker.
        voxel: side of the cubes of which each keeps one static point, metres; twice as large for ground.

    Raises:
        CFlowError: k3d is not installed, lists differ in length or are empty, or a value is not allowed.
    """
    sweeps = [windows] if isinstance(windows, Window) else list(windows)
    flows = [results] if isinstance(results, FlowResult) else list(results)
    given: list[Any] = [labels] * len(sweeps) if labels is None or isinstance(labels, Labels) else list(labels)
    if not len(sweeps) == len(flows) == len(given):
        raise CFlowError(f"{len(sweeps)} windows, {len(flows)} results, {len(given)} labels: give one of each per pair")
    scenes = (Scene.of(i, w.pc0, w.pc1, r, t) for i, (w, r, t) in enumerate(zip(sweeps, flows, given)))
    return _page(scenes, lambda: tracks, title, preset, max_flow, voxel)


def save_page(
    log: Log,
    results: Iterable[tuple[int, FlowResult]],
    path: str | Path,
    *,
    tracks: Callable[[], Tracks | None] = lambda: None,
    preset: str | None = None,
    max_flow: float = MAX_FLOW,
    voxel: float = VOXEL,
) -> int:
    """Save a drive as one .html that any browser opens without a network.

    Args:
        log: the drive. We read its sweeps again, and its labels if it has any.
        results: (index, flow of sweep `index` to `index + 1`) in ascending order, taken one by one.
        path: ends in .html. Its folder is created if it does not exist; an older file is replaced.
        tracks: returns a table of `cflow_torch.track`, or None; called after the last result.
        preset, max_flow, voxel: as in `show`.

    Returns:
        Number of pairs in the page.

    Raises:
        CFlowError: as in `show`; the path does not end in .html; there is no result.
        OSError: the log cannot be read, or the file cannot be written. An error of `results` is passed on.

    Cost: on disk about 0.3 MB per sweep of 100,000 points, and 1.2 MB for k3d; 1 MB of memory per sweep.
    """
    _checked(path)
    scenes = (Scene.of(i, log.sweep(i), log.sweep(i + 1), result, log.labels(i)) for i, result in results)
    page = _page(scenes, tracks, log.log_id, preset, max_flow, voxel)
    page.save(path)
    return page.num_pairs


def load_k3d() -> str:
    """Read the JavaScript of k3d, packed for a page, without importing the package.

    Raises:
        CFlowError: k3d is not installed, or too old.
    """
    found = find_spec("k3d")
    script = Path(found.origin or "").parent / "static" / "standalone.js" if found else None
    if script is None or not script.is_file():
        raise CFlowError("pages need k3d (Python 3.9 or newer): pip install 'k3d>=3.2', or give format=rerun")
    return _packed_file(script)


@lru_cache(maxsize=1)
def _packed_file(path: Path) -> str:
    return _packed(path.read_bytes())


def _checked(path: str | Path) -> Path:
    if Path(path).suffix.lower() != ".html":
        raise CFlowError(f"{path} does not end in .html: give a file that does")
    return Path(path)


def _page(
    scenes: Iterable[Scene],
    tracks: Callable[[], Tracks | None],
    title: str,
    preset: str | None,
    max_flow: float,
    voxel: float,
) -> Page:
    """Pack the scenes and fill in the template."""
    for name, value in {"max_flow": max_flow, "voxel": voxel}.items():
        if not 0 < value < np.inf:
            raise CFlowError(f"{name}={value}: give a positive length in metres")
    library = load_k3d()
    drive = _Drive(max_flow, voxel)
    for scene in scenes:
        drive.add(scene)
    if not drive.frames:
        raise CFlowError(f"{title}: there is no pair to show")
    table = tracks()
    if table is not None:
        drive.add_tracks(table)
    about = {"title": title, "preset": preset, "version": __version__}
    text = _TEMPLATE.read_text(encoding="utf-8")
    # "<" is escaped, so a name in the data cannot end the script that holds it.
    data = json.dumps({**about, **drive.content()}, separators=(",", ":")).replace("<", "\\u003c")
    for mark, content in {"[TITLE]": escape(title), "[K3D]": library, "[DATA]": data}.items():
        text = text.replace(mark, content)
    return Page(text, len(drive.frames))


class _Drive:
    """Thinned scenes of one drive, and their colours as entries of palettes."""

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
        entries = {
            "flow": np.where(moving, wheel_entry(scene.residual, self.max_flow), static),
            "speed": np.where(moving, ramp_entry(speed, self.max_flow), static),
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
        cluster = np.where(ground, -1, scene.cluster)[kept]
        entries["object"] = object_entry(position[kept], cluster, ground[kept])
        self.points.append((units, entries, cluster))
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

    def add_tracks(self, tracks: Tracks) -> None:
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
        """What the page's script reads: frames, colourings, and the points of each frame, compressed."""
        interval = float(np.median([frame["interval"] for frame in self.frames]))
        colorings = [
            coloring
            for coloring in make_colorings(self.max_flow, interval)
            if any(coloring["name"] in entries for _, entries, _ in self.points)
        ]
        for frame, (units, entries, _) in zip(self.frames, self.points):
            missing = np.where(entries["flow"] == GROUND, GROUND, UNKNOWN).astype(np.uint8)
            frame["data"] = _packed(_planes(units, [entries.get(c["name"], missing) for c in colorings]))
        shown, side = sum(frame["count"] for frame in self.frames), self.voxel
        T = self.frame.T_world_viewer
        return {
            "frames": self.frames,
            "colorings": colorings,
            "unit": _UNIT,
            "levels": LEVELS,
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


def _packed(content: bytes) -> str:
    return base64.b64encode(zlib.compress(content, 9)).decode()


def _rounded(values: np.ndarray) -> list[Any]:
    return np.round(values, 2).tolist()
