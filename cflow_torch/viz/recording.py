"""A drive for the viewer rerun (extra `rerun`): points, flow, clusters, truth and ego motion on a timeline."""

from __future__ import annotations

import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any, Iterable, Mapping

import numpy as np

from cflow_torch.data.atomic import atomic_name
from cflow_torch.data.log import FlowLabels, Log
from cflow_torch.types import CFlowError, FlowResult, Sweep, as_numpy
from cflow_torch.viz.clusters import cluster_colors
from cflow_torch.viz.panel import ARROW_STEPS, MIN_ARROW_POINTS, MOVING, group_medians
from cflow_torch.viz.wheel import flow_to_rgb

if TYPE_CHECKING:
    import rerun

EGO = "world/ego_vehicle"
ESTIMATE, TRUTH = f"{EGO}/lidar/cflow", f"{EGO}/lidar/ground_truth"
CLUSTERS, ARROWS = f"{EGO}/lidar/clusters", f"{EGO}/arrows"
TRACKS = "world/tracks"
GROUND, NEXT_SWEEP = f"{EGO}/lidar/ground", f"{EGO}/lidar/next_sweep"
MAX_FLOW = 1.5  # metres per sweep: 15 m/s at 10 Hz
_DOT, _FINE_DOT = -1.5, -0.8  # negative: pixels of the screen
_STATIC, _GROUND_COLOR, _NEXT_COLOR = (132, 138, 147), (70, 74, 81), (60, 110, 130)
_EGO_COLOR = (255, 255, 255)
_NO_CLUSTER = (100, 105, 112)
_BACKGROUND = (22, 25, 30)
_CALENDAR = 10**17  # nanoseconds; later ones are a date (1973 and on), earlier ones a duration


def record_log(
    log: Log,
    results: Iterable[tuple[int, FlowResult]],
    path: str | Path,
    *,
    max_flow: float = MAX_FLOW,
    tracks: Mapping[str, np.ndarray] | None = None,
) -> int:
    """Writes a drive as .rrd, the format of the viewer rerun. The file appears complete or not at all.

    Args:
        log: the drive; its sweeps are read again, and its labels where it has any.
        results: (index, flow of sweep `index` to `index + 1`) in ascending order. Taken one by one, so a generator that
            estimates them needs the memory of one.
        path: ends in .rrd; its folder is made if absent, an older file is replaced.
        max_flow: residual flow with the full colour, metres per sweep; the same for the whole drive. Faster is paler.
        tracks: table of `cflow_torch.track`; its boxes at sweep t are shown with ids and speeds.

    Returns:
        Number of pairs in the recording.

    Convention:
        Entities: world/ego_vehicle moves through the world, whose origin is where the ego vehicle is at the end of the
        first pair; in its frame, which is that of t+1: lidar/cflow (points of t, moved by the ego motion, coloured by
        residual flow; up to `panel.MOVING` grey), lidar/clusters, lidar/ground,
        lidar/next_sweep (points of t+1), lidar/ground_truth (coloured by the true residual flow, where there are
        labels), arrows (one per moving cluster, `panel.ARROW_STEPS` sweeps long). world/trajectory is the way driven,
        world/tracks the boxes of `tracks`.
        Timelines: `sweep`, the index; `time`, where sweeps have times.

    Raises:
        CFlowError: rerun-sdk is absent, another ending, a `max_flow` that is not positive, no result at all,
            or a result with other rows than its sweep.
        OSError: the log cannot be read, or the file not be written. What `results` raises stays as it is, too.

    Cost: about 20 bytes per point and pair on disk for each entity that shows it.
    """
    path = Path(path)
    if not 0 < max_flow < np.inf:
        raise CFlowError(f"max_flow={max_flow}: give a positive length in metres per sweep")
    if path.suffix.lower() != ".rrd":
        raise CFlowError(f"{path} does not end in .rrd: give a file that does")
    rr = load_rerun()
    with atomic_name(path) as temporary:
        stream = rr.RecordingStream("cflow_torch", recording_id=f"{log.log_id}-{uuid.uuid4().hex}")
        stream.save(temporary)
        try:
            drive = _Drive(rr, stream, max_flow)
            for i, result in results:
                drive.add(i, log.sweep(i), log.sweep(i + 1), result, log.labels(i))
                if tracks is not None:
                    drive.add_tracks({name: values[tracks["sweep"] == i] for name, values in tracks.items()})
            drive.end(log.log_id)
            stream.flush()
        finally:
            stream.disconnect()
    return drive.count


def load_rerun() -> Any:
    """The package.

    Raises:
        CFlowError: it is absent.
    """
    try:
        import rerun as rr
    except ImportError as error:
        raise CFlowError("recordings need rerun-sdk (Python 3.9 or newer): pip install 'rerun-sdk>=0.23'") from error
    return rr


class _Drive:
    """What has been logged so far.

    Args:
        rr: the package.
        stream: where to log to.
        max_flow: metres per sweep, full colour.
    """

    def __init__(self, rr: Any, stream: rerun.RecordingStream, max_flow: float) -> None:
        self.rr, self.stream, self.max_flow = rr, stream, max_flow
        self.count = 0
        self.has_truth = False
        self.first_pose: np.ndarray | None = None
        self.trajectory: list[np.ndarray] = []

    def add(self, index: int, pc0: Sweep, pc1: Sweep, result: FlowResult, labels: FlowLabels | None) -> None:
        """Log one pair."""
        rr = self.rr
        points, rows = as_numpy(pc0.points, np.float64)[:, :3], len(result.residual_flow)
        if rows != len(points):
            raise CFlowError(f"pair {index}: the flow has {rows} rows, its sweep {len(points)} points")
        residual, pose_flow = as_numpy(result.residual_flow, np.float64), as_numpy(result.pose_flow, np.float64)
        cluster = as_numpy(result.cluster_id)
        position = points + pose_flow
        ground = np.zeros(rows, bool) if pc0.is_ground is None else as_numpy(pc0.is_ground).astype(bool)
        is_known = np.isfinite(position).all(axis=1)
        shown = is_known & ~ground

        self._set_time(index, pc0.timestamp_ns)
        self._move(pc1.pose)
        self._points(ESTIMATE, position[shown], self._color(residual[shown]))
        self._points(CLUSTERS, position[shown], cluster_colors(position[shown], cluster[shown], _NO_CLUSTER))
        self._points(GROUND, position[is_known & ground], _GROUND_COLOR, _FINE_DOT)
        after = as_numpy(pc1.points)[:, :3]
        self._points(NEXT_SWEEP, after[np.isfinite(after).all(axis=1)], _NEXT_COLOR, _FINE_DOT)
        if labels is not None or self.has_truth:  # a pair without labels must not keep those of an earlier one
            self.has_truth = True
            flow = np.full((rows, 3), np.nan) if labels is None else labels.flow - pose_flow
            has = shown & np.isfinite(flow).all(axis=1) & (labels is not None and labels.is_valid)
            self._points(TRUTH, position[has], self._color(flow[has]))

        moving = shown & (np.linalg.norm(residual, axis=1) > MOVING)
        columns = np.concatenate([position[moving], residual[moving]], axis=1)
        numbers, middle, count = group_medians(cluster[moving], columns)
        large = count >= MIN_ARROW_POINTS
        start, vector = middle[large, :3], middle[large, 3:]
        names = [f"cluster {n}: {np.linalg.norm(v):.2f} m per sweep" for n, v in zip(numbers[large], vector)]
        arrows = rr.Arrows3D(
            origins=start,
            vectors=ARROW_STEPS * vector,
            colors=flow_to_rgb(vector, self.max_flow),
            radii=0.12,
            labels=names,
            show_labels=False,
        )
        self.stream.log(ARROWS, arrows, strict=True)
        self.count += 1

    def add_tracks(self, rows: Mapping[str, np.ndarray]) -> None:
        """Boxes of the pair that was added last, at sweep t, in the world."""
        T_shown_world = np.eye(4) if self.first_pose is None else np.linalg.inv(self.first_pose)
        centre = np.stack([rows[axis] for axis in "xyz"], 1) @ T_shown_world[:3, :3].T + T_shown_world[:3, 3]
        heading = rows["heading"] + np.arctan2(T_shown_world[1, 0], T_shown_world[0, 0])
        turn = np.zeros((len(heading), 4))  # quaternions x, y, z, w
        turn[:, 2], turn[:, 3] = np.sin(heading / 2), np.cos(heading / 2)
        boxes = self.rr.Boxes3D(
            centers=centre,
            half_sizes=np.stack([rows[name] for name in ("length", "width", "height")], 1) / 2,
            quaternions=turn,
            colors=cluster_colors(centre, rows["id"], _NO_CLUSTER),
            labels=[f"{n}: {np.hypot(x, y):.1f} m/s" for n, x, y in zip(rows["id"], rows["vx"], rows["vy"])],
        )
        self.stream.log(TRACKS, boxes, strict=True)

    def end(self, log_id: str) -> None:
        """Log what is known only now, and how the viewer lays it out."""
        if not self.count:
            raise CFlowError(f"{log_id}: no pair, nothing to record")
        rr = self.rr
        self.stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True, strict=True)
        outline = [(2.4, 0, 0), (-1.9, 1.15, 0), (-1.0, 0, 0), (-1.9, -1.15, 0), (2.4, 0, 0)]  # as in `panel`
        vehicle = rr.LineStrips3D([outline], colors=_EGO_COLOR, radii=0.05)
        self.stream.log(f"{EGO}/outline", vehicle, static=True, strict=True)
        if len(self.trajectory) > 1:
            way = rr.LineStrips3D([np.stack(self.trajectory)], colors=_GROUND_COLOR, radii=0.05)
            self.stream.log("world/trajectory", way, static=True, strict=True)
        self.stream.send_blueprint(self._layout())

    def _set_time(self, index: int, timestamp_ns: int | None) -> None:
        self.stream.set_time("sweep", sequence=index)
        if timestamp_ns is not None and timestamp_ns >= _CALENDAR:
            self.stream.set_time("time", timestamp=np.datetime64(int(timestamp_ns), "ns"))
        elif timestamp_ns is not None:
            self.stream.set_time("time", duration=np.timedelta64(int(timestamp_ns), "ns"))

    def _move(self, pose: Any) -> None:
        """Ego frame of t+1 in the world, whose origin is near: the viewer counts in float32."""
        if pose is None:
            return
        T_world_ego = as_numpy(pose, np.float64)
        if self.first_pose is None:
            self.first_pose = T_world_ego
        moved = np.linalg.solve(self.first_pose, T_world_ego)
        self.trajectory.append(moved[:3, 3])
        transform = self.rr.Transform3D(translation=moved[:3, 3], mat3x3=moved[:3, :3])
        self.stream.log(EGO, transform, strict=True)

    def _points(self, entity: str, position: np.ndarray, colors: Any, radius: float = _DOT) -> None:
        cloud = self.rr.Points3D(position.astype(np.float32), colors=colors, radii=radius)
        self.stream.log(entity, cloud, strict=True)

    def _color(self, flow: np.ndarray) -> np.ndarray:
        color = flow_to_rgb(flow, self.max_flow)
        color[np.linalg.norm(flow, axis=1) <= MOVING] = _STATIC
        return color

    def _layout(self) -> Any:
        """The estimate to the left, truth and clusters to the right."""
        import rerun.blueprint as rrb

        def view(name: str, *hidden: str) -> Any:
            contents = ["+ /world/**", *(f"- /{entity}/**" for entity in hidden)]
            return rrb.Spatial3DView(origin=EGO, contents=contents, name=name, background=_BACKGROUND)

        estimate = view("estimate", TRUTH, CLUSTERS, NEXT_SWEEP)
        over_next = view("estimate and sweep t+1", TRUTH, CLUSTERS, GROUND)
        beside = [view("clusters", ESTIMATE, TRUTH, NEXT_SWEEP, ARROWS)]
        if self.has_truth:
            beside.insert(0, view("ground truth", ESTIMATE, CLUSTERS, NEXT_SWEEP, ARROWS))
        parts = rrb.Horizontal(rrb.Tabs(estimate, over_next), rrb.Vertical(*beside), column_shares=[2, 1])
        return rrb.Blueprint(parts, collapse_panels=True)
