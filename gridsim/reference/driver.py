"""The reference driver: pure pursuit along a route of lanes, as fast as bends and traffic allow.

It does not learn: it reads the map and the other cars' state. Like any driver it takes one of the eight actions each
control period. Steering is pure pursuit (Coulter 1992) of the centre of mass with slip. Speed is that of the route; in
traffic it is that of a traffic car at the same place: IDM, and no entry into a junction that is not clear.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gridsim.car.ego import COS, FIELDS, IDLE, SIN, SPEED, STEERING, End, X, Y, place
from gridsim.car.vehicle import act, path_curvature
from gridsim.config import STOP_LINE_GAP, SimConfig, constants
from gridsim.envs.simulator import step_car
from gridsim.jit import leaf, njit
from gridsim.maps.map import Map
from gridsim.maps.network import is_junction, lane_length, wrapped_any
from gridsim.maps.roads import VISIT_CELL
from gridsim.reference.routes import ACCELERATION, BRAKING, Route, plan
from gridsim.traffic.behaviour import drivers, horizon, idm, update_gap
from gridsim.traffic.junctions import may_enter
from gridsim.traffic.world import ALONG, GAP, HORIZON, JUNCTION_BEHIND, LANE, LEAD_SPEED, NEXT, PERMIT, SECOND_NEXT

_F, _I = np.float32, np.int32
_ZERO, _HALF, _ONE, _TWO = _F(0.0), _F(0.5), _F(1.0), _F(2.0)

_NEAREST = _F(2.0)  # m to the pursued point, at standstill ...
_PREVIEW = _F(0.25)  # s, and the way driven in that time ...
_BEND_SHARE = _F(0.15)  # and this share of the tightest radius that grip allows
_HEADWAY = 1.0  # s, T of IDM
_FIRM_BRAKING = _F(5.0)  # m/s2; nearer to a junction than it needs to stop like that, it drives on
_CREEP_AFTER = _F(8.0)  # idle control steps after which it creeps forward, so that the episode does not end
_CREEP = _F(1.5)  # m beyond a junction's line up to which it does


@dataclass(frozen=True)
class ReferenceDrive:
    """An episode of the reference driver.

    Attributes:
        poses: float32 [n, 5]: x, y (m), heading (rad), speed (m/s), steering (rad) before each of n control steps.
        arc: float32 [n], m along the route.
        actions: int64 [n].
        car: float32 [ego.FIELDS], the state at the end.
        end: how it ended.
        route: its route.
    """

    poses: np.ndarray
    arc: np.ndarray
    actions: np.ndarray
    car: np.ndarray
    end: End
    route: Route


@leaf
def _at(route, s, k):
    """The place s m along a route, searched from point k on: (x m, y m, speed m/s)."""
    last = _I(route.arc.shape[0] - 2)
    while k < last and route.arc[k + 1] < s:
        k += _I(1)
    part = (s - route.arc[k]) / max(route.arc[k + 1] - route.arc[k], _F(1e-6))
    x, y, speed = route.points[k, 0], route.points[k, 1], route.speeds[k]
    return (
        x + part * (route.points[k + 1, 0] - x),
        y + part * (route.points[k + 1, 1] - y),
        speed + part * (route.speeds[k + 1] - speed),
    )


@leaf
def _progress(network, route, k, x, y):
    """A car's place on a route, searched from point k on: (point behind it, m along)."""
    last = _I(route.arc.shape[0] - 2)
    while True:
        ux, uy = route.points[k + 1, 0] - route.points[k, 0], route.points[k + 1, 1] - route.points[k, 1]
        length = max(math.sqrt(ux * ux + uy * uy), _F(1e-6))
        dx = wrapped_any(x - route.points[k, 0], network.width)
        dy = wrapped_any(y - route.points[k, 1], network.height)
        along = (dx * ux + dy * uy) / length
        if along <= length or k >= last:
            return k, route.arc[k] + along
        k += _I(1)


@leaf
def _wanted_curvature(network, constants, route, k, s, car):
    """Curvature (1/m) of the circle on which the centre of mass, with slip, reaches the route's point ahead.

    With a the angle from the heading to the point and d its distance, tan(slip) = sin(a) / (d / (2 l_r) + cos(a)).
    """
    speed = max(car[SPEED], _ZERO)
    ahead = _NEAREST + speed * (_PREVIEW + _BEND_SHARE * speed / constants.grip)
    x, y, _ = _at(route, s + ahead, k)
    dx, dy = wrapped_any(x - car[X], network.width), wrapped_any(y - car[Y], network.height)
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
    Returns: (action, rad by which the heading will still differ from the wanted one).
    """
    speed, steering = max(car[SPEED], _ZERO), car[STEERING]
    way = max(speed, _ONE) * constants.dt
    quantum = path_curvature(constants, speed, constants.steering_step) * way
    # Steering beyond the grip limit gains nothing, and has to be undone step by step.
    tangent = constants.grip * constants.rear_axle / max(speed * speed, _ONE)
    furthest = max(math.atan(tangent / constants.rear_share), constants.steering_step)
    weight = _ONE if acceleration > _F(-4.0) else _F(0.2)  # hard braking has priority over steering
    best, cost, left = _I(4), _F(1e9), _ZERO
    for action in range(7):
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
def _among_others(network, drivers, route, k, s, car, wish, world, others):
    """Acceleration (m/s2) of a traffic car in the ego car's place, whose desired speed is `wish` m/s.

    others [cars + 2, world.FIELDS] is scratch whose last row is 0.
    """
    n = world.shape[0]
    for j in range(n):
        for field in range(world.shape[1]):
            others[j, field] = world[j, field]
    me, speed = others[n], max(car[SPEED], _ZERO)
    m = min(np.searchsorted(route.offsets, k, side="right"), route.lanes.shape[0]) - 1
    last = route.lanes.shape[0] - 1
    lane, onward = _I(route.lanes[m]), _I(route.lanes[min(m + 1, last)])
    length = lane_length(network, lane)
    along = min(max(s - route.arc[route.offsets[m]], _ZERO), length)
    me[X], me[Y], me[COS], me[SIN], me[SPEED] = car[X], car[Y], car[COS], car[SIN], speed
    me[LANE], me[ALONG], me[NEXT], me[SECOND_NEXT] = lane, along, onward, route.lanes[min(m + 2, last)]
    me[JUNCTION_BEHIND], me[PERMIT] = -_ONE, -_ONE
    me[HORIZON], me[GAP], me[LEAD_SPEED] = horizon(drivers, speed), _F(1e9), _ZERO
    for j in range(n):
        if world[j, LANE] >= _ZERO:
            update_gap(network, drivers, me, world[j], False)
    acceleration = idm(drivers, speed, wish, me[GAP] - drivers.half_length, me[LEAD_SPEED])
    line = length - along - drivers.half_length
    stops = line < me[HORIZON] and speed * speed < _TWO * _FIRM_BRAKING * (line + _CREEP)
    if stops and is_junction(network, onward) and not may_enter(network, drivers, others[: n + 1], n, others[n + 1]):
        acceleration = min(acceleration, idm(drivers, speed, wish, line + drivers.jam - STOP_LINE_GAP, _ZERO))
    if car[IDLE] >= _CREEP_AFTER and me[GAP] > drivers.half_length + _HALF:
        acceleration = drivers.acceleration
    return acceleration


@njit(nogil=True)
def _drive(road, network, constants, traffic, drivers, route, start, target, max_steps, world, poses, arc, actions):
    """One episode; fills poses, arc and actions [max_steps, ...] and returns (state at the end, steps, End)."""
    cells = int(road.width) // VISIT_CELL * (int(road.height) // VISIT_CELL)
    car, visits = np.empty(FIELDS, dtype=np.float32), np.empty(cells, dtype=np.float32)
    others = np.zeros((world.shape[0] + 2, world.shape[1]), dtype=np.float32)
    place(road, start, car, visits)
    k, owed = _I(route.first), _ZERO
    steps, end = 0, 0
    while end == 0:
        speed = max(car[SPEED], _ZERO)
        k, s = _progress(network, route, k, car[X], car[Y])
        _, _, wish = _at(route, s + speed * constants.dt, k)
        wanted = min(max((wish - speed) / constants.dt, -constants.braking), constants.acceleration)
        if world.shape[0] > 0:
            wanted = min(wanted, _among_others(network, drivers, route, k, s, car, max(wish, _ONE), world, others))
        curvature = _wanted_curvature(network, constants, route, k, s, car)
        action, owed = _choose_action(constants, car, curvature, wanted, owed)
        poses[steps, 0], poses[steps, 1] = car[X], car[Y]
        poses[steps, 2], poses[steps, 3], poses[steps, 4] = math.atan2(car[SIN], car[COS]), car[SPEED], car[STEERING]
        arc[steps], actions[steps] = s, action
        acceleration, steering = act(constants, action, car[SPEED], car[STEERING])
        end = step_car(road, network, constants, traffic, car, visits, world, acceleration, steering, target, max_steps)
        steps += 1
    return car, steps, end


def drive_reference(
    road_map: Map,
    start: np.ndarray,
    world: np.ndarray,
    seed: int,
    sim: SimConfig | None = None,
    target: float | None = None,
    max_steps: int | None = None,
) -> ReferenceDrive:
    """An episode from a start float32 [5] in the traffic float32 [cars, world.FIELDS] around it; turns are from `seed`.

    It ends as in `envs.simulator`. The defaults of `target` (m) and `max_steps` are the configuration's.
    Raises: ValueError on a map without lanes.
    """
    sim = sim or SimConfig()
    episode = sim.episode
    target = episode.target if target is None else target
    max_steps = round(episode.time_limit / episode.control_period) if max_steps is None else max_steps
    route = plan(road_map, start, 1.1 * target, seed)
    traffic = drivers(sim)
    own = traffic._replace(acceleration=_F(ACCELERATION), comfort=_F(BRAKING), headway=_F(_HEADWAY))
    poses, arc = np.empty((max_steps, 5), np.float32), np.empty(max_steps, np.float32)
    actions = np.empty(max_steps, np.int64)
    start, world, limit = np.asarray(start, dtype=np.float32), np.array(world, dtype=np.float32), np.float32(target)
    road, network, k = road_map.road, road_map.network, constants(sim)
    car, steps, end = _drive(road, network, k, traffic, own, route, start, limit, max_steps, world, poses, arc, actions)
    return ReferenceDrive(poses[:steps], arc[:steps], actions[:steps], car, End(end), route)
