"""Velocity error and steering error of a drive, relative to a reference along the same route.

e_v = v - v_ref in m/s and e_delta = delta - delta_ref in degrees (Trasnea et al. 2019), compared at the same place of
the route, not at the same time: a delay of a second is not an error for the rest of the drive. Means are over metres,
so that time at standstill has no weight. The reference is `routes.profile` along the driven path, or a recorded drive.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gridsim.car.ego import COS, SIN, SPEED, STEERING, X, Y
from gridsim.config import SimConfig, VehicleConfig
from gridsim.maps.map import Map
from gridsim.reference.routes import BRAKING, DRIVEN_WINDOW, profile, unwrapped

APART = 3.5  # m beside the recorded path, a lane's width, beyond which a drive has left it
TURNED = math.radians(45.0)  # difference of headings beyond which it has
TURN = 12.0  # m left out before that, since the bend in which they part begins earlier
_STANDING = 1e-6  # m


class Driven(NamedTuple):
    """A drive as a path of new ground, without what was reversed and driven again."""

    arc: np.ndarray  # float64 [n], m driven, increasing
    points: np.ndarray  # float64 [n, 2], m, not wrapped over the torus
    heading: np.ndarray  # float64 [n], rad
    speed: np.ndarray  # float64 [n], m/s
    steering: np.ndarray  # float64 [n], rad, left positive
    rows: np.ndarray  # int64 [n], indices of these states in the drive


class Series(NamedTuple):
    """A drive and its reference at the same places of a route; float64 [n]."""

    arc: np.ndarray  # m driven by the agent, increasing
    speed: np.ndarray  # m/s, the agent's
    reference_speed: np.ndarray  # m/s
    steering: np.ndarray  # rad, left positive, the agent's
    reference_steering: np.ndarray  # rad

    @property
    def velocity_error(self) -> np.ndarray:
        """float64 [n], m/s, positive where the agent is faster."""
        return self.speed - self.reference_speed

    @property
    def steering_error(self) -> np.ndarray:
        """float64 [n], degrees, positive where the agent steers further to the left."""
        return np.degrees(self.steering - self.reference_steering)

    def errors(self, vehicle: VehicleConfig | None = None) -> Errors:
        """Means over the metres (trapezoidal rule) and maxima.

        Raises: ValueError if nothing was driven.
        """
        metres = float(self.arc[-1] - self.arc[0]) if len(self.arc) > 1 else 0.0
        if not metres > 0.0:
            raise ValueError("nothing was driven that could be compared with a reference")

        def mean(values: np.ndarray) -> float:
            return float(np.trapezoid(values, self.arc)) / metres

        velocity, steering = np.abs(self.velocity_error), np.abs(self.steering_error)
        return Errors(
            mean(velocity),
            float(velocity.max()),
            mean(self.reference_speed),
            mean(steering),
            float(steering.max()),
            (vehicle or VehicleConfig()).steering_limit,
            metres,
        )


class Errors(NamedTuple):
    """Velocity and steering errors of one or several drives: of |e_v| and |e_delta|."""

    velocity_mean_mps: float  # over the metres
    velocity_max_mps: float
    reference_mps: float  # mean speed of the reference over the same metres
    steering_mean_deg: float  # over the metres
    steering_max_deg: float
    steering_limit_deg: float
    metres: float  # m compared

    def figures(self) -> dict[str, float]:
        """The figures by name, for tables and JSON.

        Velocity in percent is relative to the reference's mean speed, since its speed at a place may be 0; steering to
        the steering limit to one side, since the reference's angle is 0 on a straight.
        """
        return {
            "velocity_mean_mps": self.velocity_mean_mps,
            "velocity_max_mps": self.velocity_max_mps,
            "velocity_mean_percent": 100.0 * self.velocity_mean_mps / self.reference_mps,
            "velocity_max_percent": 100.0 * self.velocity_max_mps / self.reference_mps,
            "reference_mps": self.reference_mps,
            "steering_mean_deg": self.steering_mean_deg,
            "steering_max_deg": self.steering_max_deg,
            "steering_mean_percent": 100.0 * self.steering_mean_deg / self.steering_limit_deg,
            "steering_max_percent": 100.0 * self.steering_max_deg / self.steering_limit_deg,
            "metres": self.metres,
        }


def combine(parts: Sequence[Errors]) -> Errors:
    """The errors of several drives of one kind of car together: means weighted by metres, largest maxima.

    Raises: ValueError if there are none.
    """
    if not parts:
        raise ValueError("nothing was driven that could be compared with a reference")
    table = Errors(*np.array(parts).T)
    mean = Errors(*np.average(parts, axis=0, weights=table.metres).tolist())
    return mean._replace(
        velocity_max_mps=float(np.max(table.velocity_max_mps)),
        steering_max_deg=float(np.max(table.steering_max_deg)),
        steering_limit_deg=parts[0].steering_limit_deg,
        metres=float(np.sum(table.metres)),
    )


def poses_of(states: np.ndarray) -> np.ndarray:
    """Poses float32 [n, 5] of states [n, ego.FIELDS]: x, y (m), heading (rad), speed (m/s), steering (rad)."""
    heading = np.arctan2(states[:, SIN], states[:, COS])
    return np.stack([states[:, X], states[:, Y], heading, states[:, SPEED], states[:, STEERING]], axis=1)


def driven(poses: np.ndarray, road_map: Map) -> Driven:
    """A drive's path from its poses [n, 5] at the control steps, as `poses_of` gives them.

    Reversing, and the same metres driven again, are left out, because a reference only drives forward. So is standing,
    where steering has no effect: a path from rest begins after the first control step that moves the car.

    Raises: ValueError if the car never moved forward.
    """
    poses = np.asarray(poses, dtype=np.float64)
    if poses.ndim != 2 or poses.shape[1] != 5 or not np.isfinite(poses).all():
        raise ValueError(f"a drive is finite poses [n, 5], not {poses.shape}")
    points = unwrapped(poses[:, :2], float(road_map.road.width), float(road_map.road.height))
    way = np.hypot(*np.diff(points, axis=0).T)
    forward = np.concatenate([[0.0], np.cumsum(np.where(poses[1:, 3] + poses[:-1, 3] < 0.0, -way, way))])
    furthest = np.maximum.accumulate(forward)
    moved = np.append(poses[:1, 3] > 0.0, forward[1:] > furthest[:-1] + _STANDING)
    rows = np.flatnonzero(moved[: len(poses)])
    if len(rows) < 2:
        raise ValueError("nothing was driven that could be compared with a reference")
    points = points[rows]
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    return Driven(arc, points, poses[rows, 2], poses[rows, 3], poses[rows, 4], rows)


def error_series(path: Driven, road_map: Map, sim: SimConfig | None = None) -> Series:
    """A drive beside the reference driver's profile along its path.

    The reference begins with the agent's speed and ignores traffic, so the error in traffic includes the delay by other
    cars. Its curvature is that of the driven path over 10 m: an agent that weaves in longer waves slows the reference
    down too, so look at both errors.

    Left out are the first 5 m, where the curvature is not known, and the end, from where the reference could not have
    stopped any more, because what it would have had to brake for is not known.
    """
    interval = float(road_map.road.speed_low), float(road_map.road.speed_high)
    found = profile(path.points, interval, float(path.speed[0]), sim)
    speed, steering = (np.interp(path.arc, found.arc, each) for each in (found.speed, found.steering))
    unknown = np.flatnonzero(path.arc + speed**2 / (2.0 * BRAKING) > path.arc[-1])
    part = slice(int(np.searchsorted(path.arc, DRIVEN_WINDOW / 2)), int(unknown[0]))
    return Series(path.arc[part], path.speed[part], speed[part], path.steering[part], steering[part])


def error_series_beside(path: Driven, recorded: Driven, road_map: Map, row: int = 0) -> tuple[Series, float]:
    """A drive beside a recorded one, from the recording's point `row`, until it leaves the recorded path.

    Each of the agent's places is compared with the nearest place further along the recording. The drive leaves it when
    it is more than APART beside it or TURNED from it; the last TURN before that is left out, and all after the
    recording's end.
    Returns: (the series, empty if nothing is left; m along the recording that the agent reached).
    """
    sides = np.array([road_map.road.width, road_map.road.height], dtype=np.float64)
    points = path.points - np.round((path.points[0] - recorded.points[row]) / sides) * sides
    steps = np.diff(recorded.points, axis=0)
    k, last = min(row, len(steps) - 1), len(steps) - 1
    at, parted = [], False
    reached = float(recorded.arc[row])
    for point, heading in zip(points, path.heading, strict=True):
        while True:
            length = recorded.arc[k + 1] - recorded.arc[k]
            away = point - recorded.points[k]
            along = float(away @ steps[k]) / length
            if along <= length or k == last:
                break
            k += 1
        if along > length + _STANDING:
            break
        turn = heading - recorded.heading[k + 1]
        if (
            abs(steps[k, 0] * away[1] - steps[k, 1] * away[0]) > APART * length
            or abs((turn + math.pi) % (2.0 * math.pi) - math.pi) > TURNED
        ):
            parted = True
            break
        reached = max(reached, float(recorded.arc[k]) + along)
        at.append(reached)
    count = len(at)
    if parted and count:
        count = int(np.searchsorted(path.arc[:count], path.arc[count - 1] - TURN, side="right"))
    speed, steering = (np.interp(at[:count], recorded.arc, each) for each in (recorded.speed, recorded.steering))
    return Series(path.arc[:count], path.speed[:count], speed, path.steering[:count], steering), reached
