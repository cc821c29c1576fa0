"""The input and output types, `Sweep`, `Window` and `FlowResult`."""

from __future__ import annotations

import zipfile
from dataclasses import MISSING, dataclass, fields
from itertools import takewhile
from pathlib import Path
from typing import Any, Iterable, Mapping, NamedTuple, Sequence, Union

import numpy as np
import torch
from torch import Tensor

from cflow_torch.errors import CFlowError as CFlowError
from cflow_torch.errors import CFlowWarning as CFlowWarning
from cflow_torch.errors import import_optional

Array = Union[np.ndarray, Tensor]
# A moving point has at least a residual flow of 0.05 m per sweep, as in evaluation, and a probability `moving` of 0.5.
MOVING, MIN_MOVING = 0.05, 0.5
# Names in flow files and data frames -> fields of `FlowResult`.
VECTORS = {"flow": "flow", "residual": "residual_flow", "pose": "pose_flow"}
# No sweep has more columns than this, so a wider array is a transposed one, (3, N) or (4, N).
_MOST_COLUMNS = 64
CENTRE, SIZE, VELOCITY = ("x", "y", "z"), ("length", "width", "height"), ("vx", "vy", "vz")  # columns of boxes
_COLUMNS = {
    "id": "i8",
    **dict.fromkeys((*CENTRE, *SIZE, *VELOCITY, "heading"), "f8"),
    "num_points": "i8",
    **dict.fromkeys(("confidence", "moving"), "f8"),
}


def vectors(table: Mapping[str, np.ndarray], names: Sequence[str]) -> np.ndarray:
    """Return columns of a table of boxes as vectors, (R, 3), such as `CENTRE`."""
    return np.stack([table[name] for name in names], 1)


class ObjectRow(np.void):
    """A row of an `ObjectTable`."""

    def __getitem__(self, key: Any) -> Any:
        """Return a number, or one of the vectors centre, size and velocity, (3,) float64."""
        is_vector = isinstance(key, str) and key in _OBJECT_VECTORS.names
        return self.view(_OBJECT_VECTORS)[key] if is_vector else super().__getitem__(key)


_OBJECT: Any = np.dtype((ObjectRow, list(_COLUMNS.items())))  # type: ignore[arg-type]  # its stubs know np.void only
# The vectors of an object: three columns each, of the same bytes.
_OBJECT_VECTORS: Any = np.dtype(
    {
        "names": ["centre", "size", "velocity"],
        "formats": ["3f8"] * 3,
        "offsets": [_OBJECT.fields[name][1] for name in ("x", "length", "vx")],
        "itemsize": _OBJECT.itemsize,
    }
)


class ObjectTable(np.ndarray):
    """The moving objects of a result: a structured array, (K,), see `FlowResult.objects`.

    Examples:
        >>> table = pandas.DataFrame(result.objects(points))
        >>> text = json.dumps(result.objects(points).to_records())
    """

    def to_records(self) -> list[dict[str, Any]]:
        """Return a dictionary of plain numbers per object, with the names of the columns, for JSON.

        A NaN, which JSON does not have, becomes None.
        """
        names = self.dtype.names or ()
        rows = [row.tolist() for row in self.reshape(-1)]
        return [{name: None if value != value else value for name, value in zip(names, row)} for row in rows]

    def __getitem__(self, key: Any) -> Any:
        """Return a row, some rows, a column, or one of the vectors centre, size and velocity, (K, 3) float64.

        A column and a vector are plain arrays, which share the memory of the table.
        """
        if isinstance(key, str) and key in _OBJECT_VECTORS.names:
            return self.view(_OBJECT_VECTORS, np.ndarray)[key]
        value = super().__getitem__(key)
        return value.view(np.ndarray) if isinstance(value, np.ndarray) and value.dtype.names is None else value


def as_numpy(value: Array, dtype: Any | None = None) -> np.ndarray:
    """Convert an array or a tensor on any device to NumPy; bfloat16, which NumPy lacks, becomes float32."""
    if isinstance(value, Tensor):
        value = value.detach().cpu()
        value = (value.float() if value.dtype == torch.bfloat16 else value).numpy()
    return np.asarray(value, dtype=dtype)


def point_rows(name: str, values: Array, count: int | None = None) -> np.ndarray:
    """Check an array with a row per point, and return it as (N, 3) float64. `count` is N; None = any N."""
    array = as_numpy(values)
    wanted = "(N, 3)" if count is None else f"({count}, 3)"
    if array.dtype == object:
        raise CFlowError(f"{name} is {type(values).__name__}: give an array {wanted}, such as sweep.points")
    if array.ndim != 2 or array.shape[1] < 3 or (count is not None and len(array) != count):
        raise CFlowError(f"{name} has shape {array.shape}: give {wanted}, one row per point")
    return array[:, :3].astype(np.float64)


def check_array(array: Any, name: str, shape: tuple[int | None, ...], kinds: str, wanted: str) -> None:
    """Check the type, shape (None = any length) and dtype of a dense array or tensor.

    `kinds` are the allowed kinds of dtypes: "b" for bool, "iu" for integers, "f" for floats, or several of these. The
    error message contains `name` and `wanted`.
    """
    if not isinstance(array, (np.ndarray, Tensor)):
        raise CFlowError(f"{name} is {type(array).__name__}: give {wanted}, a NumPy array or a torch tensor")
    if isinstance(array, Tensor) and array.layout != torch.strided:
        raise CFlowError(f"{name} has layout {array.layout}: give a dense tensor")
    if isinstance(array, np.ma.MaskedArray):
        raise CFlowError(f"{name} is a masked array, whose mask would be lost: give .filled(...), of points with NaN")
    if len(array.shape) != len(shape) or any(b is not None and a != b for a, b in zip(array.shape, shape)):
        raise CFlowError(f"{name} has shape {tuple(array.shape)}: give {wanted}")
    if _kind(array.dtype) not in kinds:
        raise CFlowError(f"{name} has dtype {array.dtype}: give {wanted}")


def last_row(shape: tuple[int, ...]) -> str:
    """What to do with a transform of this shape: append the last row of a (3, 4) matrix; "" for other shapes."""
    return "; append its last row: np.vstack([matrix, [0, 0, 0, 1]])" if tuple(shape) == (3, 4) else ""


def _kind(dtype: Any) -> str:
    """NumPy's letter for the kind of a NumPy or torch dtype."""
    if not isinstance(dtype, torch.dtype):
        return str(dtype.kind)
    return "b" if dtype == torch.bool else "f" if dtype.is_floating_point else "c" if dtype.is_complex else "i"


def check_points(points: Any, name: str) -> None:
    """Check that points are (N, 3+) floats."""
    check_array(points, name, (None, None), "f", "(N, 3+) floating-point metres, columns x, y, z")
    if points.shape[1] < 3:
        raise CFlowError(f"{name} has shape {tuple(points.shape)}: give (N, 3+), columns x, y, z in metres")
    if points.shape[1] > _MOST_COLUMNS:
        raise CFlowError(f"{name} has shape {tuple(points.shape)}: a row is a point; give its transpose, (N, 3+)")


@dataclass(frozen=True)
class Sweep:
    """One LiDAR sweep.

    Args:
        points: (N, 3+) float, metres, in the ego frame of this sweep; columns after z are ignored.
        is_ground: (N,) bool, True = ground; None = no point is ground.
        pose: (4, 4) float64 `T_world_ego`, ego coordinates to world. None = the points are already in the frame of t+1;
            then no sweep of the window may have a pose.
        timestamp_ns: time of the sweep in nanoseconds; None = unknown.
        point_times: (N,) float, seconds from the instant of the sweep to the measurement of each point, negative =
            before it; None = unknown, treated as 0. `timestamp_ns` and `pose` are for this instant, and the points must
            already be compensated for the motion of the vehicle until then. The verified method uses the times
            if every sweep of a window has them.

    Raises:
        CFlowError: wrong type, shape or dtype.
    """

    points: Array
    is_ground: Array | None = None
    pose: Array | None = None
    timestamp_ns: int | None = None
    point_times: Array | None = None

    def __post_init__(self) -> None:
        names = ("Sweep.points", "Sweep.is_ground", "Sweep.pose", "Sweep.point_times")
        check_sweep(names, self.points, self.is_ground, self.pose, self.point_times)


def check_sweep(names: Sequence[str], points: Any, is_ground: Any, pose: Any, point_times: Any) -> None:
    """Check the arrays of a sweep. `names` are what the user calls points, ground mask, pose and times."""
    of_points, of_ground, of_pose, of_times = names
    check_points(points, of_points)
    rows = points.shape[0]
    if is_ground is not None:
        check_array(is_ground, of_ground, (rows,), "b", f"({rows},) bool, True = ground, one per point")
    if point_times is not None:
        wanted = f"({rows},) floats, seconds after the time stamp of the sweep, one per point"
        check_array(point_times, of_times, (rows,), "f", wanted)
    if pose is not None:
        _check_pose_shape(pose, of_pose)


def _check_pose_shape(pose: Any, name: str) -> None:
    wanted = "give one (4, 4) rigid transform"
    try:
        shape = np.shape(pose)
    except ValueError:  # parts of several shapes, such as (R, t)
        raise CFlowError(f"{name} is {type(pose).__name__}: {wanted}") from None
    if shape != (4, 4):
        raise CFlowError(f"{name} has shape {shape}: {wanted}{last_row(shape)}")


@dataclass(frozen=True)
class Window:
    """The sweeps of one estimate: t-h ... t+1 and, for recordings, some after t+1.

    Args:
        pc0: sweep t, whose points get flow.
        pc1: sweep t+1, whose ego frame is the frame of the flow.
        pch: sweeps t-1, t-2, ... t-h, nearest first; may be shorter than `num_history`.
        pcf: sweeps t+2, t+3, ..., nearest first; may be shorter than `num_future`.

    Raises:
        CFlowError: pc0, pc1 or an entry of pch or pcf is not a `Sweep`.
    """

    pc0: Sweep
    pc1: Sweep
    pch: tuple[Sweep, ...] = ()
    pcf: tuple[Sweep, ...] = ()

    def __post_init__(self) -> None:
        for name, others in (("pch", self.pch), ("pcf", self.pcf)):
            if not isinstance(others, (list, tuple)):
                raise CFlowError(f"{name} is {type(others).__name__}: give a tuple of cflow_torch.Sweep, () for none")
        for name, sweep in named_sweeps(self):
            if not isinstance(sweep, Sweep):
                raise CFlowError(f"{name} is {type(sweep).__name__}: give cflow_torch.Sweep(points, ...)")

    @property
    def sweeps(self) -> tuple[Sweep, ...]:
        """The sweeps t and t+1, then those of pch, then those of pcf."""
        return (self.pc0, self.pc1, *self.pch, *self.pcf)

    def with_sweeps(self, sweeps: Iterable[Sweep]) -> Window:
        """Replace all sweeps. They have the order of `Window.sweeps`."""
        pc0, pc1, *others = sweeps
        return Window(pc0, pc1, tuple(others[: len(self.pch)]), tuple(others[len(self.pch) :]))

    @classmethod
    def from_dict(cls, sample: Mapping[str, Any]) -> Window:
        """Make a window of the dictionary of a data loader, such as SeFlow's and OpenSceneFlow's.

        Args:
            sample: "pc0" and "pc1", (N, 3+) points of t and t+1; for t-1, t-2, ... "pch1", "pch2", ...; for t+2, ...
                "pcf1", ... For each of them, if there is a value: "gm0" (N,) bool, True = ground; "pose0" (4, 4),
                ego coordinates to world; "dt0" (N,) seconds, see `Sweep`. Other keys are ignored.

        Raises:
            CFlowError: a missing cloud, a wrong shape or dtype. The message names the key.
        """
        for key in ("pc0", "pc1"):
            if key not in sample:
                raise CFlowError(f"the dictionary has no {key!r}; it has {', '.join(map(str, sample))}")

        def sweep(name: str) -> Sweep:
            keys = [f"{prefix}{name}" for prefix in ("pc", "gm", "pose", "dt")]
            points, is_ground, pose, times = (sample.get(key) for key in keys)
            check_sweep(keys, points, is_ground, pose, times)
            return Sweep(points, is_ground, pose, point_times=times)  # type: ignore[arg-type]  # points are checked

        def numbered(side: str) -> tuple[Sweep, ...]:
            names = takewhile(lambda name: f"pc{name}" in sample, (f"{side}{i}" for i in range(1, len(sample))))
            return tuple(map(sweep, names))

        return cls(sweep("0"), sweep("1"), numbered("h"), numbered("f"))


def named_sweeps(window: Window) -> list[tuple[str, Sweep]]:
    """Every sweep with its name: t+1, then t, t-1, ... from newest to oldest, then t+2, t+3, ..."""
    others = [(f"pc{side}{i}", sweep) for side in "hf" for i, sweep in enumerate(getattr(window, f"pc{side}"), 1)]
    return [("pc1", window.pc1), ("pc0", window.pc0), *others]


@dataclass(frozen=True)
class FlowResult:
    """Flow from t to t+1, one row per point of pc0 in the same order, also for ground and points out of range.

    The flow of a point is the displacement of its object from the instant of sweep t to the instant of sweep t+1. If
    the point has a time, it is the displacement over one sweep interval, from the position at the measurement.

    Args:
        residual_flow: (N, 3) float32, metres per sweep interval, axes of ego1: motion of objects.
        pose_flow: (N, 3) float32, metres, T_ego1_ego0 p - p: apparent motion that ego motion alone causes. The verified
            method corrects ego motion that is off by centimetres, and this is the corrected one.
        flow: (N, 3) float32, metres, total flow, the sum of the two.
        cluster_id: (N,) int64, numbers from 0 on, in the order of each cluster's first pixel, some of which may be
            skipped; -1 = in no cluster that has points both at t+1 and before.
        score: (N,) float32 in [0, 1], normalised cross-correlation of the cluster with t+1 at the peak (finest scale;
            verified method: scale of the object). It is not a probability. It is 0 where cluster_id is -1, and in
            the verified method for objects that no candidate moves.
        is_valid: (N,) bool, True for active points: finite, not ground, not of the vehicle itself (`Config.ego_box`),
            and inside the region.
        confidence: (N,) float32 in [0, 1], estimated probability that the end-point error of the residual flow is
            below 0.1 m per sweep interval; 0 where is_valid is False; None unless the method is the verified one. The
            probabilities were fitted on simulated drives, see docs/verified.md.
        moving: (N,) float32 in [0, 1], estimated probability that the true residual flow is at least `MOVING`, 0.05 m
            per sweep interval, whatever the flow says; 0 and None like `confidence`.
        track_id: (N,) int64, id of the track of each point in the table of `track`, -1 = none; None unless the result
            was read from a file of `cflow flow tracks=true`.
    """

    residual_flow: Tensor
    pose_flow: Tensor
    flow: Tensor
    cluster_id: Tensor
    score: Tensor
    is_valid: Tensor
    confidence: Tensor | None = None
    moving: Tensor | None = None
    track_id: Tensor | None = None

    @property
    def is_moving(self) -> Tensor:
        """(N,) bool, points with a residual flow of at least `MOVING` and a probability `moving` of at least one half.

        Without `moving`, the flow alone decides.
        """
        is_moving = self.residual_flow.norm(dim=1) >= MOVING
        return is_moving if self.moving is None else is_moving & (self.moving >= MIN_MOVING)

    def __repr__(self) -> str:
        """The numbers of points and clusters; fields that every method has are named if they are None."""
        parts = [f"{len(next(iter(self._given().values())))} points" if self._given() else "empty"]
        if self.is_valid is not None:
            parts.append(f"{int(self.is_valid.sum())} valid")
        if self.cluster_id is not None:
            in_cluster = self.cluster_id[self.cluster_id >= 0]
            parts.append(f"{len(in_cluster)} in {len(in_cluster.unique())} clusters")
        missing = [f.name for f in fields(self) if f.default is MISSING and getattr(self, f.name) is None]
        return f"FlowResult({', '.join(parts + [f'no {name}' for name in missing])})"

    def to(self, device: Any) -> FlowResult:
        """Copy the result to another device."""
        return FlowResult.of({name: value.to(device) for name, value in self._given().items()})

    def numpy(self) -> dict:
        """Every field that is not None, by name, as a NumPy array."""
        return {name: value.detach().cpu().numpy() for name, value in self._given().items()}

    def columns(self) -> dict[str, np.ndarray]:
        """Return the columns of a flow file, by name, as arrays: flow_tx_m ... pose_tz_m, cluster_id, ..."""
        vectors = {field: name for name, field in VECTORS.items()}
        columns: dict[str, np.ndarray] = {}
        for name, values in self.numpy().items():
            is_vector = name in vectors
            columns.update(zip(vector_columns(vectors[name]), values.T) if is_vector else {name: values})
        return columns

    def to_pandas(self, points: Array | None = None) -> Any:
        """Return a `pandas.DataFrame` with a row per point and the columns of `columns`.

        If you pass the points of pc0, (N, 3+), the columns x, y and z come first. It is a `CFlowError` if pandas is not
        installed, or if the number of points differs.
        """
        need = "to_pandas needs pandas: pip install pandas; columns() returns the same as arrays"
        pandas = import_optional("pandas", need)
        positions = {} if points is None else dict(zip("xyz", self._positions(points).T))
        return pandas.DataFrame({**positions, **self.columns()})

    def objects(
        self,
        points: Array | Sweep,
        sweep_interval: float = 0.1,
        min_speed: float = 0.5,
        min_points: int = 10,
        min_moving: float = MIN_MOVING,
    ) -> ObjectTable:
        """List the moving objects at t+1.

        Args:
            points: (N, 3+) of pc0, metres, as you passed them; or the sweep t, for example `window.pc0`.
            sweep_interval: seconds from sweep t to sweep t+1.
            min_speed: m/s; slower clusters are left out.
            min_points: clusters with fewer points are left out; most of them are small parts of the static world.
            min_moving: clusters whose mean of `moving` is lower are left out; most of them are static. 0 = keep them.
                Without `moving`, it has no effect.

        Returns:
            (K,) structured array, sorted by id, in the ego frame at t+1, which `pandas.DataFrame` takes. `id`:
            cluster_id. `x`, `y`, `z`: metres, centre of the box. `length` along the heading, `width`, `height`: metres.
            `vx`, `vy`, `vz`: m/s over ground, mean over the points. `heading`: direction of the velocity, radians from
            +x to the left. `num_points`: number of points. `confidence`, `moving`: means over the points, NaN if the
            method has none. `centre`, `size` and `velocity` are vectors of these columns. `to_records()` of the array
            returns dictionaries for JSON.

        Convention:
            The box encloses the points of sweep t, moved by their flow. If only one side of an object is visible, the
            box encloses that side. On simulated drives, objects of 50 points and more have their centre inside the true
            box and their velocity within 0.75 m/s, except for a turning articulated lorry (4 m/s). Many smaller objects
            are parts of the static world. Nearly all of these have a confidence below 0.7, and `track` removes them.

        Raises:
            CFlowError: the number of points differs, or the result is from a file without flow or clusters.
        """
        if any(getattr(self, name) is None for name in ("flow", "residual_flow", "cluster_id")):
            raise CFlowError(
                "objects() needs flow, residual_flow and cluster_id: this result is from a file without them"
            )
        if not sweep_interval > 0:
            raise CFlowError(f"sweep_interval={sweep_interval}: give the seconds between two sweeps, for example 0.1")
        if not 0 <= min_moving <= 1:
            raise CFlowError(f"min_moving={min_moving}: give a probability from 0 (keep all) to 1")
        points = points.points if isinstance(points, Sweep) else points
        values = self.numpy()
        clusters = _Clusters.of(as_numpy(self.cluster_id))
        objects = np.zeros(len(clusters.id), _OBJECT).view(ObjectTable)
        if len(objects) == 0:
            return objects
        objects["id"] = clusters.id
        objects["num_points"] = clusters.num_points
        objects["velocity"][:] = clusters.mean(values["residual_flow"]) / sweep_interval
        objects["heading"] = np.arctan2(objects["velocity"][:, 1], objects["velocity"][:, 0])
        for name in ("confidence", "moving"):
            objects[name] = clusters.mean(values[name]) if name in values else np.nan
        moved = self._positions(points) + values["flow"]
        objects["centre"][:], objects["size"][:] = clusters.boxes(moved, objects["heading"])
        is_fast = np.linalg.norm(objects["velocity"], axis=1) >= min_speed
        is_static = objects["moving"] < min_moving  # False for NaN
        return objects[is_fast & (objects["num_points"] >= min_points) & ~is_static]

    def save(self, path: str | Path) -> None:
        """Write every field that is not None to one .npz file."""
        with open(path, "wb") as file:
            np.savez(file, **self.numpy())

    @classmethod
    def load(cls, path: str | Path) -> FlowResult:
        """Read a file that `save` wrote. A missing or different file is a `CFlowError`. No code in it is executed."""
        try:
            with np.load(path, allow_pickle=False) as file:
                return cls.of({name: torch.from_numpy(file[name]) for name in file.files})
        except (OSError, ValueError, TypeError, AttributeError, zipfile.BadZipFile, EOFError) as error:
            raise CFlowError(f"{path} is not a result ({error}): give a file that FlowResult.save wrote") from error

    @classmethod
    def of(cls, fields_given: dict[str, Tensor]) -> FlowResult:
        """Make a result from some of the fields, by name. The other fields are None."""
        values: dict[str, Any] = {**dict.fromkeys(f.name for f in fields(cls)), **fields_given}
        return cls(**values)

    def _positions(self, points: Array) -> np.ndarray:
        """The points of pc0, checked, as (N, 3) float64."""
        return point_rows("pc0", points, len(next(iter(self._given().values()))))

    def _given(self) -> dict[str, Tensor]:
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: value for name, value in values.items() if value is not None}


class _Clusters(NamedTuple):
    """The points of K clusters, one cluster after the other."""

    id: np.ndarray  # (K,) cluster_id, ascending
    num_points: np.ndarray  # (K,) int64
    first: np.ndarray  # (K,) int64, where the points of each cluster start in `row`
    row: np.ndarray  # (M,) int64, row of each point
    number: np.ndarray  # (M,) int64, index of each point's cluster, 0 ... K - 1

    @classmethod
    def of(cls, cluster: np.ndarray) -> _Clusters:
        """Sort points by cluster, (N,); -1 = none."""
        row = np.argsort(cluster, kind="stable")
        row = row[np.searchsorted(cluster[row], 0) :]
        ids, first, number, num_points = np.unique(cluster[row], True, True, True)
        return cls(ids, num_points, first, row, number)

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Return the mean of (N, ...) values in each cluster, (K, ...) float64."""
        return (np.add.reduceat(values[self.row].astype(np.float64), self.first).T / self.num_points).T

    def boxes(self, positions: np.ndarray, heading: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return centre and size, (K, 3) each, of the boxes along headings, (K,), around (N, 3) positions."""
        x, y, z = positions[self.row].T
        cos = np.cos(heading)
        sin = np.sin(heading)
        ahead = cos[self.number] * x + sin[self.number] * y
        left = cos[self.number] * y - sin[self.number] * x
        along = np.stack([ahead, left, z], axis=1)
        low = np.minimum.reduceat(along, self.first)
        high = np.maximum.reduceat(along, self.first)
        ahead, left, z = ((low + high) / 2).T
        return np.stack([cos * ahead - sin * left, sin * ahead + cos * left, z], axis=1), high - low


def vector_columns(name: str) -> Sequence[str]:
    """The columns of one of `VECTORS`, for example flow_tx_m, flow_ty_m, flow_tz_m."""
    return [f"{name}_t{axis}_m" for axis in "xyz"]
