"""The reference driver, and the errors of a drive relative to it.

The reference drives the same path on an empty road. Its speed is limited by curvature, by braking before bends and by
accelerating after them; its steering is the bicycle model's for the path's curvature.

The errors are e_v = v - v_ref in m/s and e_delta = delta - delta_ref in degrees (Trasnea et al. 2019), compared at the
same place of the path, not at the same time: a delay of a second is not an error for the rest of the drive. Means are
over metres, so that time at standstill has no weight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gridsim.config import VehicleConfig
from gridsim.errors import GridSimError
from gridsim.maps.map import Map

PACE = 0.9  # speed on a straight: 0 is the lower end of the scenario's speed interval, 1 the upper
LATERAL = 3.2  # m/s2 in bends, below the grip limit
ACCELERATION = 3.0  # m/s2
BRAKING = 2.5  # m/s2 before bends
WINDOW = 10.0  # units (`SimConfig.unit`) of a path over which curvature is averaged, as a driver's steering is jerky
_STANDING = 1e-6  # m; a car that gets no farther in a control step stands


def arc_length(points: np.ndarray) -> np.ndarray:
    """Arc length (m) at points [n, 2] of a path: float64 [n]."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def curvature_along(points: np.ndarray, arc: np.ndarray, window: float = WINDOW) -> np.ndarray:
    """Curvature (1/m, left positive) at points [n, 2] of a path, from the chords of `window` / 2 m before and after.

    Chords end where the path ends. Points with less than `window` / 4 m of path on one side (or a quarter of a path
    shorter than `window`) get the curvature of the nearest point that has as much. `arc` is the points' `arc_length`.
    """

    def point(s: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(s, arc, axis) for axis in points.T])

    least = min(window, arc[-1] - arc[0]) / 4
    middle = np.clip(arc, arc[0] + least, arc[-1] - least)
    back, front = np.maximum(middle - window / 2, arc[0]), np.minimum(middle + window / 2, arc[-1])
    (ax, ay), (bx, by) = point(middle) - point(back), point(front) - point(middle)
    return np.arctan2(ax * by - ay * bx, ax * bx + ay * by) / ((front - back) / 2)


def top_speed(interval: tuple[float, float]) -> float:
    """Speed (m/s) of the reference on a straight, from the scenario's speed interval."""
    low, high = interval
    return low + PACE * (high - low)


def profile(
    points: np.ndarray,
    interval: tuple[float, float],
    start_speed: float,
    vehicle: VehicleConfig,
    window: float = WINDOW,
) -> tuple[np.ndarray, np.ndarray]:
    """Speed (m/s) and steering (rad, left positive) of the reference along a driven path: float64 [n] each.

    Args: `points` [n, 2] in m, in driving order, all different, not wrapped over the torus; `interval`, the scenario's
    speed interval, m/s; `start_speed`, the greatest speed at the first point, m/s; `window` as in `curvature_along`.
    """
    arc = arc_length(points)
    curvature = curvature_along(points, arc, window)
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


class Series(NamedTuple):
    """A drive and its reference at the same n places of the driven path; float64 [n]."""

    arc: np.ndarray  # m driven by the agent, increasing
    speed: np.ndarray  # m/s, the agent's
    reference_speed: np.ndarray  # m/s
    steering: np.ndarray  # rad, left positive, the agent's
    reference_steering: np.ndarray  # rad


def errors(parts: Sequence[Series], vehicle: VehicleConfig) -> dict[str, float]:
    """The errors of several drives together, by name: means over the metres (trapezoidal rule) and maxima of |e|.

    Besides these, the result has `reference_mps`, the reference's mean speed, and `metres`.
    In percent, errors of velocity are relative to the reference's mean speed, since its speed at a place may be 0, and
    errors of steering to the steering limit on one side, since the reference's angle is 0 on a straight.
    """
    parts = [part for part in parts if len(part.arc) > 1]
    metres = sum(float(part.arc[-1] - part.arc[0]) for part in parts)
    if not metres > 0.0:
        raise GridSimError("nothing was driven that could be compared with a reference")

    def mean(values: Sequence[np.ndarray]) -> float:
        return sum(float(np.trapezoid(each, part.arc)) for each, part in zip(values, parts, strict=True)) / metres

    velocity = [np.abs(part.speed - part.reference_speed) for part in parts]
    steering = [np.abs(np.degrees(part.steering - part.reference_steering)) for part in parts]
    reference = mean([part.reference_speed for part in parts])
    found = {"reference_mps": reference, "metres": metres}
    for name, unit, values, whole in (
        ("velocity", "mps", velocity, reference),
        ("steering", "deg", steering, vehicle.steering_limit),
    ):
        for kind, value in (("mean", mean(values)), ("max", max(float(each.max()) for each in values))):
            found |= {f"{name}_{kind}_{unit}": value, f"{name}_{kind}_percent": 100.0 * value / whole}
    return found


def error_series(poses: np.ndarray, road_map: Map, vehicle: VehicleConfig) -> Series:
    """A drive and the reference's profile along its path, from poses [n, 5] at the control steps (`state.poses_of`).

    Left out are reversing, the metres that are driven again after it, and standing, where steering has no effect; the
    first WINDOW / 2 units, where the curvature is not known; and the last metres, where the reference might brake for
    what lies beyond.

    The reference begins with the agent's speed (or less, in a bend) and ignores traffic. It follows the driven path,
    whose curvature is averaged over WINDOW units: if the agent weaves in longer waves, the reference weaves, too, but
    drives more slowly. So the errors of both steering and speed matter. The Series is empty if all is left out.
    Raises: ValueError if nothing was driven forwards.
    """
    poses = np.asarray(poses, dtype=np.float64)
    steps = road_map.shortest(np.diff(poses[:, :2], axis=0))
    points = np.concatenate([poses[:1, :2], poses[0, :2] + np.cumsum(steps, axis=0)])  # not wrapped over the torus
    way = np.hypot(*steps.T)
    forward = np.concatenate([[0.0], np.cumsum(np.where(poses[1:, 3] + poses[:-1, 3] < 0.0, -way, way))])
    furthest = np.maximum.accumulate(forward)
    rows = np.flatnonzero(np.append(poses[0, 3] > 0.0, forward[1:] > furthest[:-1] + _STANDING))
    if len(rows) < 2:
        raise ValueError("nothing was driven that could be compared with a reference")
    points, (driven_speed, driven_steering) = points[rows], poses[rows, 3:].T
    arc = arc_length(points)
    interval = float(road_map.road.speed_low), float(road_map.road.speed_high)
    window = WINDOW * float(road_map.road.unit)
    speed, steering = profile(points, interval, float(driven_speed[0]), vehicle, window)
    unknown = np.flatnonzero(arc + speed**2 / (2.0 * BRAKING) > arc[-1])
    part = slice(int(np.searchsorted(arc, window / 2)), int(unknown[0]))
    return Series(arc[part], driven_speed[part], speed[part], driven_steering[part], steering[part])
