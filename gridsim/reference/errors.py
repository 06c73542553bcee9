"""Velocity error and steering error of a drive, relative to a reference along the same route.

e_v = v - v_ref in m/s and e_delta = delta - delta_ref in degrees (Trasnea et al. 2019), compared at the same place of
the route, not at the same time: a delay of a second is not an error for the rest of the drive. Means are over metres,
so that time at standstill has no weight. The reference is `profile.profile` along the driven path.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gridsim.config import VehicleConfig
from gridsim.errors import GridSimError
from gridsim.maps.map import Map
from gridsim.reference.profile import BRAKING, WINDOW, arc_length, profile

_STANDING = 1e-6  # m


class Series(NamedTuple):
    """A drive and its reference at the same places of a route; float64 [n]."""

    arc: np.ndarray  # m driven by the agent, increasing
    speed: np.ndarray  # m/s, the agent's
    reference_speed: np.ndarray  # m/s
    steering: np.ndarray  # rad, left positive, the agent's
    reference_steering: np.ndarray  # rad


def errors(parts: Sequence[Series], vehicle: VehicleConfig) -> dict[str, float]:
    """The errors of several drives together, by name: means over the metres (trapezoidal rule) and maxima of |e|.

    Velocity in percent is relative to the reference's mean speed, since its speed at a place may be 0; steering to the
    steering limit to one side, since the reference's angle is 0 on a straight.

    Raises: GridSimError, a ValueError, if nothing was driven.
    """
    parts = [part for part in parts if len(part.arc) > 1]
    metres = sum(float(part.arc[-1] - part.arc[0]) for part in parts)
    if not metres > 0.0:
        raise GridSimError("nothing was driven that could be compared with a reference")

    def mean(values: Sequence[np.ndarray]) -> float:
        return sum(float(np.trapezoid(each, part.arc)) for each, part in zip(values, parts, strict=True)) / metres

    velocity = [np.abs(part.speed - part.reference_speed) for part in parts]
    steering = [np.abs(np.degrees(part.steering - part.reference_steering)) for part in parts]
    velocity_mean, velocity_max = mean(velocity), max(float(each.max()) for each in velocity)
    steering_mean, steering_max = mean(steering), max(float(each.max()) for each in steering)
    reference = mean([part.reference_speed for part in parts])
    return {
        "velocity_mean_mps": velocity_mean,
        "velocity_max_mps": velocity_max,
        "velocity_mean_percent": 100.0 * velocity_mean / reference,
        "velocity_max_percent": 100.0 * velocity_max / reference,
        "reference_mps": reference,
        "steering_mean_deg": steering_mean,
        "steering_max_deg": steering_max,
        "steering_mean_percent": 100.0 * steering_mean / vehicle.steering_limit,
        "steering_max_percent": 100.0 * steering_max / vehicle.steering_limit,
        "metres": metres,
    }


def error_series(poses: np.ndarray, road_map: Map, vehicle: VehicleConfig) -> Series:
    """A drive and the reference's profile along its path, from poses [n, 5] at the control steps (`drive.poses_of`).

    Left out are reversing, metres that are driven again, and standing, where steering has no effect; the first 5 m,
    whose curvature is not known; and the end, from where the reference could not have stopped for what may come.

    The reference begins with the agent's speed and ignores traffic. Its curvature is that of the driven path over 10 m:
    an agent that weaves in longer waves slows it down, so look at both errors.

    Raises: ValueError if the car never moved forward.
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
    speed, steering = profile(points, interval, float(driven_speed[0]), vehicle)
    unknown = np.flatnonzero(arc + speed**2 / (2.0 * BRAKING) > arc[-1])
    part = slice(int(np.searchsorted(arc, WINDOW / 2)), int(unknown[0]))
    return Series(arc[part], driven_speed[part], speed[part], driven_steering[part], steering[part])
