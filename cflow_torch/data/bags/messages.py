"""Convert ROS messages: PointCloud2 to one array per field, and /tf to a tree of coordinate frames over time."""

from __future__ import annotations

import math
import re
from typing import Any, Tuple

import numpy as np

from cflow_torch.data.arrays.bin_layout import are_plausible
from cflow_torch.data.file_errors import shortened
from cflow_torch.transforms import poses_at, poses_from_quaternions
from cflow_torch.types import CFlowError
from cflow_torch.windows.returns import missing_returns

_CONSTANT = 1e-9  # metres, and entries of a rotation: the change of a constant transform by rounding
BASE = "base_link"  # the vehicle, by ROS's REP 105: x forward, y left, z up
_WORLD = re.compile("(.*[/_])?(odom|odometry|map|world|earth)(_.*)?")  # the frames of REP 105, also of one program
_SLIGHTLY_TILTED = 0.004  # 1 - cosine of 5 degrees
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # PointField.datatype


def cloud_columns(message: Any) -> dict[str, np.ndarray]:
    """Return the fields of a PointCloud2 or of Livox' CustomMsg, x, y, z and others: name -> (N,) numbers as stored.

    We leave out `missing_returns`. A cloud without x, y or z, or with less data than it states, is a ValueError.
    """
    if hasattr(message, "points"):
        return _livox_columns(message)
    fields = {field.name: field for field in message.fields if field.count <= 1 and field.datatype in _TYPES}
    names = [name for name in fields if name]
    missing = [axis for axis in "xyz" if axis not in names]
    if missing:
        raise ValueError(f"the cloud lacks the fields {missing}; it has {names}")
    offsets, step = [fields[name].offset for name in names], message.point_step
    row_step = message.row_step or message.width * step
    rows = np.frombuffer(message.data, np.uint8, message.height * row_step).reshape(message.height, row_step)
    octets = np.ascontiguousarray(rows[:, : message.width * step])
    tables = []
    for order in "><" if message.is_bigendian else "<>":  # some drivers state the wrong order
        kinds = [order + _TYPES[fields[name].datatype] for name in names]
        kind = np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": step})
        tables.append(octets.view(kind).reshape(-1))
    clouds = ((table, points_of(table)) for table in tables)
    fitting = ((table, points) for table, points in clouds if are_plausible(points))
    table, points = next(fitting, None) or (tables[0], points_of(tables[0]))
    table = table[~missing_returns(points)]
    return {name: table[name].astype(table[name].dtype.newbyteorder("=")) for name in names}


def points_of(columns: Any) -> np.ndarray:
    """Return (N, 3) points in the frame of the cloud."""
    return np.stack([columns[axis] for axis in "xyz"], axis=1)


def _livox_columns(message: Any) -> dict[str, np.ndarray]:
    kinds = {"x": "f4", "y": "f4", "z": "f4", "offset_time": "u4", "reflectivity": "u1", "tag": "u1", "line": "u1"}
    columns = {name: np.array([getattr(p, name) for p in message.points], kind) for name, kind in kinds.items()}
    kept = ~missing_returns(points_of(columns))
    return {name: values[kept] for name, values in columns.items()}


Sample = Tuple[float, ...]  # nanoseconds (int), x, y, z, and the quaternion w, x, y, z


class Frames:
    """A tree of coordinate frames: the parent of each frame, and samples of its `T_parent_frame` over time.

    `samples` are those of each parent and frame. Of several parents of a frame, we take the one with the most samples.
    Ties: the last. A transform connects two frames in either direction: another constant one is inverted if its parent
    is not in the tree. If a world frame is published below the vehicle (as KISS-ICP does), all transforms between it
    and the root are inverted, so that the world is the root.

    Attributes:
        inverted_world: the root if its transforms are inverted, and the frame in which it moved; () = none are.
    """

    inverted_world: tuple[str, ...] = ()

    def __init__(self, samples: dict[tuple[str, str], list[Sample]]) -> None:
        by_count = sorted(samples, key=lambda link: len(samples[link]))
        self._parents = {child: parent for parent, child in by_count}
        self._ignored = [(parent, child) for parent, child in by_count if self._parents[child] != parent]
        self._samples = {child: samples[parent, child] for child, parent in self._parents.items()}
        self._links: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self._inverted: set[str] = set()  # frames whose samples are those of their `T_frame_parent`
        for parent, child in [*self._ignored]:
            rows = samples[parent, child]
            if parent not in self._parents and parent not in self.chain(child) and _is_fixed(rows):
                self._ignored.remove((parent, child))
                self._invert(parent, child, rows)
        for frame in sorted(filter(_WORLD.fullmatch, self._parents)):
            above = self.chain(frame)[1:]
            if self.is_moving(frame) and not any(_WORLD.fullmatch(each) or self.is_moving(each) for each in above):
                self._make_root(frame)
                self.inverted_world = frame, above[0]

    def _invert(self, parent: str, child: str, samples: list[Sample]) -> None:
        """Let the parent of a transform be the child of its child."""
        self._parents[parent] = child
        self._samples[parent] = samples
        self._inverted.add(parent)

    def _make_root(self, root: str) -> None:
        """Invert all transforms between a frame and the root."""
        chain = self.chain(root)
        for child, parent in [*zip(chain, chain[1:])][::-1]:
            del self._parents[child]
            self._invert(parent, child, self._samples.pop(child))
            if child in self._inverted:  # its samples are those of the other direction
                self._inverted -= {child, parent}
        self._links.clear()

    def _link(self, child: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the times and poses of the transform to a frame; one of each if all its samples are equal."""
        if child not in self._links:
            rows = self._samples[child]
            times, poses = sorted_poses(rows[:1] if _is_fixed(rows) else rows, f"the transform to {child}")
            self._links[child] = times, np.linalg.inv(poses) if child in self._inverted else poses
        return self._links[child]

    def chain(self, frame: str) -> list[str]:
        """Return the frame, its parent, ... up to the root."""
        chain = [frame]
        while self._parents.get(chain[-1], frame) not in chain:
            chain.append(self._parents[chain[-1]])
        return chain

    def ignored(self, *frames: str) -> str:
        """Name the transforms to other parents of frames, or of those above them."""
        used = {each for frame in frames for each in self.chain(frame)}
        return ", ".join(f"{parent} to {child}" for parent, child in self._ignored if child in used)

    def are_joined(self, frame: str, other: str) -> bool:
        return self.chain(frame)[-1] == self.chain(other)[-1]

    def change_times(self, frame: str) -> np.ndarray:
        """Return the sample times of all moving transforms between the root and a frame, (K,) int64 ns, ascending."""
        times = [self._link(child)[0] for child in self.chain(frame)[:-1]]
        return np.unique(np.concatenate([np.zeros(0, np.int64), *(t for t in times if len(t) > 1)]))

    def in_root(self, frame: str, times_ns: np.ndarray) -> np.ndarray:
        """Return (K, 4, 4) float64 `T_root_frame` at the times.

        Transforms are constant before their first sample and after their last one.
        """
        result = np.tile(np.eye(4), (len(times_ns), 1, 1))
        for child in self.chain(frame)[:-1]:
            times, poses = self._link(child)
            at = poses_at(np.clip(times_ns, times[0], times[-1]), times, poses) if len(times) > 1 else poses
            result = at @ result
        return result

    def is_moving(self, child: str) -> bool:
        """Test whether the transform from the parent of a frame to the frame changes."""
        return child in self._samples and len(self._link(child)[0]) > 1

    def world_of(self, frame: str) -> str:
        """Return the frame in which the path of a frame is continuous: its root, or the one below corrections."""
        moving = [child for child in self.chain(frame)[:-1] if self.is_moving(child)]
        return next(filter(self._is_corrected, moving[1:]), self.chain(frame)[-1])

    def moving_in(self, frame: str) -> list[str]:
        """Return the frames that move, and are below a frame."""
        return [child for child in self._samples if frame in self.chain(child)[1:] and self.is_moving(child)]

    def drives_in(self, frame: str, other: str) -> bool:
        """Test whether a frame moves in another one, or in one above that."""
        links = set(self.chain(frame)).difference(self.chain(other))
        return self.are_joined(frame, other) and any(map(self.is_moving, links))

    def _is_corrected(self, child: str) -> bool:
        """Test whether the transform to a frame is a correction (map to odom): constant, but for a few jumps."""
        changes = np.abs(np.diff(self._link(child)[1], axis=0)).max(axis=(1, 2))
        return child.split("/")[-1] == "odom" or bool((changes < _CONSTANT).mean() > 0.5)

    def vehicle_of(self, frame: str) -> str:
        """Return the frame of the vehicle that carries a frame, or that drives in it; "" = none is known.

        The vehicle is base_link, if it is connected, unless both move in a frame above both: then it is another one.
        Otherwise it is the first frame with z up on the way from the given one to the moving frame that carries it. If
        no frame carries it, it may be that of the world. The vehicle is then the only frame that moves in it.
        """
        chain = self.chain(frame)
        bases = [each for each in (*chain, *self._samples) if each.split("/")[-1] == BASE]
        joined = [each for each in bases if self.are_joined(each, frame)]
        related = [each for each in joined if not (self.drives_in(each, frame) and self.drives_in(frame, each))]
        moving = [child for child in chain if self.is_moving(child)]
        inside = self.moving_in(frame)
        if related:
            return related[0]
        if not moving or (inside and self._is_corrected(moving[0])):
            return inside[0] if len(inside) == 1 else ""
        carrying = chain[: chain.index(moving[0]) + 1]
        up = [float(self.in_root(each, self._link(moving[0])[0])[:, 2, 2].mean()) for each in carrying]
        return next(each for each, share in zip(carrying, up) if share >= max(up) - _SLIGHTLY_TILTED)

    def between(self, target: str, source: str, times_ns: np.ndarray) -> np.ndarray:
        """Return (K, 4, 4) float64 `T_target_source` at the times. Frames that are not connected are a `CFlowError`."""
        if not self.are_joined(target, source):
            known = shortened(", ".join(sorted({*self._parents, *self._parents.values()})))
            raise CFlowError(f"no transforms connect {source} to {target}; the frames are {known or 'none'}")
        return np.linalg.inv(self.in_root(target, times_ns)) @ self.in_root(source, times_ns)


def _is_fixed(samples: list[Sample]) -> bool:
    return len({row[1:] for row in samples}) == 1


def sample(time_ns: int, position: Any, rotation: Any) -> Sample:
    return (time_ns, position.x, position.y, position.z, rotation.w, rotation.x, rotation.y, rotation.z)


def is_pose(row: Sample) -> bool:
    """Test whether a sample is a pose: programs write NaN or zeros for one that they lost."""
    return all(map(math.isfinite, row)) and any(row[4:])


def sorted_poses(samples: list[Sample], what: str) -> tuple[np.ndarray, np.ndarray]:
    """Return ascending times, (K,) int64 nanoseconds, and poses, (K, 4, 4) float64. Ties: the first sample."""
    times, rows = np.unique(np.array([row[0] for row in samples], np.int64), return_index=True)
    numbers = np.array([samples[row][1:] for row in rows], np.float64).reshape(-1, 7)
    return times, poses_from_quaternions(numbers[:, :3], numbers[:, 3:], lambda row: f"{what} at {times[row]} ns")
