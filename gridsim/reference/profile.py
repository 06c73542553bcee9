"""The reference driver: the speed and steering that a path calls for on an empty road.

Its speed is limited by curvature, by braking before bends and by accelerating after them. Its steering is the bicycle
model's for the path's curvature.
"""

from __future__ import annotations

import math

import numpy as np

from gridsim.config import VehicleConfig

PACE = 0.9  # speed on a straight: 0 is the lower end of the scenario's speed interval, 1 the upper
LATERAL = 3.2  # m/s2 in bends, below the grip limit
ACCELERATION = 3.0  # m/s2
BRAKING = 2.5  # m/s2 before bends
WINDOW = 10.0  # m of a path over which its curvature is measured, because a driver's steering is jerky


def arc_length(points: np.ndarray) -> np.ndarray:
    """Arc length (m) at points [n, 2] of a path: float64 [n]."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def curvature_along(points: np.ndarray, arc: np.ndarray) -> np.ndarray:
    """Curvature (1/m) at points [n, 2] of a path, from the chords of `WINDOW` / 2 m before and after each.

    Near the path's ends it is that of the nearest point with `WINDOW` / 4 m on either side.
    """

    def point(s: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(s, arc, axis) for axis in points.T])

    least = min(WINDOW, arc[-1] - arc[0]) / 4
    middle = np.clip(arc, arc[0] + least, arc[-1] - least)
    back, front = np.maximum(middle - WINDOW / 2, arc[0]), np.minimum(middle + WINDOW / 2, arc[-1])
    (ax, ay), (bx, by) = point(middle) - point(back), point(front) - point(middle)
    return np.arctan2(ax * by - ay * bx, ax * bx + ay * by) / ((front - back) / 2)


def top_speed(interval: tuple[float, float]) -> float:
    """Speed (m/s) of the reference on a straight, from the scenario's speed interval."""
    low, high = interval
    return low + PACE * (high - low)


def profile(
    points: np.ndarray, interval: tuple[float, float], start_speed: float, vehicle: VehicleConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Speed (m/s) and steering (rad, left positive) of the reference along a driven path: float64 [n] each.

    Args: points [n, 2] in m, in order, all different, not wrapped over the torus; speed at the first point, m/s.
    """
    arc = arc_length(points)
    curvature = curvature_along(points, arc)
    squared = np.minimum(top_speed(interval) ** 2, LATERAL / np.maximum(np.abs(curvature), 1e-9))
    braking = 2.0 * BRAKING * arc
    squared = np.minimum.accumulate((squared + braking)[::-1])[::-1] - braking
    squared[0] = min(squared[0], start_speed**2)
    accelerating = 2.0 * ACCELERATION * arc
    speed = np.sqrt(np.minimum.accumulate(squared - accelerating) + accelerating)
    slip = np.arcsin(np.clip(curvature * vehicle.rear_axle, -1.0, 1.0))
    limit = math.radians(vehicle.steering_limit)
    steering = np.arctan(np.tan(slip) * vehicle.wheelbase / vehicle.rear_axle)
    return speed, np.clip(steering, -limit, limit)
