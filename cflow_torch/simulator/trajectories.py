"""Trajectories of bodies: routes at constant speed or acceleration, and those of trailers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Route:
    """A straight line, an arc and a straight line, at constant speed or acceleration.

    Args:
        x, y: beginning of the arc, world metres; if `angle` is 0, any point of the line.
        yaw: heading at (x, y), radians.
        start: position along the route at time 0, metres from the beginning of the arc; negative = before it.
        speed: m/s at time 0; negative = in reverse.
        radius: radius of the arc, metres.
        angle: angle of the arc, radians, positive = left.
        acceleration: m/s^2. A body that has braked to a standstill stays there.
    """

    x: float
    y: float
    yaw: float = 0.0
    start: float = 0.0
    speed: float = 0.0
    radius: float = 1.0
    angle: float = 0.0
    acceleration: float = 0.0

    def __call__(self, seconds: np.ndarray) -> np.ndarray:
        """(T, 3) float64 world x, y, yaw at `seconds` (T,)."""
        return self.at(self.distance(seconds))

    def distance(self, seconds: np.ndarray) -> np.ndarray:
        """Return the position along the route at `seconds` (T,): (T,) metres from the beginning of the arc."""
        if self.acceleration == 0:
            return np.asarray(self.start + self.speed * seconds)
        stop = -self.speed / self.acceleration
        # A braking body stays where it stops. An accelerating one stood still until `stop` <= 0.
        seconds = np.minimum(seconds, stop) if self.speed * self.acceleration < 0 else np.maximum(seconds, stop)
        return np.asarray(self.start + self.speed * seconds + 0.5 * self.acceleration * seconds**2)

    @property
    def is_static(self) -> bool:
        """True if the body never moves."""
        return self.speed == 0 and self.acceleration == 0

    def at(self, distance: np.ndarray) -> np.ndarray:
        """(T, 3) float64 world x, y, yaw at `distance` (T,) metres from the beginning of the arc."""
        side = math.copysign(1.0, self.angle)
        angle = np.clip(distance / self.radius, 0, abs(self.angle))
        beyond = np.maximum(distance - self.radius * abs(self.angle), 0)
        ahead = np.minimum(distance, 0) + self.radius * np.sin(angle) + beyond * math.cos(self.angle)
        left = side * self.radius * (1 - np.cos(angle)) + beyond * math.sin(self.angle)
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        x, y = self.x + cos * ahead - sin * left, self.y + sin * ahead + cos * left
        return np.stack([x, y, self.yaw + side * angle], -1)


@dataclass(frozen=True)
class Towed:
    """The trajectory of a trailer: its axle follows the hitch along a tractrix.

    Args:
        tractor: route of the origin of the tractor's body frame.
        hitch: distance of the hitch behind this origin, metres; negative = ahead of it.
        wheelbase: distance from the hitch to the trailer's axle, metres.
        middle: distance from the hitch to the trailer's middle, metres.
    """

    tractor: Route
    hitch: float
    wheelbase: float
    middle: float

    def __call__(self, seconds: np.ndarray) -> np.ndarray:
        """(T, 3) float64 world x, y, yaw of the trailer's middle at `seconds` (T,)."""
        wanted = self.tractor.distance(seconds)
        # A straight run of four wheelbases first settles the angle. Steps of 5 cm are accurate to a millimetre.
        begin = min(float(wanted.min()), 0.0) - 4 * self.wheelbase
        distance = np.linspace(begin, float(wanted.max()), 2 + int((float(wanted.max()) - begin) / 0.05))
        poses = self.tractor.at(distance)
        heading = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], -1)
        hitches = poses[:, :2] - self.hitch * heading
        axles = np.empty_like(hitches)
        axles[0] = hitches[0] - self.wheelbase * heading[0]
        for i in range(1, len(hitches)):
            pull = hitches[i] - axles[i - 1]
            axles[i] = hitches[i] - pull * (self.wheelbase / math.hypot(pull[0], pull[1]))
        pull = hitches - axles
        yaw = np.unwrap(np.arctan2(pull[:, 1], pull[:, 0]))
        middles = hitches - pull * (self.middle / self.wheelbase)
        return np.stack([np.interp(wanted, distance, values) for values in (*middles.T, yaw)], -1)
