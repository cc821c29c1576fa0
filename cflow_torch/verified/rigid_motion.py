"""Rigid motion in the plane: a translation and a turn about a centre; the flow of points of objects that turn."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.model import Motion
from cflow_torch.ops.indices import flat_nonzero, index_in_group, lookup
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import HeightSlicedSweeps


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

    def pixels_per_interval(self, pixel_size: float) -> Tensor:
        """(G, 2) float64, (y, x): the flow at the centre, in pixels of a size in metres."""
        return self.flow.flip(1) / torch.full_like(self.flow, pixel_size)

    def only(self, moves: Tensor) -> RigidMotion:
        """The motion of some objects, (G,) bool; the others stand still."""
        return RigidMotion(self.flow.masked_fill(~moves[:, None], 0.0), self.turn.masked_fill(~moves, 0.0), self.centre)

    def flow_at(self, which: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """x and y of the flow, metres per interval, of points of t (K,), by their object and their place in metres."""
        (c_x, c_y), (v_x, v_y) = (values.index_select(0, which).unbind(1) for values in (self.centre, self.flow))
        arm = torch.complex(x - c_x, y - c_y)
        shift = rotate(self.turn.index_select(0, which), arm) - arm
        return shift.real + v_x, shift.imag + v_y


def rotate(rotation: Tensor, arm: Tensor) -> Tensor:
    """(K,) complex128: x + iy, rotated about the origin by the angle whose half has the tangent `rotation`, (K,)."""
    half = torch.complex(torch.ones_like(rotation), rotation)
    return half / half.conj() * arm


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
        flow[turns, 0], flow[turns, 1] = x, y
        return flow.float()


def motion_by_pixel(
    sweeps: HeightSlicedSweeps,
    objects: Objects,
    rigid: RigidMotion,
    score: Tensor,
    confidence: Tensor,
    is_weak: Tensor,
) -> TurningMotion:
    """The motion of G objects, by pixel: clusters are the P pixels. Scores are (G,), confidence is (P + 1,).
    Objects that are weak, (G,) bool, give way to moving objects under an overhang.

    Convention: in a window the ids of objects of its copies go on after those of the window itself.
    """
    home = sweeps.pixels.window.index_select(0, objects.first) % len(sweeps.batch.rows)
    ordered, order = home.sort(stable=True)
    ids = torch.empty_like(home).index_copy_(0, order, index_in_group(ordered))
    of_pixel = F.pad(objects.of_pixel, (0, 1), value=objects.count)
    moves = rigid.flow.any(1) | (rigid.turn != 0)
    return TurningMotion(
        cluster_of_cell=torch.arange(sweeps.num_pixels + 1, device=home.device),
        cell_of_point=_pixel_of_result(sweeps, lookup(moves, of_pixel), lookup(moves & ~is_weak, of_pixel)),
        flow=F.pad(rigid.flow, (0, 1, 0, 1)).index_select(0, of_pixel),
        cluster_id=F.pad(ids, (0, 1), value=-1).index_select(0, of_pixel),
        score=lookup(score, of_pixel),
        confidence=confidence,
        turn=F.pad(rigid.turn, (0, 1)).index_select(0, of_pixel),
        centre=F.pad(rigid.centre, (0, 0, 0, 1)).index_select(0, of_pixel),
    )


def _pixel_of_result(sweeps: HeightSlicedSweeps, moves: Tensor, is_sure: Tensor) -> Tensor:
    """(N,) int64, the pixel whose motion each point has, P = none: that of its copy, if that moves and its own is not
    sure to move; (P + 1,) bool each."""
    num_points = sweeps.batch.image.numel()
    pixel, copy = sweeps.pixel_of_point[:num_points], sweeps.pixel_of_point[num_points:]
    own = pixel.index_select(0, sweeps.copied)
    takes_copy = moves.index_select(0, copy) & ~is_sure.index_select(0, own)
    pixel = pixel.index_copy(0, sweeps.copied, torch.where(takes_copy, copy, own))
    return torch.where(sweeps.batch.has_result, pixel, sweeps.num_pixels)
