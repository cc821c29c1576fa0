"""Coordinate frames of a robot and the transforms between them over time, from the topics /tf and /tf_static."""

from __future__ import annotations

from typing import Any, Tuple

import numpy as np

from cflow_torch.data.files import shortened
from cflow_torch.data.rigid_motion import poses_at, poses_from_quaternions
from cflow_torch.types import CFlowError

Sample = Tuple[float, ...]  # nanoseconds (int), x, y, z, and the quaternion w, x, y, z


class Frames:
    """A tree of frames.

    Args:
        parents: frame -> its parent frame.
        samples: frame -> `T_parent_frame` over time.
    """

    def __init__(self, parents: dict[str, str], samples: dict[str, list[Sample]]) -> None:
        self._parents = parents
        # A transform that is always the same is a fixed one.
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
        """Whether transforms connect the two frames."""
        return self.chain(frame)[-1] == self.chain(other)[-1]

    def change_times(self, frame: str) -> np.ndarray:
        """Return (K,) int64 nanoseconds, ascending, at which changing transforms from the root to a frame are known."""
        times = [self._links[child][0] for child in self.chain(frame)[:-1]]
        return np.unique(np.concatenate([np.zeros(0, np.int64), *(t for t in times if len(t) > 1)]))

    def in_root(self, frame: str, times_ns: np.ndarray) -> np.ndarray:
        """Return (K, 4, 4) float64 `T_root_frame`; a transform is constant outside the time of its samples."""
        result = np.tile(np.eye(4), (len(times_ns), 1, 1))
        for child in self.chain(frame)[:-1]:
            times, poses = self._links[child]
            at = poses_at(np.clip(times_ns, times[0], times[-1]), times, poses) if len(times) > 1 else poses
            result = at @ result
        return result

    def between(self, target: str, source: str, times_ns: np.ndarray) -> np.ndarray:
        """Return (K, 4, 4) float64 `T_target_source`.

        Raises:
            CFlowError: no transforms connect the two frames.
        """
        if not self.are_joined(target, source):
            known = shortened(", ".join(sorted({*self._parents, *self._parents.values()})))
            raise CFlowError(f"no transforms connect {source} to {target}; the frames are {known or 'none'}")
        return np.linalg.inv(self.in_root(target, times_ns)) @ self.in_root(source, times_ns)


def sample(time_ns: int, position: Any, rotation: Any) -> Sample:
    """Build a sample from a time and two messages."""
    return (time_ns, position.x, position.y, position.z, rotation.w, rotation.x, rotation.y, rotation.z)


def sorted_poses(samples: list[Sample], what: str) -> tuple[np.ndarray, np.ndarray]:
    """Return (K,) int64 ascending times and (K, 4, 4) float64 poses. Ties: the first sample."""
    times, rows = np.unique(np.array([row[0] for row in samples], np.int64), return_index=True)
    numbers = np.array([samples[row][1:] for row in rows], np.float64).reshape(-1, 7)
    return times, poses_from_quaternions(numbers[:, :3], numbers[:, 3:], lambda row: f"{what} at {times[row]} ns")
