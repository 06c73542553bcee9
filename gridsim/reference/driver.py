"""The reference driver: pure pursuit along a route of lanes, as fast as bends and traffic allow.

It does not learn: it reads the map and the other cars' state. Like any driver it takes one of the eight actions each
control period. Steering is pure pursuit (Coulter 1992) of the centre of mass with slip. Speed is a profile limited by
curvature, behind other cars by IDM (Treiber et al. 2000). Lane changes are MOBIL (Kesting et al. 2007). It wants
continuous steering, the actions are discrete: the difference in heading is carried over to later actions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gridsim.car.ego import COS, FIELDS, IDLE, SIN, SPEED, STEERING, STEPS, End, X, Y, control, place
from gridsim.car.vehicle import act, path_curvature
from gridsim.config import LANE_CHANGE_PERIOD, Constants, SimConfig, constants
from gridsim.jit import leaf, njit
from gridsim.maps.map import Map
from gridsim.maps.network import lane_length, wrapped, wrapped_any
from gridsim.maps.roads import VISIT_CELL, freeze
from gridsim.reference.routes import ReferenceConfig, Route, plan
from gridsim.traffic.behaviour import Drivers, change_lanes, drivers, flow, horizon, idm, update_gap
from gridsim.traffic.world import (
    ACCELERATION,
    ALONG,
    GAP,
    HORIZON,
    JUNCTION_BEHIND,
    LANE,
    LANE_TIMER,
    LEAD_SPEED,
    NEXT,
    PERMIT,
    SECOND_NEXT,
    SHIFT,
    SPEED_FACTOR,
)

_F, _I = np.float32, np.int32
_ZERO, _HALF, _ONE, _TWO = _F(0.0), _F(0.5), _F(1.0), _F(2.0)

# Fields of the driver's memory during a drive, float64.
POINT = 0  # index of the route's point behind the car
HEADING_OWED = 1  # rad, wanted change of heading less that of its actions so far
RAIL = 2  # its rail: which of the lanes side by side it is on
RAIL_OFFSET = 3  # m to the left of its rail at which it aims, while it changes lanes
OLD_RAIL = 4  # the rail it comes from
MEMORY_FIELDS = 5

_CAUTION = 0.3  # m, on every side of a waiting car
_STOP_BEFORE = _F(2.5)  # m before a conflict at which it waits
_CREEP = _F(2.0)  # m of these that it may creep forward while it waits
_CREEP_AFTER = _F(8.0)  # idle control steps after which it creeps forward, so that the episode does not end
_GO_FIRST_TIME = _F(1.0)  # s by which it must reach a conflict earlier than another car to go first
_LIKELY_SPEED = _F(4.0)  # m/s to which a slower car may soon accelerate
_WAITING_SPEED = _F(0.2)  # m/s below which another car is considered waiting
_FIRM_BRAKING = _F(5.0)  # m/s2 with which it can stop if the other car does not clear the conflict
_CROSSING_MARGIN = _F(2.5)  # m of extra gap to a car that crosses its way or is oncoming


class Conflicts(NamedTuple):
    """Where the paths of two lanes conflict, for each of `Network.crossings`: float32 [c]."""

    enter: np.ndarray  # m along the lane to where its car blocks the other lane
    meet: np.ndarray  # m along the other lane to where its car blocks this lane
    free: np.ndarray  # m along the other lane beyond which its car no longer conflicts: it has left, or drives ahead


class Tuning(NamedTuple):
    """`ReferenceConfig` as kernels read it."""

    nearest: np.float32  # m
    preview: np.float32  # s
    bend_share: np.float32


@dataclass(frozen=True)
class ReferenceDrive:
    """An episode of the reference driver: its states before each of n control steps, and how it ended.

    Attributes:
        time: float64 [n], s.
        pose: float32 [n, 3]: x, y (m), heading (rad).
        speed: float32 [n], m/s.
        steering: float32 [n], rad.
        action: int64 [n].
        arc: float64 [n], m along the route.
        rail: int64 [n], its rail of the route.
        car: float32 [ego.FIELDS], the state at the end.
        end: how it ended.
        route: its route.
    """

    time: np.ndarray
    pose: np.ndarray
    speed: np.ndarray
    steering: np.ndarray
    action: np.ndarray
    arc: np.ndarray
    rail: np.ndarray
    car: np.ndarray
    end: End
    route: Route


@njit
def _find_conflicts(network, half_length, half_width, enter, free):
    for lane in range(len(network.steps)):
        first, last = network.offsets[lane], network.offsets[lane + 1] - 1
        for c in range(network.crossing_offsets[lane], network.crossing_offsets[lane + 1]):
            other = network.crossings[c]
            found = False
            p = first
            while p <= last and not found:
                a, b = max(p - 1, first), min(p + 1, last)
                ux, uy = network.points[b, 0] - network.points[a, 0], network.points[b, 1] - network.points[a, 1]
                length = math.hypot(ux, uy)
                ux, uy = ux / length, uy / length
                for q in range(network.offsets[other], network.offsets[other + 1] - 1):
                    dx = wrapped_any(network.points[q, 0] - network.points[p, 0], network.width)
                    dy = wrapped_any(network.points[q, 1] - network.points[p, 1], network.height)
                    if abs(dx * ux + dy * uy) < half_length and abs(dy * ux - dx * uy) < half_width:
                        vx = network.points[q + 1, 0] - network.points[q, 0]
                        vy = network.points[q + 1, 1] - network.points[q, 1]
                        if ux * vx + uy * vy > 0.5 * network.steps[other]:
                            # The lanes merge: a car on the common part is followed.
                            gone = _F(q - network.offsets[other]) * network.steps[other] + half_length
                            free[c] = min(free[c], gone)
                        found = True
                        break
                p += 1
            enter[c] = _F(p - 1 - first) * network.steps[lane]


@njit
def _find_meetings(network, enter, meet):
    for lane in range(len(network.steps)):
        for c in range(network.crossing_offsets[lane], network.crossing_offsets[lane + 1]):
            other = network.crossings[c]
            for back in range(network.crossing_offsets[other], network.crossing_offsets[other + 1]):
                if network.crossings[back] == lane:
                    meet[c] = enter[back]


def conflicts(road_map: Map, sim: SimConfig) -> Conflicts:
    """Where the lanes of a map conflict."""
    network, vehicle = road_map.network, sim.vehicle
    enter, meet = np.zeros_like(network.clear), np.zeros_like(network.clear)
    free = network.clear.copy()
    # A waiting car leaves the others half their width, and a margin.
    half_length = np.float32((vehicle.length + vehicle.width) / 2 + _CAUTION)
    _find_conflicts(network, half_length, np.float32(vehicle.width + _CAUTION), enter, free)
    _find_meetings(network, enter, meet)
    return Conflicts(freeze(enter), freeze(meet), freeze(free))


@leaf
def _at(route, rail, s, k):
    """The place s m along a rail, searched from point k on: (x m, y m, point before it, share to the next)."""
    last = _I(route.arc.shape[1] - 2)
    while k < last and route.arc[rail, k + 1] < s:
        k += _I(1)
    span = max(route.arc[rail, k + 1] - route.arc[rail, k], _F(1e-6))
    part = (s - route.arc[rail, k]) / span
    x0, y0 = route.points[rail, k, 0], route.points[rail, k, 1]
    return (
        x0 + part * (route.points[rail, k + 1, 0] - x0),
        y0 + part * (route.points[rail, k + 1, 1] - y0),
        k,
        part,
    )


@leaf
def _progress(network, route, rail, k, x, y):
    """A car's place on a rail, searched from point k on: (point behind it, m along, m to the left)."""
    last = _I(route.arc.shape[1] - 2)
    while True:
        ux = route.points[rail, k + 1, 0] - route.points[rail, k, 0]
        uy = route.points[rail, k + 1, 1] - route.points[rail, k, 1]
        length = max(math.sqrt(ux * ux + uy * uy), _F(1e-6))
        dx = wrapped_any(x - route.points[rail, k, 0], network.width)
        dy = wrapped_any(y - route.points[rail, k, 1], network.height)
        along = (dx * ux + dy * uy) / length
        if along <= length or k >= last:
            return k, route.arc[rail, k] + along, (dy * ux - dx * uy) / length
        k += _I(1)


@leaf
def _wanted_curvature(network, constants, tuning, route, rail, k, s, blend, car):
    """Curvature (1/m) of the circle on which the centre of mass, with slip, reaches the route's point ahead.

    With a the angle from the heading to the point and d its distance, tan(slip) = sin(a) / (d / (2 l_r) + cos(a)).
    """
    speed = max(car[SPEED], _ZERO)
    ahead = tuning.nearest + speed * (tuning.preview + tuning.bend_share * speed / constants.grip)
    x, y, k, _ = _at(route, rail, s + ahead, k)
    ux = route.points[rail, k + 1, 0] - route.points[rail, k, 0]
    uy = route.points[rail, k + 1, 1] - route.points[rail, k, 1]
    norm = blend / max(math.sqrt(ux * ux + uy * uy), _F(1e-6))
    dx = wrapped_any(x - norm * uy - car[X], network.width)
    dy = wrapped_any(y + norm * ux - car[Y], network.height)
    forward, left = dx * car[COS] + dy * car[SIN], dy * car[COS] - dx * car[SIN]
    distance = max(math.sqrt(forward * forward + left * left), _F(0.1))
    tangent = (left / distance) / max(distance / (_TWO * constants.rear_axle) + forward / distance, _F(0.1))
    curvature = tangent / (math.sqrt(_ONE + tangent * tangent) * constants.rear_axle)
    bound = constants.grip / max(car[SPEED] * car[SPEED], _F(1e-6))
    return min(max(curvature, -bound), bound)


@leaf
def _choose_action(constants, car, curvature, acceleration, owed):
    """The action whose effect is nearest to a wanted curvature (1/m) and acceleration (m/s2).

    The heading is compared over two periods, since the wheels turn by fixed steps.
    Returns: (action, rad of HEADING_OWED after it).
    """
    speed, steering = max(car[SPEED], _ZERO), car[STEERING]
    way = max(speed, _ONE) * constants.dt
    quantum = path_curvature(constants, speed, constants.steering_step) * way
    # Steering beyond the grip limit gains nothing, and has to be undone step by step.
    tangent = constants.grip * constants.rear_axle / max(speed * speed, _ONE)
    furthest = max(math.atan(tangent / constants.rear_share), constants.steering_step)
    weight = _ONE if acceleration > _F(-4.0) else _F(0.2)  # hard braking has priority over steering
    best, cost, left = _I(4), _F(1e9), _ZERO
    for action in range(8):
        if action == 7 and speed < _HALF:
            continue
        given, wheels = act(constants, action, speed, steering)
        first = owed + (curvature - path_curvature(constants, speed, wheels)) * way
        second = _F(1e9)
        for then in range(1, 5):
            _, later = act(constants, then, speed, wheels)
            second = min(second, abs(first + (curvature - path_curvature(constants, speed, later)) * way))
        total = weight * (abs(first) + second) / quantum + abs(acceleration - given) / constants.acceleration
        total += _HALF * max(abs(wheels) - furthest, _ZERO) / constants.steering_step
        if total < cost:
            best, cost, left = _I(action), total, first
    return best, min(max(left, -quantum), quantum)


@leaf
def _as_traffic_car(network, route, rail, m, s, car, me):
    """Fill `me` with the ego car as a traffic car on lane m of a rail, s m along the rail."""
    last = _I(route.lanes.shape[1] - 1)
    me[X], me[Y], me[COS], me[SIN], me[SPEED] = car[X], car[Y], car[COS], car[SIN], max(car[SPEED], _ZERO)
    me[JUNCTION_BEHIND], me[PERMIT] = -_ONE, -_ONE
    me[LANE] = route.lanes[rail, m]
    me[NEXT] = route.lanes[rail, min(m + _I(1), last)]
    me[SECOND_NEXT] = route.lanes[rail, min(m + _I(2), last)]
    length = lane_length(network, _I(me[LANE]))
    me[ALONG] = min(max(s - route.arc[rail, route.offsets[m]], _ZERO), length)


@leaf
def _give_way(network, conflicts, drivers, me, world):
    """Yield to cars in or entering a junction: (largest allowed acceleration m/s2, m to the nearest conflict)."""
    speed, allowed, least = me[SPEED], drivers.acceleration, _F(1e9)
    ahead = -me[ALONG]  # way (m) to the beginning of the lane
    for turn in range(3):
        lane = _I(me[LANE] if turn == 0 else (me[NEXT] if turn == 1 else me[SECOND_NEXT]))
        if ahead > me[HORIZON]:
            break
        for c in range(network.crossing_offsets[lane], network.crossing_offsets[lane + 1]):
            way = ahead + conflicts.enter[c] - _STOP_BEFORE
            if way < -_CREEP or way > me[HORIZON]:
                continue  # already in the conflict: drive on
            other = network.crossings[c]
            for j in range(world.shape[0]):
                if world[j, LANE] < _ZERO:
                    continue
                if _I(world[j, LANE]) == other:
                    at = world[j, ALONG]
                elif _I(world[j, PERMIT]) == other:
                    at = world[j, ALONG] - lane_length(network, _I(world[j, LANE]))
                elif _I(world[j, JUNCTION_BEHIND]) == other:
                    at = world[j, ALONG] + lane_length(network, other)
                else:
                    continue
                rest = conflicts.free[c] + drivers.half_length + _HALF - at
                if rest <= _ZERO:
                    continue
                time = rest / max(world[j, SPEED], _HALF)
                stops = speed * speed < _TWO * _FIRM_BRAKING * way  # it can still stop if the other car does
                if stops and speed * (time + _HALF) < way:
                    continue  # the other car will have left
                if world[j, SPEED] < _WAITING_SPEED and speed < _ONE:
                    continue  # the other car waits, perhaps for the ego car
                before = (conflicts.meet[c] - at) / max(world[j, SPEED], _LIKELY_SPEED)
                if way / max(speed, _ONE) + _GO_FIRST_TIME < before:
                    continue  # the other car comes later, and brakes for the ego car
                if way < _ZERO or not stops:
                    slower = -drivers.braking
                else:
                    slower = max(_TWO * (way - speed * time) / (time * time), -speed * speed / (_TWO * way))
                allowed, least = min(allowed, slower), min(least, way)
        ahead += lane_length(network, lane)
    return allowed, least


@leaf
def _adapt_to_traffic(network, conflicts, drivers, route, memory, k, s, car, bend, acceleration, world, others):
    """Limit a wanted acceleration (m/s2) by the other cars, and change lanes if that gains time."""
    n = _I(world.shape[0])
    me, nobody = others[n], others[n + 1]
    rail, speed = _I(memory[RAIL]), max(car[SPEED], _ZERO)
    m = _I(np.searchsorted(route.offsets, k, side="right") - 1)
    m = min(m, _I(route.lanes.shape[1] - 1))
    for j in range(n):
        for field in range(world.shape[1]):
            others[j, field] = world[j, field]
    me[HORIZON] = horizon(drivers, speed)
    me[GAP], me[LEAD_SPEED], me[SHIFT] = _F(1e9), _ZERO, _F(memory[RAIL_OFFSET])
    touch = _F(1e9)  # way (m) to where another car blocks the path
    for side in range(2):
        if side == 0 and memory[RAIL_OFFSET] == 0.0:
            continue  # the old lane matters only during a change of lanes
        on = rail if side == 1 else _I(memory[OLD_RAIL])
        _as_traffic_car(network, route, on, m, s, car, me)
        for j in range(n):
            if world[j, LANE] >= _ZERO:
                dx, dy = wrapped(world[j, X] - car[X], network.width), wrapped(world[j, Y] - car[Y], network.height)
                if math.sqrt(dx * dx + dy * dy) - _F(5.0) < me[HORIZON]:
                    before = me[GAP]
                    update_gap(network, drivers, me, world[j], False)
                    along = me[COS] * world[j, COS] + me[SIN] * world[j, SIN]
                    if me[GAP] < before:
                        touch = min(touch, me[GAP])
                        if along < _F(0.7):
                            me[GAP] = max(me[GAP] - _CROSSING_MARGIN, drivers.half_length)
    wish = max(bend, _ONE)
    if me[GAP] < _F(1e8):
        acceleration = min(acceleration, idm(drivers, speed, wish, me[GAP] - drivers.half_length, me[LEAD_SPEED]))
    allowed, way = _give_way(network, conflicts, drivers, me, world)
    acceleration = min(acceleration, allowed)
    if car[IDLE] >= _CREEP_AFTER and way > -_CREEP and touch > drivers.half_length + _F(0.1):
        acceleration = drivers.acceleration  # else the episode would end as idle
    if route.lanes.shape[0] > 1:
        lane = _I(me[LANE])
        at = network.offsets[lane] + _I(me[ALONG] / network.steps[lane])
        me[SPEED_FACTOR] = wish / network.speeds[at]
        me[ACCELERATION] = idm(drivers, speed, wish, me[GAP] - drivers.half_length, me[LEAD_SPEED])
        me[LANE_TIMER] = _F(_I(car[STEPS]) % _I(LANE_CHANGE_PERIOD))
        change_lanes(network, drivers, others, n, nobody)
        if _I(me[LANE]) != lane:
            memory[OLD_RAIL] = rail
            memory[RAIL] = rail + 1 if _I(me[LANE]) == network.right[lane] else rail - 1
            memory[RAIL_OFFSET] = me[SHIFT]
    return acceleration


@njit(_nrt=False)
def _decide(network, conflicts, constants, drivers, tuning, route, memory, car, world, others):
    """The driver's action for one control period.

    Args: memory float64 [MEMORY_FIELDS], changed; others [cars + 2, world.FIELDS], scratch whose last row is 0.
    """
    rail = _I(memory[RAIL])
    speed = max(car[SPEED], _ZERO)
    k, s, _ = _progress(network, route, rail, _I(memory[POINT]), car[X], car[Y])
    memory[POINT] = k
    _, _, to, part = _at(route, rail, s + speed * constants.dt, k)
    bend = route.speeds[rail, to] + part * (route.speeds[rail, to + 1] - route.speeds[rail, to])
    acceleration = min(max((bend - speed) / constants.dt, -constants.braking), constants.acceleration)
    if world.shape[0] > 0:
        acceleration = _adapt_to_traffic(
            network, conflicts, drivers, route, memory, k, s, car, bend, acceleration, world, others
        )  # fmt: skip
    rail, blend = _I(memory[RAIL]), _F(memory[RAIL_OFFSET])
    curvature = _wanted_curvature(network, constants, tuning, route, rail, k, s, blend, car)
    way = drivers.shift * constants.dt
    memory[RAIL_OFFSET] = blend - min(max(blend, -way), way)
    action, memory[HEADING_OWED] = _choose_action(constants, car, curvature, acceleration, _F(memory[HEADING_OWED]))
    return action


@njit(nogil=True)
def _drive(
    road, network, conflicts, constants, traffic_drivers, drivers, tuning, route, start, target, max_steps, world, log
):
    """One episode; fills log float64 [max_steps, 8] and returns (state at the end, steps, End)."""
    cells = int(road.width) // VISIT_CELL * (int(road.height) // VISIT_CELL)
    car, visits = np.empty(FIELDS, dtype=np.float32), np.empty(cells, dtype=np.float32)
    others = np.zeros((world.shape[0] + 2, world.shape[1]), dtype=np.float32)
    memory = np.zeros(MEMORY_FIELDS)
    memory[RAIL], memory[POINT] = route.rail, route.first
    place(road, start, car, visits)
    steps, end = 0, 0
    while end == 0:
        action = _decide(network, conflicts, constants, drivers, tuning, route, memory, car, world, others)
        row = log[steps]
        row[0], row[1], row[2], row[3] = car[X], car[Y], math.atan2(car[SIN], car[COS]), car[SPEED]
        row[4], row[5], row[7] = car[STEERING], action, memory[RAIL]
        _, row[6], _ = _progress(network, route, _I(memory[RAIL]), _I(memory[POINT]), car[X], car[Y])
        flow(network, traffic_drivers, world, car)
        acceleration, steering = act(constants, action, car[SPEED], car[STEERING])
        car[STEERING] = steering
        end = control(road, constants, car, visits, world, acceleration, target, max_steps)
        steps += 1
    return car, steps, end


class ReferenceDriver:
    """Drives a batch of cars, each on its own route: `reset`, then `act` once each control period."""

    def __init__(self, road_maps: Sequence[Map], sim: SimConfig | None = None, config: ReferenceConfig | None = None):
        self.road_maps = road_maps
        self.sim, self.config = sim or SimConfig(), config or ReferenceConfig()
        self._constants: Constants = constants(self.sim)
        self._traffic: Drivers = drivers(self.sim)
        f = np.float32
        self._drivers = self._traffic._replace(
            acceleration=f(self.config.acceleration), comfort=f(self.config.braking), headway=f(self.config.headway)
        )
        self._tuning = Tuning(f(self.config.nearest), f(self.config.preview), f(self.config.bend_share))
        self._conflicts: dict[int, Conflicts] = {}
        self._maps = np.zeros(0, dtype=np.int64)
        self._routes: list[Route] = []
        self._memory = np.zeros((0, MEMORY_FIELDS))

    def reset(
        self, starts: np.ndarray, maps: np.ndarray | int, seeds: Sequence[int], length: float | None = None
    ) -> None:
        """Begin drives at starts float32 [n, 5] on `road_maps[maps[k]]`, with turns at junctions from seeds [n].

        Routes are `length` m long, by default 1.1 times the target.
        """
        length = 1.1 * self.sim.episode.target if length is None else length
        self._maps = np.broadcast_to(np.asarray(maps, dtype=np.int64), len(starts))
        self._conflicts = {m: conflicts(self.road_maps[m], self.sim) for m in np.unique(self._maps).tolist()}
        self._routes = [
            plan(self.road_maps[m], start, length, seed, self.config)
            for m, start, seed in zip(self._maps.tolist(), starts, seeds, strict=True)
        ]
        self._memory = np.zeros((len(starts), MEMORY_FIELDS))
        self._memory[:, RAIL] = [route.rail for route in self._routes]
        self._memory[:, POINT] = [route.first for route in self._routes]

    def act(self, cars: np.ndarray, worlds: np.ndarray) -> np.ndarray:
        """Actions int64 [n] for cars float32 [n, ego.FIELDS] in worlds [n, cars, world.FIELDS]."""
        others = np.zeros((worlds.shape[1] + 2, worlds.shape[2]), dtype=np.float32)
        return np.array(
            [
                _decide(
                    self.road_maps[m].network, self._conflicts[m], self._constants, self._drivers, self._tuning,
                    route, memory, car, world, others,
                )
                for m, route, memory, car, world in zip(
                    self._maps.tolist(), self._routes, self._memory, cars, worlds, strict=True
                )
            ],
            dtype=np.int64,
        )  # fmt: skip

    def drive(
        self,
        road_map: Map,
        start: np.ndarray,
        world: np.ndarray,
        seed: int,
        target: float | None = None,
        max_steps: int | None = None,
    ) -> ReferenceDrive:
        """A whole episode from a start float32 [5] in the traffic float32 [cars, world.FIELDS] around it.

        It ends as in `envs.simulator`. The defaults of `target` (m) and `max_steps` are the configuration's.
        """
        episode = self.sim.episode
        target = episode.target if target is None else target
        max_steps = round(episode.time_limit / episode.control_period) if max_steps is None else max_steps
        found = conflicts(road_map, self.sim)
        route = plan(road_map, start, 1.1 * target, seed, self.config)
        log = np.empty((max_steps, 8))
        car, steps, end = _drive(
            road_map.road, road_map.network, found, self._constants, self._traffic,
            self._drivers, self._tuning, route,
            np.asarray(start, dtype=np.float32), np.float32(target), max_steps,
            np.array(world, dtype=np.float32), log,
        )  # fmt: skip
        log = log[:steps]
        return ReferenceDrive(
            time=np.arange(steps) * episode.control_period,
            pose=log[:, :3].astype(np.float32),
            speed=log[:, 3].astype(np.float32),
            steering=log[:, 4].astype(np.float32),
            action=log[:, 5].astype(np.int64),
            arc=log[:, 6],
            rail=log[:, 7].astype(np.int64),
            car=car,
            end=End(end),
            route=route,
        )
