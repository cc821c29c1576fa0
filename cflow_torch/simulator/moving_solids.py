"""Poses of all solids of a scene during a sweep."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from cflow_torch.simulator.raycast import ELLIPSOID, take


@dataclass(frozen=True)
class MovingSolids:
    """P solids during an interval of time. Coordinates are relative to `origin`, so that float32 resolves micrometres.

    Args:
        kind: (P,) int64.
        half_size: (P, 3) float64, metres.
        albedo, is_foliage, is_own: (P,) float32, (P,) bool, (P,) bool = part of the recording vehicle.
        origin: (3,) float64, world metres.
        knots: (K + 1,) float64 seconds, evenly spaced, K >= 1.
        static: (P, 3, 4) float64, world (relative to `origin`) to solid, at the first knot.
        row: (P,) int64, row of `dynamic` of each solid, -1 = static.
        dynamic: (K + 1, M, 3, 4) float64, world to solid at the knots; elements are interpolated in between.
    """

    kind: Tensor
    half_size: Tensor
    albedo: Tensor
    is_foliage: Tensor
    is_own: Tensor
    origin: Tensor
    knots: Tensor
    static: Tensor
    row: Tensor
    dynamic: Tensor

    def at(self, solid: Tensor, seconds: Tensor) -> tuple[Tensor, Tensor]:
        """Transforms from the world to solids, and their derivatives.

        Args:
            solid: (E,) int64.
            seconds: (E,) float64.

        Returns:
            (E, 3, 4) float64 transform; (E, 3, 4) float64 its derivative, per second.
        """
        transform = self.static.index_select(0, solid)
        change = torch.zeros_like(transform)
        row = take(self.row, solid)
        chosen = (row >= 0).nonzero()[:, 0]
        if len(chosen):
            transform[chosen], change[chosen] = self.dynamic_at(take(row, chosen), take(seconds, chosen))
        return transform, change

    def dynamic_at(self, row: Tensor, seconds: Tensor) -> tuple[Tensor, Tensor]:
        """Transforms from the world to rows (E,) int64 of `dynamic`, and their derivatives: (E, 3, 4) float64 each."""
        step = float(self.knots[1] - self.knots[0])
        after = seconds - self.knots[0]
        first = (after / step).floor().long().clamp(0, len(self.knots) - 2)
        index = first * self.dynamic.shape[1] + row
        flat = self.dynamic.flatten(0, 1)
        begin = flat.index_select(0, index)
        slope = (flat.index_select(0, index + self.dynamic.shape[1]) - begin) / step
        return begin + (after - first * step)[:, None, None] * slope, slope

    @cached_property
    def radius(self) -> Tensor:
        """(P,) float64 of the bounding spheres, metres."""
        return torch.where(self.kind == ELLIPSOID, self.half_size.amax(1), self.half_size.norm(dim=1))

    @property
    def middle(self) -> Tensor:
        """() float64 seconds, the middle between the first and the last knot."""
        return 0.5 * (self.knots[0] + self.knots[-1])

    @cached_property
    def centres(self) -> tuple[Tensor, Tensor]:
        """(P, 3) float64 centres of the solids at `middle`; (P,) upper bound of the speed of any part of them, m/s."""
        count = len(self.kind)
        transform, _ = self.at(torch.arange(count), self.middle.expand(count))
        centre = rotate(transform[:, :, :3].transpose(1, 2), -transform[:, :, 3])
        speed = torch.zeros(count, dtype=torch.float64)
        moving = (self.row >= 0).nonzero()[:, 0]
        arm = self.half_size[moving].norm(dim=1)
        for knot in self.knots[:-1]:  # every interval, because legs swing
            _, change = self.dynamic_at(self.row[moving], knot.expand(len(moving)))
            at_centre = rotate(change[:, :, :3], centre[moving]) + change[:, :, 3]
            rotation = change[:, :, :3].flatten(1).norm(dim=1) * arm
            speed[moving] = torch.maximum(speed[moving], at_centre.norm(dim=1) + rotation)
        return centre, 1.1 * speed


def rotate(matrices: Tensor, vectors: Tensor) -> Tensor:
    """(E, 3, 3) times (E, 3)."""
    return (matrices @ vectors[..., None])[..., 0]
