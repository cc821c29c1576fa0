"""Rigid motion in the plane: a translation, and a rotation about a centre. It gives the flow of points."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.model import Motion
from cflow_torch.ops.indices import constant, flat_nonzero, gather, index_in_group, lookup, take_columns
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import HeightSlicedSweeps


@dataclass(frozen=True)
class RigidMotion:
    """Motion of G objects per sweep interval."""

    flow: Tensor  # (G, 2) float64, x and y at the centre, metres, axes of ego1
    rotation: Tensor  # (G,) float64, tangent of half the angle, counter-clockwise
    centre: Tensor  # (G, 2) float64, x and y of the centre at t, metres, frame of t+1

    def pixels_per_interval(self, pixel_size: float) -> Tensor:
        """Return the flow at the centre, (G, 2) float64, (y, x), in pixels; `pixel_size` is in metres."""
        return self.flow.flip(1) / constant((pixel_size,), self.flow.dtype, self.flow.device)  # see `Grid.pixel`

    def only(self, is_moving: Tensor) -> RigidMotion:
        """Keep the motion of the objects where `is_moving`, (G,) bool, and make the others static."""
        static = ~is_moving
        flow, rotation = self.flow.masked_fill(static[:, None], 0.0), self.rotation.masked_fill(static, 0.0)
        return RigidMotion(flow, rotation, self.centre)

    def flow_at(self, index: Tensor, position: Tensor) -> Tensor:
        """Return the flow of K points of t, (K, 2), metres per interval.

        `index`, (K,), is the object of each point; `position`, (2, K), its x and y, metres, frame of t+1.
        """
        centre, flow = (torch.view_as_complex(of.index_select(0, index)) for of in (self.centre, self.flow))
        arm = torch.complex(*position) - centre
        return torch.view_as_real(rotate(self.rotation.index_select(0, index), arm) - arm + flow)


def rotate(rotation: Tensor, arm: Tensor) -> Tensor:
    """Rotate x + iy, (K,) complex128, about the origin; `rotation`, (K,), is the tangent of half the angle."""
    half = torch.complex(constant((1.0,), rotation.dtype, rotation.device), rotation)
    return half / half.conj() * arm


@dataclass(frozen=True)
class RotatingMotion(Motion):
    """Motion along the ground, of clusters that may rotate."""

    rotation: Tensor = torch.empty(0)  # (M + 1,) float64, as in `RigidMotion`
    centre: Tensor = torch.empty(0)  # (M + 1, 2) float64, likewise
    slope: Tensor = torch.empty(0)  # (M + 1, 2) float64, height of the ground per metre in x and in y

    def residual_flow(self, points: slice, positions: Tensor) -> Tensor:
        """Return the flow of some points, (K, 3) float32, which depends on their positions if their object rotates."""
        cluster = self.cluster(points)
        flow = self.flow.index_select(0, cluster)
        rotating = flat_nonzero((self.rotation != 0).index_select(0, cluster))
        rigid, cluster = RigidMotion(self.flow[:, :2], self.rotation, self.centre), cluster.index_select(0, rotating)
        along = rigid.flow_at(cluster, take_columns(positions[:2], rotating))
        rise = self.slope.index_select(0, cluster) * along
        flow.index_copy_(0, rotating, torch.cat((along, rise[:, :1] + rise[:, 1:]), 1))
        return flow.float()


def motion_by_pixel(
    sweeps: HeightSlicedSweeps,
    objects: Objects,
    rigid: RigidMotion,
    score: Tensor,
    confidence: Tensor,
    is_weak: Tensor,
) -> RotatingMotion:
    """Return the motion of G objects by pixel; the clusters of the result are the P pixels.

    Args:
        rigid: motion of the objects in the plane. The slope of the ground around them gives the z of the flow.
        score: (G,) float32.
        confidence: (P + 1,) float32.
        is_weak: (G,) bool, objects whose points take the motion of their copies under an overhang, if those move.

    Convention: within a window, objects of copies have the last ids.
    """
    window = sweeps.pixels.window.index_select(0, objects.first)
    ordered, order = (window % len(sweeps.batch.rows)).sort(stable=True)
    ids = torch.empty_like(window).index_copy_(0, order, index_in_group(ordered))
    of_pixel = F.pad(objects.of_pixel, (0, 1), value=objects.count)
    is_moving = rigid.flow.any(1) | (rigid.rotation != 0)
    slope, moving = torch.zeros_like(rigid.flow), flat_nonzero(is_moving)
    if sweeps.batch.ground is not None:
        slope.index_copy_(0, moving, sweeps.batch.ground.slopes(*gather(moving, rigid.centre, window)))
    z = (slope * rigid.flow).sum(1, keepdim=True)
    rows = torch.cat((rigid.flow, z, rigid.rotation[:, None], rigid.centre, slope), 1)
    flow, rotation, centre, slope = lookup(rows, of_pixel).split((3, 1, 2, 2), 1)
    return RotatingMotion(
        cluster_of_cell=torch.arange(sweeps.num_pixels + 1, device=window.device),
        cell_of_point=_pixel_of_result(sweeps, lookup(is_moving, of_pixel), lookup(is_moving & ~is_weak, of_pixel)),
        flow=flow,
        cluster_id=lookup(ids, of_pixel, -1),
        score=lookup(score, of_pixel),
        confidence=confidence,
        rotation=rotation[:, 0],
        centre=centre,
        slope=slope,
    )


def _pixel_of_result(sweeps: HeightSlicedSweeps, is_moving: Tensor, is_sure: Tensor) -> Tensor:
    """Return the pixel whose motion each point takes, (N,) int64, P = none. A point takes the pixel of its copy if that
    pixel moves, unless its own pixel is sure, that is, moves and is not weak. Both masks are (P + 1,) bool."""
    num_points = sweeps.batch.image.numel()
    pixel, copy = sweeps.pixel_of_point[:num_points], sweeps.pixel_of_point[num_points:]
    own = pixel.index_select(0, sweeps.copied)
    takes_copy = is_moving.index_select(0, copy) & ~is_sure.index_select(0, own)
    pixel = pixel.index_copy(0, sweeps.copied, torch.where(takes_copy, copy, own))
    return torch.where(sweeps.batch.has_result, pixel, sweeps.num_pixels)
