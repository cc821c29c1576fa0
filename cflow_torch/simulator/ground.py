"""The ground of a simulated scene: a gently curved road surface, kerbs, and raised pavements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

NOWHERE = 1e5  # `crossing_x` of a scene without a cross street: no ray reaches it, metres
_BISECTIONS = 12  # along a ray from pavement level to road level; they find the kerb face to a millimetre


@dataclass(frozen=True)
class Ground:
    """Height field z(x, y) in the world: two streets that cross, with kerbs and pavements.

    The road is `z = slope . (x, y) + curvature / 2 * x**2`, and the pavement is `kerb` above it. One street runs along
    x (centre y = 0), the other along y (centre x = crossing_x).

    Args:
        slope: rise per metre along x and y.
        curvature: change of the slope per metre along x, 1/m (a crest or a dip).
        kerb: height of the pavement above the road, metres.
        half_widths: half the distance between the kerbs, of the street along x and of the street along y, metres.
        crossing_x: centre of the street along y, metres.
        corner_radius: radius of the kerbs at the crossing, metres.
    """

    slope: tuple[float, float]
    curvature: float
    kerb: float = 0.13
    half_widths: tuple[float, float] = (8.5, 6.5)
    crossing_x: float = 20.0
    corner_radius: float = 4.0

    def road_height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Height of the road surface (continued below the pavements), metres."""
        return self.slope[0] * x + self.slope[1] * y + 0.5 * self.curvature * x * x

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Height of road or pavement at world (x, y), float64 metres."""
        depth = self.pavement_depth(torch.from_numpy(x), torch.from_numpy(y)).numpy()
        return self.road_height(x, y) + self.kerb * (depth > 0)

    def pavement_depth(self, x: Tensor, y: Tensor) -> Tensor:
        """Distance of (x, y) from the kerb: positive on the pavement, negative on the road, metres."""
        u = y.abs() - self.half_widths[0]
        v = (x - self.crossing_x).abs() - self.half_widths[1]
        radius = self.corner_radius
        in_corner = (u < radius) & (v < radius) & (u > 0) & (v > 0)
        return torch.where(in_corner, radius - torch.hypot(radius - u, radius - v), torch.minimum(u, v))

    def pose(self, x: np.ndarray, y: np.ndarray, yaw: np.ndarray) -> np.ndarray:
        """Poses of frames on the ground, tilted with it.

        Args:
            x, y: (...,) world position, metres.
            yaw: (...,) heading, radians.

        Returns:
            (..., 4, 4) float64 `T_world_body`: x axis ahead, z axis normal to the ground, origin on the ground. At a
            kerb, the height rises over half a metre, not in one step, so that bodies do not jump.
        """
        slope_x = self.slope[0] + self.curvature * x
        slope_y = np.broadcast_to(self.slope[1], x.shape)
        depth = self.pavement_depth(torch.from_numpy(x), torch.from_numpy(y)).numpy()
        z = self.road_height(x, y) + self.kerb * np.clip(0.5 + depth / 0.5, 0, 1)
        up = np.stack([-slope_x, -slope_y, np.ones_like(x)], -1)
        ahead = np.stack([np.cos(yaw), np.sin(yaw), slope_x * np.cos(yaw) + slope_y * np.sin(yaw)], -1)
        up /= np.linalg.norm(up, axis=-1, keepdims=True)
        ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
        pose = np.zeros((*x.shape, 4, 4))
        pose[..., :3, :] = np.stack([ahead, np.cross(up, ahead), up, np.stack([x, y, z], -1)], -1)
        pose[..., 3, 3] = 1
        return pose

    def cast(self, origin: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Intersect rays with the ground.

        Args:
            origin: (3,) or (3, R) float64, world metres, above the ground.
            directions: (3, R) unit vectors, world axes.

        Returns:
            (R,) range in metres, inf = no intersection; (R,) cosine of the angle of incidence; both in the dtype of
            `directions`.
        """
        x, y, z = (value.numpy() for value in origin)
        slope_x = torch.from_numpy(np.asarray(self.slope[0] + self.curvature * x)).to(directions.dtype)
        # A ray meets the road surface, raised by `lift`, at the range t where a + b t + c t**2 = 0.
        b = directions[2] - slope_x * directions[0] - self.slope[1] * directions[1]
        c = -0.5 * self.curvature * directions[0] ** 2

        def meet(lift: float) -> tuple[Tensor, Tensor]:
            a = torch.from_numpy(np.asarray(z - self.road_height(x, y) - lift)).to(directions.dtype)
            root = (b * b - 4 * a * c).sqrt()  # NaN if the ray passes over the crest
            t = 2 * a / (root - b)  # this form avoids cancellation
            return torch.where(t > 0, t, torch.inf), root

        raised, _ = meet(self.kerb)
        low, root = meet(0.0)
        cosine = root.nan_to_num()
        hits_pavement = self._is_pavement_along(origin, directions, raised)
        # A ray hits a kerb if it is beside the pavement at pavement level, but under the pavement at road level.
        hits_kerb = ~hits_pavement & self._is_pavement_along(origin, directions, low)
        if bool(hits_kerb.any()):
            if origin.dim() > 1:
                origin = origin.expand_as(directions)[:, hits_kerb]
            low[hits_kerb] = self._kerb_along(origin, directions[:, hits_kerb], raised[hits_kerb], low[hits_kerb])
            cosine[hits_kerb] = 0.5
        return torch.where(hits_pavement, raised, low), cosine

    def _kerb_along(self, origin: Tensor, directions: Tensor, near: Tensor, far: Tensor) -> Tensor:
        """Return the range at which rays, (3, R), meet the face of a kerb between two ranges, (R,) each."""
        for _ in range(_BISECTIONS):
            middle = 0.5 * (near + far)
            is_inside = self._is_pavement_along(origin, directions, middle)
            near = torch.where(is_inside, near, middle)
            far = torch.where(is_inside, middle, far)
        return 0.5 * (near + far)

    def _is_pavement_along(self, origin: Tensor, directions: Tensor, t: Tensor) -> Tensor:
        x, y = origin[:2].to(directions.dtype)
        return self.pavement_depth(x + t * directions[0], y + t * directions[1]) > 0
