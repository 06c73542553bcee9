"""Routes along lanes, and the speed and steering of the reference driver along any path.

The speed profile of a path is limited by curvature, and by braking before and accelerating after its bends, without
traffic. `plan` computes it along lanes; `profile` along any driven path, so that a driver can be compared with the
reference at the same arc length without another drive.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gridsim.config import SimConfig
from gridsim.jit import njit
from gridsim.maps.map import Map
from gridsim.maps.roads import freeze


@dataclass(frozen=True)
class ReferenceConfig:
    """How the reference driver drives."""

    pace: float = 0.9  # speed on a straight: 0 is the lower end of the speed interval, 1 the upper
    lateral: float = 3.2  # m/s2 in bends, below the grip limit
    acceleration: float = 3.0  # m/s2 of the profile, and a of IDM
    braking: float = 2.5  # m/s2 before bends, and b of IDM
    headway: float = 1.0  # s, T of IDM
    nearest: float = 2.0  # m to the pursued point, at standstill
    preview: float = 0.25  # s, and the way driven in that time
    bend_share: float = 0.15  # and this share of the tightest radius that grip allows
    window: float = 6.0  # m of a lane over which its curvature is measured
    driven_window: float = 10.0  # m of a driven path, whose steering is jerky


class Route(NamedTuple):
    """A sequence of lanes to drive. Lanes beside them are further rails, from left to right.

    Arrays are read-only; point i of a rail is beside point i of the others.
    """

    points: np.ndarray  # float32 [rails, n, 2], m, continuous: not wrapped over the torus
    arc: np.ndarray  # float32 [rails, n], m along the rail
    speeds: np.ndarray  # float32 [rails, n], m/s, limited by bends and braking for them
    lanes: np.ndarray  # int32 [rails, m]
    offsets: np.ndarray  # int32 [m + 1], where each lane's points begin
    rail: int  # the rail of the start
    first: int  # the point before the start


class Profile(NamedTuple):
    """The reference's speed and steering along a path, by arc length."""

    arc: np.ndarray  # float64 [n], m along the path
    speed: np.ndarray  # float64 [n], m/s
    steering: np.ndarray  # float64 [n], rad, left positive

    def speed_at(self, s: np.ndarray | float) -> np.ndarray:
        """Speed (m/s) of the reference s m along the path."""
        return np.interp(np.asarray(s), self.arc, self.speed)

    def steering_at(self, s: np.ndarray | float) -> np.ndarray:
        """Steering (rad) of the reference s m along the path."""
        return np.interp(np.asarray(s), self.arc, self.steering)


def curvature_along(points: np.ndarray, arc: np.ndarray, window: float) -> np.ndarray:
    """Curvature (1/m) at points [n, 2] of a path, from the chords of `window` / 2 m before and after each.

    Near the path's ends it is that of the nearest point with `window` / 4 m on either side.
    """

    def point(s: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(s, arc, axis) for axis in points.T])

    least = min(window, arc[-1] - arc[0]) / 4
    middle = np.clip(arc, arc[0] + least, arc[-1] - least)
    back, front = np.maximum(middle - window / 2, arc[0]), np.minimum(middle + window / 2, arc[-1])
    (ax, ay), (bx, by) = point(middle) - point(back), point(front) - point(middle)
    return np.arctan2(ax * by - ay * bx, ax * bx + ay * by) / ((front - back) / 2)


def _arc_length(points: np.ndarray) -> np.ndarray:
    step = np.diff(points.astype(np.float64), axis=0)
    return np.concatenate([[0.0], np.cumsum(np.hypot(step[:, 0], step[:, 1]))])


@njit
def _within_braking(arc, braking, speeds):
    for i in range(len(arc) - 2, -1, -1):
        speeds[i] = min(speeds[i], math.sqrt(speeds[i + 1] ** 2 + 2.0 * braking * (arc[i + 1] - arc[i])))


@njit
def _within_acceleration(arc, acceleration, speeds):
    for i in range(1, len(arc)):
        speeds[i] = min(speeds[i], math.sqrt(speeds[i - 1] ** 2 + 2.0 * acceleration * (arc[i] - arc[i - 1])))


def top_speed(interval: tuple[float, float], config: ReferenceConfig) -> float:
    """Speed (m/s) of the reference on a straight, from the scenario's interval."""
    low, high = interval
    return low + config.pace * (high - low)


def profile(
    points: np.ndarray,
    interval: tuple[float, float],
    start_speed: float = 0.0,
    config: ReferenceConfig | None = None,
    sim: SimConfig | None = None,
) -> Profile:
    """Speed and steering of the reference along a driven path, without traffic.

    Args: points [n, 2] in m, in order and not wrapped over the torus (`unwrapped`); the scenario's speed interval and
    the speed at the first point, m/s.
    Raises: ValueError for a path of fewer than 2 different points.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
        raise ValueError(f"a path is finite points [n, 2], not {points.shape}")
    config, sim = config or ReferenceConfig(), sim or SimConfig()
    kept = np.append(True, np.hypot(*np.diff(points, axis=0).T) > 1e-6)[: len(points)]  # no heading there
    points = points[kept]
    if len(points) < 2:
        raise ValueError("a path needs 2 points or more that are not the same")
    arc = _arc_length(points)
    curvature = curvature_along(points, arc, config.driven_window)
    speed = np.minimum(top_speed(interval, config), np.sqrt(config.lateral / np.maximum(np.abs(curvature), 1e-9)))
    _within_braking(arc, config.braking, speed)
    speed[0] = min(speed[0], start_speed)
    _within_acceleration(arc, config.acceleration, speed)
    vehicle = sim.vehicle
    slip = np.arcsin(np.clip(curvature * vehicle.rear_axle, -1.0, 1.0))
    steering = np.arctan(np.tan(slip) * vehicle.wheelbase / vehicle.rear_axle)
    limit = math.radians(vehicle.steering_limit)
    return Profile(arc, speed, np.clip(steering, -limit, limit))


def unwrapped(points: np.ndarray, width: float, height: float) -> np.ndarray:
    """Unwrap a path [n, 2] on a torus with these sides (m), so that it is continuous."""
    points = np.asarray(points, dtype=np.float64)
    step = np.diff(points, axis=0)
    step -= np.round(step / [width, height]) * [width, height]
    return np.concatenate([points[:1], points[0] + np.cumsum(step, axis=0)])


def locate(road_map: Map, start: np.ndarray) -> tuple[int, float]:
    """The lane nearest to a start (x, y, heading, ...) in place and heading, and the start's m along it."""
    lanes = road_map.lanes
    sides = np.array([road_map.road.width, road_map.road.height], dtype=np.float64)
    ahead = np.diff(lanes.points.astype(np.float64), axis=0)
    away = np.asarray(start[:2], dtype=np.float64) - lanes.points[:-1]
    away -= np.round(away / sides) * sides
    length = np.maximum(np.hypot(*ahead.T), 1e-9)
    part = np.clip((away * ahead).sum(axis=1) / length**2, 0.0, 1.0)
    distance = np.hypot(*(away - part[:, None] * ahead).T)
    turn = np.arctan2(ahead[:, 1], ahead[:, 0]) - start[2]
    distance += 5.0 * np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
    distance[lanes.offsets[1:-1] - 1] = np.inf  # from one lane's end to the next lane's beginning
    point = int(distance.argmin())
    lane = int(np.searchsorted(lanes.offsets, point, side="right")) - 1
    return lane, float((point - lanes.offsets[lane] + part[point]) * lanes.steps[lane])


def _abreast(road_map: Map, lane: int) -> list[int]:
    """A lane and its neighbours, from left to right."""
    while road_map.lanes.left[lane] >= 0:
        lane = int(road_map.lanes.left[lane])
    row = [lane]
    while road_map.lanes.right[row[-1]] >= 0:
        row.append(int(road_map.lanes.right[row[-1]]))
    return row


def plan(road_map: Map, start: np.ndarray, length: float, seed: int, config: ReferenceConfig | None = None) -> Route:
    """A route of `length` m or more from a start float32 [5], with random turns at junctions.

    Any turn is allowed: all loops of lanes are so long that driving them again counts as distance.

    Raises: ValueError on a map without lanes.
    """
    config = config or ReferenceConfig()
    lanes = road_map.lanes
    if not len(lanes):
        raise ValueError(f"the reference driver needs lanes; {road_map.name} has none")
    rng = np.random.default_rng(np.random.SeedSequence([seed, 29]))
    lane, along = locate(road_map, start)
    chosen, ahead = [lane], float(lanes.lengths[lane]) - along
    while ahead < length or len(chosen) < 3:
        onward = lanes.successors[chosen[-1]]
        chosen.append(int(rng.choice(onward[onward >= 0])))
        ahead += float(lanes.lengths[chosen[-1]])
    rows = np.array([_abreast(road_map, lane) for lane in chosen], dtype=np.int32).T
    rail = int(np.flatnonzero(rows[:, 0] == lane)[0])
    counts = np.diff(lanes.offsets)[rows[0]] - 1
    sides = np.float64(road_map.road.width), np.float64(road_map.road.height)
    points = np.stack(
        [
            unwrapped(np.concatenate([*(lanes.lane(i)[:-1] for i in row), lanes.lane(row[-1])[-1:]]), *sides)
            for row in rows
        ]
    )
    arc = np.stack([_arc_length(rail_points) for rail_points in points])
    top = top_speed((float(road_map.road.speed_low), float(road_map.road.speed_high)), config)
    speeds = np.empty_like(arc)
    for r in range(len(rows)):
        curvature = np.abs(curvature_along(points[r], arc[r], config.window))
        speeds[r] = np.minimum(top, np.sqrt(config.lateral / np.maximum(curvature, 1e-9)))
        _within_braking(arc[r], config.braking, speeds[r])
    f = np.float32
    return Route(
        freeze(points.astype(f)),
        freeze(arc.astype(f)),
        freeze(speeds.astype(f)),
        freeze(rows),
        freeze(np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)),
        rail,
        int(along / lanes.steps[lane]),
    )
