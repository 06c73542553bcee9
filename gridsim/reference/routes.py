"""Routes along lanes, and the reference's speed and steering along any path.

The speed is limited by curvature, and by braking before and accelerating after bends, without traffic. `plan` computes
it along lanes; `profile` along any driven path, so that a driver can be compared with the reference at the same arc
length without another drive.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gridsim.config import SimConfig
from gridsim.maps.map import Map
from gridsim.maps.roads import freeze

PACE = 0.9  # speed on a straight: 0 is the lower end of the scenario's speed interval, 1 the upper
LATERAL = 3.2  # m/s2 in bends, below the grip limit
ACCELERATION = 3.0  # m/s2
BRAKING = 2.5  # m/s2 before bends
LANE_WINDOW = 6.0  # m of a lane over which its curvature is measured
DRIVEN_WINDOW = 10.0  # m of a driven path, whose steering is jerky


class Route(NamedTuple):
    """A sequence of lanes to drive; arrays are read-only."""

    points: np.ndarray  # float32 [n, 2], m, continuous: not wrapped over the torus
    arc: np.ndarray  # float32 [n], m along the route
    speeds: np.ndarray  # float32 [n], m/s, limited by bends and braking for them
    lanes: np.ndarray  # int32 [m]
    offsets: np.ndarray  # int32 [m + 1], where each lane's points begin
    first: int  # the point before the start


class Profile(NamedTuple):
    """The reference's speed and steering along a path, by arc length."""

    arc: np.ndarray  # float64 [n], m along the path
    speed: np.ndarray  # float64 [n], m/s
    steering: np.ndarray  # float64 [n], rad, left positive


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
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def top_speed(interval: tuple[float, float]) -> float:
    """Speed (m/s) of the reference on a straight, from the scenario's interval."""
    low, high = interval
    return low + PACE * (high - low)


def _speeds(arc: np.ndarray, curvature: np.ndarray, interval: tuple[float, float]) -> np.ndarray:
    """Speeds (m/s) along a path: limited by bends, and by braking for what comes after."""
    squared = np.minimum(top_speed(interval) ** 2, LATERAL / np.maximum(np.abs(curvature), 1e-9))
    way = 2.0 * BRAKING * arc
    return np.sqrt(np.minimum.accumulate((squared + way)[::-1])[::-1] - way)


def profile(
    points: np.ndarray, interval: tuple[float, float], start_speed: float = 0.0, sim: SimConfig | None = None
) -> Profile:
    """Speed and steering of the reference along a driven path, without traffic.

    Args: points [n, 2] in m, in order and not wrapped over the torus (`unwrapped`); the scenario's speed interval and
    the speed at the first point, m/s.
    Raises: ValueError for a path of fewer than 2 different points.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
        raise ValueError(f"a path is finite points [n, 2], not {points.shape}")
    kept = np.append(True, np.hypot(*np.diff(points, axis=0).T) > 1e-6)[: len(points)]  # no heading there
    points = points[kept]
    if len(points) < 2:
        raise ValueError("a path needs 2 points or more that are not the same")
    arc = _arc_length(points)
    curvature = curvature_along(points, arc, DRIVEN_WINDOW)
    speed = _speeds(arc, curvature, interval)
    speed[0] = min(speed[0], start_speed)
    way = 2.0 * ACCELERATION * arc
    speed = np.sqrt(np.minimum.accumulate(speed**2 - way) + way)
    vehicle = (sim or SimConfig()).vehicle
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


def plan(road_map: Map, start: np.ndarray, length: float, seed: int) -> Route:
    """A route of `length` m or more from a start float32 [5], with random turns at junctions.

    Any turn is allowed: all loops of lanes are so long that driving them again counts as distance.

    Raises: ValueError on a map without lanes.
    """
    lanes, road = road_map.lanes, road_map.road
    if not len(lanes):
        raise ValueError(f"the reference driver needs lanes; {road_map.name} has none")
    rng = np.random.default_rng(np.random.SeedSequence([seed, 29]))
    lane, along = locate(road_map, start)
    chosen, ahead = [lane], float(lanes.lengths[lane]) - along
    while ahead < length or len(chosen) < 3:
        onward = lanes.successors[chosen[-1]]
        chosen.append(int(rng.choice(onward[onward >= 0])))
        ahead += float(lanes.lengths[chosen[-1]])
    parts = [lanes.lane(i)[:-1] for i in chosen]
    points = unwrapped(np.concatenate([*parts, lanes.lane(chosen[-1])[-1:]]), float(road.width), float(road.height))
    arc = _arc_length(points)
    interval = float(road.speed_low), float(road.speed_high)
    speeds = _speeds(arc, curvature_along(points, arc, LANE_WINDOW), interval)
    offsets = np.concatenate([[0], np.cumsum([len(part) for part in parts])])
    return Route(
        points=freeze(points.astype(np.float32)),
        arc=freeze(arc.astype(np.float32)),
        speeds=freeze(speeds.astype(np.float32)),
        lanes=freeze(np.array(chosen, dtype=np.int32)),
        offsets=freeze(offsets.astype(np.int32)),
        first=int(along / lanes.steps[lane]),
    )
