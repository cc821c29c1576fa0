"""Rigid motion in the plane: a translation and a turn about a centre; the flow of points of objects that turn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.model import Motion
from cflow_torch.ops.indices import flat_nonzero, split_index
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.windows.collation import Batch


@dataclass(frozen=True)
class RigidMotion:
    """Motion of G objects per sweep interval.

    Args:
        flow: (G, 2) float64, x and y at the centre, metres, axes of ego1.
        turn: (G,) float64, tangent of half the angle, counter-clockwise.
        centre: (G, 2) float64, x and y, metres, frame of t+1.
    """

    flow: Tensor
    turn: Tensor
    centre: Tensor

    @classmethod
    def translation(cls, flow: Tensor) -> RigidMotion:
        """Objects that do not turn."""
        still = torch.zeros_like(flow)
        return cls(flow, still[:, 0], still)

    def pixels_per_interval(self, pixel_size: float) -> Tensor:
        """(G, 2) float64, (y, x): the flow at the centre, in pixels of a size in metres."""
        return self.flow.flip(1) / torch.full_like(self.flow, pixel_size)

    def only(self, moves: Tensor) -> RigidMotion:
        """The motion of some objects, (G,) bool; the others stand still."""
        return RigidMotion(self.flow.masked_fill(~moves[:, None], 0.0), self.turn.masked_fill(~moves, 0.0), self.centre)

    def flow_at(self, which: Tensor, x: Tensor, y: Tensor) -> Tuple[Tensor, Tensor]:
        """x and y of the flow, metres per interval, of points of t (K,), by their object and their place in metres."""
        (c_x, c_y), (v_x, v_y) = (values.index_select(0, which).unbind(1) for values in (self.centre, self.flow))
        x, y = x - c_x, y - c_y
        turned_x, turned_y = rotate(self.turn.index_select(0, which), x, y)
        return (turned_x - x) + v_x, (turned_y - y) + v_y


def rotate(turn: Tensor, x: Tensor, y: Tensor) -> Tuple[Tensor, Tensor]:
    """Places turned about the origin by the angle whose half has the tangent `turn`."""
    n = 1 + turn * turn
    cos, sin = (1 - turn * turn) / n, 2 * turn / n
    return cos * x - sin * y, sin * x + cos * y


@dataclass(frozen=True)
class TurningMotion(Motion):
    """Motion of clusters that may turn.

    Args:
        turn: (M + 1,) float64, as in `RigidMotion`.
        centre: (M + 1, 2) float64, likewise.
    """

    turn: Tensor = torch.empty(0)
    centre: Tensor = torch.empty(0)

    def residual_flow(self, points: slice, positions: Tensor) -> Tensor:
        """(K, 3) float32 flow of some points, each where it lies in a motion that turns."""
        cluster = self.cluster(points)
        flow = self.flow.index_select(0, cluster)
        turns = flat_nonzero((self.turn != 0).index_select(0, cluster))
        rigid = RigidMotion(self.flow[:, :2], self.turn, self.centre)
        x, y = rigid.flow_at(cluster.index_select(0, turns), *positions[:2].index_select(1, turns).unbind(0))
        flow[turns, 0], flow[turns, 1] = x + 0.0, y + 0.0  # no -0.0
        return flow.float()


def join(first: TurningMotion, second: TurningMotion, takes_second: Tensor, batch: Batch) -> TurningMotion:
    """Two motions of the same points, one for each point. In a window the ids of the second follow those of the first,
    in all sweeps: an object has one id wherever it is seen.

    Args:
        first, second: of L and M clusters; the result has L + 1 + M, since entry L stays "none" as well.
        takes_second: (K,) bool, for the first K points of the batch, at least those of t+1 and t.
        batch: of these points.
    """
    count = takes_second.numel()
    window = split_index(batch.image[:count].long(), batch.num_steps)[0]
    of_first, of_second = (motion.cluster(slice(count)).long() for motion in (first, second))
    num_ids = torch.zeros(batch.num_windows, dtype=torch.int64, device=window.device)
    num_ids.scatter_reduce_(0, window, 1 + first.cluster_id.index_select(0, of_first), "amax")
    offset = torch.zeros_like(second.cluster_id)
    offset.scatter_(0, of_second, num_ids.index_select(0, window))
    ids = second.cluster_id + offset.masked_fill_(second.cluster_id < 0, 0)
    both = {
        name: torch.cat((getattr(first, name), getattr(second, name)))
        for name in ("flow", "score", "confidence", "turn", "centre")
    }
    return TurningMotion(
        of_place=torch.where(takes_second, of_second + first.cluster_id.numel(), of_first),
        place=torch.arange(count, device=window.device),
        cluster_id=torch.cat((first.cluster_id, ids)),
        **both,
    )


def motion_by_pixel(
    objects: Objects,
    rigid: RigidMotion,
    score: Tensor,
    confidence: Tensor,
    sweeps: HeightSlicedSweeps,
) -> TurningMotion:
    """The motion of G objects, (P,) scores, (P + 1,) confidence by pixel: clusters are pixels, and M is P."""
    window = sweeps.window.index_select(0, objects.first)
    ids = torch.arange(window.numel(), device=window.device) - torch.searchsorted(window, window)
    of_pixel = F.pad(objects.of_pixel, (0, 1), value=objects.count)
    return TurningMotion(
        of_place=sweeps.number,
        place=torch.where(sweeps.batch.has_result, sweeps.place, sweeps.image.numel() - 1),
        flow=F.pad(rigid.flow, (0, 1, 0, 1)).index_select(0, of_pixel) + 0.0,  # + 0.0 turns -0.0 into 0.0
        cluster_id=F.pad(ids, (0, 1), value=-1).index_select(0, of_pixel),
        score=F.pad(score.masked_fill(objects.of_pixel == objects.count, 0.0), (0, 1)),
        confidence=confidence,
        turn=F.pad(rigid.turn, (0, 1)).index_select(0, of_pixel),
        centre=F.pad(rigid.centre, (0, 0, 0, 1)).index_select(0, of_pixel),
    )
