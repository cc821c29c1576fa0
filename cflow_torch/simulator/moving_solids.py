"""Where every solid of a scene is during a sweep."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from cflow_torch.simulator.raycast import ELLIPSOID, take


@dataclass(frozen=True)
class MovingSolids:
    """P solids over a stretch of time. Coordinates are relative to `origin`, so that float32 keeps micrometres.

    Args:
        kind: (P,) int64.
        half_size: (P, 3) float64, metres.
        albedo: (P,) float32; is_foliage: (P,) bool; is_hidden: (P,) bool, parts of the recording vehicle.
        origin: (3,) float64, world metres.
        knots: (K + 1,) float64 seconds, evenly spaced, K >= 1.
        still: (P, 3, 4) float64, world (relative to `origin`) to solid, at the first knot.
        row: (P,) int64, row of `moving` of each solid, -1 = stands still.
        moving: (K + 1, M, 3, 4) float64, world to solid at the knots; the elements are interpolated between them.
    """

    kind: Tensor
    half_size: Tensor
    albedo: Tensor
    is_foliage: Tensor
    is_hidden: Tensor
    origin: Tensor
    knots: Tensor
    still: Tensor
    row: Tensor
    moving: Tensor

    def at(self, solid: Tensor, seconds: Tensor) -> tuple[Tensor, Tensor]:
        """World to solid, and how it changes.

        Args:
            solid: (E,) int64; seconds: (E,) float64.

        Returns:
            (E, 3, 4) float64 transform; (E, 3, 4) float64 its derivative, per second.
        """
        place = self.still.index_select(0, solid)
        change = torch.zeros_like(place)
        row = take(self.row, solid)
        chosen = (row >= 0).nonzero()[:, 0]
        if len(chosen):
            place[chosen], change[chosen] = self.moving_at(take(row, chosen), take(seconds, chosen))
        return place, change

    def moving_at(self, row: Tensor, seconds: Tensor) -> tuple[Tensor, Tensor]:
        """As `at`, by rows (E,) int64 of `moving`."""
        step = float(self.knots[1] - self.knots[0])
        after = seconds - self.knots[0]
        first = (after / step).floor().long().clamp(0, len(self.knots) - 2)
        number = first * self.moving.shape[1] + row
        flat = self.moving.flatten(0, 1)
        begin = flat.index_select(0, number)
        slope = (flat.index_select(0, number + self.moving.shape[1]) - begin) / step
        return begin + (after - first * step)[:, None, None] * slope, slope

    @cached_property
    def radius(self) -> Tensor:
        """(P,) float64 of the bounding spheres, metres."""
        return torch.where(self.kind == ELLIPSOID, self.half_size.amax(1), self.half_size.norm(dim=1))

    @property
    def middle(self) -> Tensor:
        """() float64 seconds, half way from the first to the last knot."""
        return 0.5 * (self.knots[0] + self.knots[-1])

    @cached_property
    def centres(self) -> tuple[Tensor, Tensor]:
        """(P, 3) float64 where the solids are at `middle`; (P,) m/s that no part of them exceeds."""
        number = len(self.kind)
        place, _ = self.at(torch.arange(number), self.middle.expand(number))
        centre = rotate(place[:, :, :3].transpose(1, 2), -place[:, :, 3])
        speed = torch.zeros(number, dtype=torch.float64)
        movers = (self.row >= 0).nonzero()[:, 0]
        arm = self.half_size[movers].norm(dim=1)
        for knot in self.knots[:-1]:  # legs swing, so every stretch counts
            _, change = self.moving_at(self.row[movers], knot.expand(len(movers)))
            at_centre = rotate(change[:, :, :3], centre[movers]) + change[:, :, 3]
            turning = change[:, :, :3].flatten(1).norm(dim=1) * arm
            speed[movers] = torch.maximum(speed[movers], at_centre.norm(dim=1) + turning)
        return centre, 1.1 * speed


def rotate(matrices: Tensor, vectors: Tensor) -> Tensor:
    """(E, 3, 3) times (E, 3)."""
    return (matrices @ vectors[..., None])[..., 0]
