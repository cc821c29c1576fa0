"""Convert ROS messages: PointCloud2 to one array per field, and /tf to a tree of coordinate frames over time."""

from __future__ import annotations

from typing import Any, Tuple

import numpy as np

from cflow_torch.data.files import shortened
from cflow_torch.data.returns import missing_returns
from cflow_torch.data.rigid_motion import poses_at, poses_from_quaternions
from cflow_torch.types import CFlowError

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # PointField.datatype


def cloud_columns(message: Any) -> dict[str, np.ndarray]:
    """Return the fields of a PointCloud2, x, y, z and others: name -> (N,) numbers as stored.

    We leave out `missing_returns`. A cloud without x, y or
    z, or with less data than it states, is a ValueError.
    """
    fields = {field.name: field for field in message.fields if field.count <= 1 and field.datatype in _TYPES}
    names = [name for name in fields if name]
    missing = [axis for axis in "xyz" if axis not in names]
    if missing:
        raise ValueError(f"the cloud lacks the fields {missing}; it has {names}")
    order = ">" if message.is_bigendian else "<"
    kinds = [order + _TYPES[fields[name].datatype] for name in names]
    offsets, step = [fields[name].offset for name in names], message.point_step
    kind = np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": step})
    row_step = message.row_step or message.width * step
    rows = np.frombuffer(message.data, np.uint8, message.height * row_step).reshape(message.height, row_step)
    table = np.ascontiguousarray(rows[:, : message.width * step]).view(kind).reshape(-1)
    points = np.stack([table[axis] for axis in "xyz"], axis=1)
    table = table[~missing_returns(points)]
    return {name: table[name].astype(table[name].dtype.newbyteorder("=")) for name in names}


Sample = Tuple[float, ...]  # nanoseconds (int), x, y, z, and the quaternion w, x, y, z


class Frames:
    """A tree of coordinate frames: the parent of each frame, and samples of its `T_parent_frame` over time."""

    def __init__(self, parents: dict[str, str], samples: dict[str, list[Sample]]) -> None:
        self._parents = parents
        # If all samples of a transform are equal, it is fixed, and we keep one of them.
        self._links = {
            child: sorted_poses(rows if len({row[1:] for row in rows}) > 1 else rows[:1], f"the transform to {child}")
            for child, rows in samples.items()
        }

    def chain(self, frame: str) -> list[str]:
        """Return the frame, its parent, ... up to the root."""
        chain = [frame]
        while self._parents.get(chain[-1], frame) not in chain:
            chain.append(self._parents[chain[-1]])
        return chain

    def are_joined(self, frame: str, other: str) -> bool:
        return self.chain(frame)[-1] == self.chain(other)[-1]

    def change_times(self, frame: str) -> np.ndarray:
        """Return the sample times of all moving transforms between the root and a frame, (K,) int64 ns, ascending."""
        times = [self._links[child][0] for child in self.chain(frame)[:-1]]
        return np.unique(np.concatenate([np.zeros(0, np.int64), *(t for t in times if len(t) > 1)]))

    def in_root(self, frame: str, times_ns: np.ndarray) -> np.ndarray:
        """Return (K, 4, 4) float64 `T_root_frame` at the times.

        Transforms are constant before their first sample and after their last one.
        """
        result = np.tile(np.eye(4), (len(times_ns), 1, 1))
        for child in self.chain(frame)[:-1]:
            times, poses = self._links[child]
            at = poses_at(np.clip(times_ns, times[0], times[-1]), times, poses) if len(times) > 1 else poses
            result = at @ result
        return result

    def between(self, target: str, source: str, times_ns: np.ndarray) -> np.ndarray:
        """Return (K, 4, 4) float64 `T_target_source` at the times. Frames that are not connected are a `CFlowError`."""
        if not self.are_joined(target, source):
            known = shortened(", ".join(sorted({*self._parents, *self._parents.values()})))
            raise CFlowError(f"no transforms connect {source} to {target}; the frames are {known or 'none'}")
        return np.linalg.inv(self.in_root(target, times_ns)) @ self.in_root(source, times_ns)


def sample(time_ns: int, position: Any, rotation: Any) -> Sample:
    return (time_ns, position.x, position.y, position.z, rotation.w, rotation.x, rotation.y, rotation.z)


def sorted_poses(samples: list[Sample], what: str) -> tuple[np.ndarray, np.ndarray]:
    """Return ascending times, (K,) int64 nanoseconds, and poses, (K, 4, 4) float64. Ties: the first sample."""
    times, rows = np.unique(np.array([row[0] for row in samples], np.int64), return_index=True)
    numbers = np.array([samples[row][1:] for row in rows], np.float64).reshape(-1, 7)
    return times, poses_from_quaternions(numbers[:, :3], numbers[:, 3:], lambda row: f"{what} at {times[row]} ns")
