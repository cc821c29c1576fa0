"""Rigid motion of groups in the plane: a translation and a turn about a centre."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Tuple

from torch import Tensor


@dataclass(frozen=True)
class RigidMotion:
    """Motion of G groups per sweep interval.

    Args:
        flow: (G, 2) float64, x and y at the centre, metres, axes of ego1.
        turn: (G,) float64, tangent of half the angle, counter-clockwise.
        centre: (G, 2) float64, x and y, metres, frame of t+1.
    """

    flow: Tensor
    turn: Tensor
    centre: Tensor

    def flow_at(self, group: Tensor, x: Tensor, y: Tensor) -> Tuple[Tensor, Tensor]:
        """x and y of the flow, metres per interval, of points of t (K,), by their group and their place in metres."""
        (c_x, c_y), (v_x, v_y) = (values.index_select(0, group).unbind(1) for values in (self.centre, self.flow))
        x, y = x - c_x, y - c_y
        turned_x, turned_y = rotate(self.turn.index_select(0, group), x, y)
        return (turned_x - x) + v_x, (turned_y - y) + v_y


def rotate(turn: Tensor, x: Tensor, y: Tensor) -> Tuple[Tensor, Tensor]:
    """Rotate by the angle whose half has the tangent `turn`: no trigonometry, the same bits on every device."""
    n = 1 + turn * turn
    cos, sin = (1 - turn * turn) / n, 2 * turn / n
    return cos * x - sin * y, sin * x + cos * y
