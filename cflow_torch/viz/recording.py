"""Recordings for the viewer rerun (extra `rerun`): points, flow, clusters, truth and ego motion on a timeline."""

from __future__ import annotations

import uuid
from functools import partial
from pathlib import Path
from typing import Any, Iterable, Mapping

import numpy as np

from cflow_torch.data.atomic import atomic_name
from cflow_torch.data.log import Log
from cflow_torch.errors import import_optional
from cflow_torch.types import SIZE, CFlowError, FlowResult, Sweep, as_numpy, vectors
from cflow_torch.viz.clusters import cluster_colors
from cflow_torch.viz.panel import ARROW_STEPS, EGO_OUTLINE, has_flow
from cflow_torch.viz.scene import MAX_FLOW, ViewedPair, ViewerFrame
from cflow_torch.viz.style import checked_path
from cflow_torch.viz.wheel import flow_to_rgb

EGO = "world/ego_vehicle"
ESTIMATE, TRUTH = f"{EGO}/lidar/cflow", f"{EGO}/lidar/ground_truth"
CLUSTERS, ARROWS = f"{EGO}/lidar/clusters", f"{EGO}/arrows"
TRACKS = "world/tracks"
GROUND, NEXT_SWEEP = f"{EGO}/lidar/ground", f"{EGO}/lidar/next_sweep"
_DOT, _FINE_DOT = -1.5, -0.8  # negative radii are pixels of the screen
_STATIC, _GROUND_COLOR, _NEXT_COLOR = (132, 138, 147), (70, 74, 81), (60, 110, 130)
_EGO_COLOR = (255, 255, 255)
_NO_CLUSTER = (100, 105, 112)
_BACKGROUND = (22, 25, 30)
_CALENDAR = 10**17  # nanoseconds; a larger time stamp is a date (1973 or later), a smaller one a duration


def record_log(
    log: Log,
    results: Iterable[tuple[int, FlowResult]],
    path: str | Path,
    *,
    max_flow: float = MAX_FLOW,
    tracks: Mapping[str, np.ndarray] | None = None,
) -> int:
    """Save a drive as .rrd for the viewer rerun. The file appears complete or not at all.

    Args:
        log, results: as for `save_page`.
        path: ends in .rrd. Its folder is created if it does not exist; an older file is replaced.
        max_flow: residual flow with the full colour, metres per sweep, for the whole drive. Faster flow is darker.
        tracks: table of `cflow_torch.track`; the boxes at sweep t are shown with ids and speeds.

    Returns:
        Number of pairs in the recording.

    Convention:
        The frame of `world` is the ego frame at t+1 of the first pair with poses. world/trajectory is the path of the
        vehicle, and world/tracks has the boxes of `tracks`. The frame of world/ego_vehicle is the ego frame at t+1 of
        the current pair. It holds arrows (one per moving cluster, `panel.ARROW_STEPS` sweeps long) and these points:
        - lidar/cflow: points of t, moved by the ego motion and coloured by residual flow, grey if static
        - lidar/ground_truth: points of t with known truth, coloured by the true residual flow
        - lidar/clusters, lidar/ground: points of t, moved likewise; lidar/next_sweep: points of t+1
        Timelines: `sweep`, the index; `time`, if sweeps have time stamps.

    Raises:
        CFlowError: rerun-sdk is not installed, the path does not end in .rrd, `max_flow` is not positive, there is no
            result, or a result and its sweep differ in length.
        OSError: the log cannot be read, or the file cannot be written. An error of `results` is passed on.

    Cost: on disk about 20 bytes per point and pair for each entity that shows the point.
    """
    path = checked_path(path, ".rrd")
    rr = load_rerun()
    with atomic_name(path) as temporary:
        stream = rr.RecordingStream("cflow_torch", recording_id=f"{log.log_id}-{uuid.uuid4().hex}")
        stream.save(temporary)
        try:
            drive = _Drive(rr, stream, max_flow)
            for i, result in results:
                pc0 = log.sweep(i)
                pc1 = log.sweep(i + 1)
                drive.add(ViewedPair.of(i, pc0, pc1, result, log.labels(i)), pc1)
                if tracks is not None:
                    drive.add_tracks({name: values[tracks["sweep"] == i] for name, values in tracks.items()})
            drive.end(log.log_id)
            stream.flush()
        finally:
            stream.disconnect()
    return drive.count


def load_rerun() -> Any:
    """Import rerun; a missing package is a `CFlowError`."""
    return import_optional(
        "rerun", "recordings need rerun-sdk (extra rerun, Python 3.9 or newer): pip install 'rerun-sdk>=0.23'"
    )


class _Drive:
    """Log one drive to a `stream` of rerun, the package `rr`. Flow of `max_flow` metres per sweep has full colour."""

    def __init__(self, rr: Any, stream: Any, max_flow: float) -> None:
        self.rr = rr
        self.stream = stream
        self.max_flow = max_flow
        self.log = partial(stream.log, strict=True)
        self.count = 0
        self.has_truth = False
        self.frame = ViewerFrame()
        self.trajectory: list[np.ndarray] = []

    def add(self, scene: ViewedPair, pc1: Sweep) -> None:
        """Log one pair; `pc1` is its sweep t+1."""
        rr = self.rr
        position = scene.position
        is_ground = scene.is_ground
        self.stream.set_time("sweep", sequence=scene.index)
        if scene.timestamp_ns is not None and scene.timestamp_ns >= _CALENDAR:
            self.stream.set_time("time", timestamp=np.datetime64(int(scene.timestamp_ns), "ns"))
        elif scene.timestamp_ns is not None:
            self.stream.set_time("time", duration=np.timedelta64(int(scene.timestamp_ns), "ns"))
        if scene.pose is not None:
            moved = self.frame.move(scene.pose)
            self.trajectory.append(moved[:3, 3])
            self.log(EGO, rr.Transform3D(translation=moved[:3, 3], mat3x3=moved[:3, :3]))
        shown = position[~is_ground]
        self._points(ESTIMATE, shown, self._color(scene.residual[~is_ground], scene.is_moving[~is_ground]))
        self._points(CLUSTERS, shown, cluster_colors(shown, scene.cluster[~is_ground], _NO_CLUSTER))
        self._points(GROUND, position[is_ground], _GROUND_COLOR, _FINE_DOT)
        after = as_numpy(pc1.points)[:, :3]
        self._points(NEXT_SWEEP, after[np.isfinite(after).all(axis=1)], _NEXT_COLOR, _FINE_DOT)
        if scene.truth is not None or self.has_truth:  # an empty cloud clears the truth of an earlier pair
            self.has_truth = True
            truth = np.full_like(position, np.nan) if scene.truth is None else scene.truth
            is_known = ~is_ground & np.isfinite(truth).all(axis=1)
            self._points(TRUTH, position[is_known], self._color(truth[is_known], has_flow(truth[is_known])))

        numbers, start, vector = scene.arrows(scene.is_moving)
        arrows = rr.Arrows3D(
            origins=start,
            vectors=ARROW_STEPS * vector,
            colors=flow_to_rgb(vector, self.max_flow),
            radii=0.12,
            labels=[f"cluster {n}: {np.linalg.norm(v):.2f} m per sweep" for n, v in zip(numbers, vector)],
            show_labels=False,
        )
        self.log(ARROWS, arrows)
        self.count += 1

    def add_tracks(self, rows: Mapping[str, np.ndarray]) -> None:
        """Log the boxes of the last pair, at sweep t, in the world."""
        centre, heading = self.frame.boxes(rows)
        rotation = np.zeros((len(heading), 4))  # quaternions x, y, z, w
        rotation[:, 2], rotation[:, 3] = np.sin(heading / 2), np.cos(heading / 2)
        boxes = self.rr.Boxes3D(
            centers=centre,
            half_sizes=vectors(rows, SIZE) / 2,
            quaternions=rotation,
            colors=cluster_colors(centre, rows["id"], _NO_CLUSTER),
            labels=[f"{n}: {np.hypot(x, y):.1f} m/s" for n, x, y in zip(rows["id"], rows["vx"], rows["vy"])],
        )
        self.log(TRACKS, boxes)

    def end(self, log_id: str) -> None:
        """Log the trajectory and the layout of the viewer."""
        if not self.count:
            raise CFlowError(f"{log_id}: there is no pair to record")
        rr = self.rr
        self.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        outline = np.pad(EGO_OUTLINE + EGO_OUTLINE[:1], ((0, 0), (0, 1)))
        self.log(f"{EGO}/outline", rr.LineStrips3D([outline], colors=_EGO_COLOR, radii=0.05), static=True)
        if len(self.trajectory) > 1:
            path = rr.LineStrips3D([np.stack(self.trajectory)], colors=_GROUND_COLOR, radii=0.05)
            self.log("world/trajectory", path, static=True)
        self.stream.send_blueprint(self._layout())

    def _points(self, entity: str, position: np.ndarray, colors: Any, radius: float = _DOT) -> None:
        self.log(entity, self.rr.Points3D(position.astype(np.float32), colors=colors, radii=radius))

    def _color(self, flow: np.ndarray, moves: np.ndarray) -> np.ndarray:
        color = flow_to_rgb(flow, self.max_flow)
        color[~moves] = _STATIC
        return color

    def _layout(self) -> Any:
        """Lay out the viewer: the estimate on the left, truth and clusters on the right."""
        import rerun.blueprint as rrb

        def view(name: str, *hidden: str) -> Any:
            contents = ["+ /world/**", *(f"- /{entity}/**" for entity in hidden)]
            return rrb.Spatial3DView(origin=EGO, contents=contents, name=name, background=_BACKGROUND)

        estimate = view("estimate", TRUTH, CLUSTERS, NEXT_SWEEP)
        over_next = view("estimate and sweep t+1", TRUTH, CLUSTERS, GROUND)
        right = [view("clusters", ESTIMATE, TRUTH, NEXT_SWEEP, ARROWS)]
        if self.has_truth:
            right.insert(0, view("ground truth", ESTIMATE, CLUSTERS, NEXT_SWEEP, ARROWS))
        parts = rrb.Horizontal(rrb.Tabs(estimate, over_next), rrb.Vertical(*right), column_shares=[2, 1])
        return rrb.Blueprint(parts, collapse_panels=True)
