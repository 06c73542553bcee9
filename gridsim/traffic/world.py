"""Worlds: the state of the other cars around one ego car, and where they are spawned.

A world is float32 [cars, TRAFFIC_FIELDS] with the columns of `gridsim.state`. With a given map and configuration, its
evolution depends only on that array and on the ego car. A car's centre of mass lies on its lane, shifted sideways while
it changes lanes or meets the ego car.
"""

from __future__ import annotations

import math

import numpy as np

from gridsim import state as s
from gridsim.config import DRIVER_SPREAD, LANE_CHANGE_PERIOD, SLOWEST_DRIVER, SPAWN_SPEED, STOP_LINE_GAP, SimConfig
from gridsim.counter import GOLDEN, mix, uniform, uniform64
from gridsim.errors import GridSimError
from gridsim.jit import ONE, ZERO, F, I, U, leaf, njit
from gridsim.maps.network import Network, successor, wrapped


@leaf
def set_pose(network, car):
    """Set a car's pose from LANE, ALONG, SHIFT and SWAY."""
    one, two = U(1), U(2)
    lane = U(I(car[s.LANE]))
    first = U(network.offsets[lane])
    last = U(network.offsets[lane + one]) - first - two
    at = car[s.ALONG] / network.steps[lane]
    k = min(U(max(I(at), I(0))), last)
    part = at - F(I(k))
    x0, y0 = network.points[first + k, 0], network.points[first + k, 1]
    dx, dy = network.points[first + k + one, 0] - x0, network.points[first + k + one, 1] - y0
    # The heading is interpolated between the lane's directions at the points before and after the car, so that the car
    # does not jerk at each point.
    before, after = max(k, one) - one, min(k + two, last + one)
    ax, ay = x0 + dx - network.points[first + before, 0], y0 + dy - network.points[first + before, 1]
    bx, by = network.points[first + after, 0] - x0, network.points[first + after, 1] - y0
    tx, ty = ax + part * (bx - ax), ay + part * (by - ay)
    norm = ONE / math.sqrt(max(tx * tx + ty * ty, F(1e-12)))
    tx, ty = tx * norm, ty * norm
    x, y = x0 + part * dx - car[s.SHIFT] * ty, y0 + part * dy + car[s.SHIFT] * tx
    # NumPy's floor, because that of `math` returns int64, whose product with float32 is float64.
    car[s.X] = x - np.floor(x / network.width) * network.width
    car[s.Y] = y - np.floor(y / network.height) * network.height
    sway = car[s.SWAY]
    if sway != ZERO:
        norm = ONE / math.sqrt(ONE + sway * sway)
        tx, ty = (tx - sway * ty) * norm, (ty + sway * tx) * norm
    car[s.COS], car[s.SIN] = tx, ty


@leaf
def point_at(network, car):
    """Index of the point of its lane that a car has passed last."""
    lane = U(I(car[s.LANE]))
    at = network.offsets[lane] + I(car[s.ALONG] / network.steps[lane])
    return U(min(at, I(network.offsets[lane + U(1)] - 1)))


@leaf
def lane_after(car, lane):
    """The lane that a car takes after `lane`, if that is its LANE or NEXT; else -1: its way is not known further."""
    if lane == I(car[s.LANE]):
        return I(car[s.NEXT])
    return I(car[s.SECOND_NEXT]) if lane == I(car[s.NEXT]) else I(-1)


@leaf
def _draw(car):
    """A car's next random number in [0, 1)."""
    car[s.DRAWS] += ONE
    return uniform(mix(mix(U(car[s.SEED])) + U(car[s.DRAWS]) * GOLDEN))


@leaf
def choose_lane(network, lane, car):
    """A random successor of `lane`."""
    return successor(network, lane, _draw(car))


@njit(nogil=True)
def _spawn(network, mileage, first, start, key, gap, ego_gap, lane_change_steps, world):
    """Spawn the cars of an empty world, at least `gap` m apart and `ego_gap` m from the ego car's `start`.

    A part of each lane is for spawning: it begins `first` [lanes] m along the lane. `mileage` float64 [lanes + 1] is
    the cumulative length (m) of these parts, 0 for lanes in junctions. A car without a place after 60 tries is absent.
    """
    draws = 0
    for i in range(world.shape[0]):
        car = world[i]
        car[s.JUNCTION_BEHIND], car[s.PERMIT] = -ONE, -ONE
        car[s.LANE_TIMER] = F(i) % lane_change_steps  # spreads the decisions over the control steps
        for _ in range(60):
            draws += 1
            bits = mix(key + U(draws) * GOLDEN)
            metres = uniform64(bits) * mileage[-1]
            lane = np.searchsorted(mileage, metres, side="right") - 1
            lane = min(lane, len(mileage) - 2)
            car[s.LANE], car[s.ALONG] = F(lane), F(first[lane] + metres - mileage[lane])
            set_pose(network, car)
            dx, dy = car[s.X] - start[0], car[s.Y] - start[1]
            dx, dy = wrapped(dx, network.width), wrapped(dy, network.height)
            free = dx * dx + dy * dy >= ego_gap * ego_gap
            for j in range(i):
                if world[j, s.LANE] >= ZERO:
                    dx, dy = world[j, s.X] - car[s.X], world[j, s.Y] - car[s.Y]
                    dx, dy = wrapped(dx, network.width), wrapped(dy, network.height)
                    free &= dx * dx + dy * dy >= gap * gap
            if free:
                car[s.SEED] = F(mix(bits) >> U(40))
                car[s.SPEED_FACTOR] = SLOWEST_DRIVER + DRIVER_SPREAD * uniform(mix(bits + GOLDEN))
                car[s.NEXT] = F(choose_lane(network, lane, car))
                car[s.SECOND_NEXT] = F(choose_lane(network, I(car[s.NEXT]), car))
                car[s.SPEED] = SPAWN_SPEED * car[s.SPEED_FACTOR] * network.speeds[point_at(network, car)]
                break
            car[s.LANE] = -ONE


def lane_change_steps(config: SimConfig) -> int:
    """Control steps between a car's decisions whether to change lanes."""
    return max(round(LANE_CHANGE_PERIOD / config.episode.control_period), 1)


def check_traffic(cars: int, config: SimConfig) -> None:
    """Raises: GridSimError if there are other cars, but cars are too small for the lengths that traffic assumes."""
    if cars and config.unit < 1.0:
        raise GridSimError(f"traffic is for cars of 2.83 m or more, not of {config.vehicle.length:g} m: use traffic 0")


def empty_worlds(episodes: int, cars: int) -> np.ndarray:
    """Worlds float32 [episodes, cars, TRAFFIC_FIELDS] in which all cars are absent (LANE is -1)."""
    worlds = np.zeros((episodes, cars, s.TRAFFIC_FIELDS), dtype=np.float32)
    worlds[:, :, s.LANE] = -1.0
    return worlds


def spawn(network: Network, starts: np.ndarray, cars: int, keys: np.ndarray, config: SimConfig) -> np.ndarray:
    """Worlds float32 [n, cars, TRAFFIC_FIELDS] around ego cars at `starts` [n, 5], from keys uint64 [n].

    Cars are uniform over the lanes outside junctions. A car for which there is no room is absent, as are all on a map
    without lanes.
    """
    check_traffic(cars, config)
    worlds, traffic = empty_worlds(len(starts), cars), config.traffic
    if cars and len(network.offsets) > 1:
        half = config.vehicle.length / 2
        lengths = (np.diff(network.offsets) - 1) * network.steps.astype(np.float64)
        junction = np.diff(network.crossing_offsets) > 0
        behind = np.isin(np.arange(len(lengths)), network.successors[junction])  # preceded by a junction
        before = junction[network.successors[:, 0]]
        first = np.where(behind, half, 0.0)
        last = lengths - np.where(before, half + float(STOP_LINE_GAP), 0.0)
        mileage = np.concatenate([[0.0], np.cumsum(np.where(junction, 0.0, np.maximum(last - first, 0.0)))])
        gaps = F(traffic.spawn_gap), F(traffic.spawn_gap_ego), F(lane_change_steps(config))
        for world, start, key in zip(worlds, np.asarray(starts, dtype=np.float32), keys, strict=True):
            _spawn(network, mileage, first, start, U(key), *gaps, world)
    return worlds
