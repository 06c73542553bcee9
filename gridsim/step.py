"""A control step: traffic moves, the ego car drives, collides, gains new ground or ends its episode, and looks around.

Everything that drives cars is a loop over `obey`, `step` and `look`: `gridsim.simulator` and
`evolution.episodes.rollout`. A `world` is the state of the other cars (`traffic.world`). In kernels, None means that
there are none: Numba then leaves out the code for traffic.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from gridsim.car.kinematic import path_curvature
from gridsim.car.models import MODELS, front_velocity, move
from gridsim.car.vehicle import NEUTRAL, act, act_continuous
from gridsim.collision import collides, hits_box, stands_ahead, top_speed_near
from gridsim.config import REENTRY, SUBSTEP, Constants, SimConfig, constants
from gridsim.jit import ONE, ZERO, F, I, leaf, njit
from gridsim.maps.lights import CLEARING, crosses_line, set_clock, way_to_line
from gridsim.maps.map import Map
from gridsim.maps.network import Network
from gridsim.maps.roads import VISIT_CELL, Road
from gridsim.sensing.imperfections import Delays, Imperfections, degrade, imperfections_of, late_command, late_readings
from gridsim.sensing.observation import ROUTE, Encoding, encoding, observe, sees
from gridsim.sensing.rays import cast_boxes, cast_lines, fan, sense
from gridsim.sensing.route import ASTRAY, begin_route, check_lanes, follow_route
from gridsim.state import (
    CELL,
    CLOCK,
    COS,
    DEBT,
    DISTANCE,
    FRESH,
    IDLE,
    ODOMETER,
    PACED,
    POSE,
    ROUTE_KEY,
    ROUTE_LANE,
    SIN,
    SPEED,
    STEERING,
    STEPS,
    X,
    Y,
)  # fmt: skip
from gridsim.traffic.behaviour import Drivers, drivers, step_traffic

_VISIT_SCALE = F(1.0 / VISIT_CELL)
# A direction (cosine, sine). Whether a car heads along it or against it tells the two ways of a street apart; few
# streets lie at right angles to it.
_WAY = F(0.93), F(0.37)


class Simulation(NamedTuple):
    """A map and the simulator's parameters as kernels read them."""

    road: Road
    network: Network
    constants: Constants
    drivers: Drivers
    fan: np.ndarray  # directions of the rays (`rays.fan`)
    model: Any  # `Parameters` of the vehicle's model
    imperfections: Imperfections | None  # None, and so are delays, if nothing is imperfect
    delays: Delays | None
    encoding: Encoding


def parameters(config: SimConfig, features: tuple[str, ...] = (), start: np.ndarray | None = None) -> tuple[Any, ...]:
    """What a Simulation holds besides its map. Raises: ValueError for an invalid configuration.

    Args: `start`, the start of the episode whose vehicle is drawn (`SimConfig.drawn`); None: the configuration's own.
    Observations have the configuration's scales, whatever is drawn.
    """
    own = config if start is None else config.drawn(start)
    k, model = constants(own), MODELS[own.vehicle.model].parameters(own.vehicle)
    rays = fan(own.sensors.rays, k.ray_first, k.ray_step)
    return k, drivers(own), rays, model, *imperfections_of(config, own), _scales(features, config)


@lru_cache
def _scales(features: tuple[str, ...], config: SimConfig) -> Encoding:
    """The encoding; kept, as `constants` checks all that `randomise` may draw, which takes longer than a reset."""
    return encoding(features, constants(config))


def simulations_on(
    road_maps: Sequence[Map], config: SimConfig, features: tuple[str, ...] = (), start: np.ndarray | None = None
) -> list[Simulation]:
    """A Simulation for each map; arguments as of `parameters`.

    Raises: GridSimError if a route is to be followed on a map without lanes.
    """
    for each in road_maps:
        check_lanes(each, features)
    shared = parameters(config, features, start)
    return [Simulation(each.road, each.network, *shared) for each in road_maps]


@njit
def visit_cells(road: Road) -> int:
    """Number of visit cells of a map."""
    columns, rows = int(road.width * road.per_m), int(road.height * road.per_m)
    return int(road.ways) * (columns // VISIT_CELL * (rows // VISIT_CELL))


@leaf
def visit_cell(road, x, y, cosine, sine):
    """Index of a car's visit cell on the torus; if `Road.ways` is 2, each direction of travel has cells of its own."""
    scale = _VISIT_SCALE * road.per_m
    columns = I(road.width * scale)
    rows = I(road.height * scale)
    column = min(max(I(x * scale), I(0)), columns - I(1))
    row = min(max(I(y * scale), I(0)), rows - I(1))
    cell = row * columns + column
    if road.ways > ONE and _WAY[0] * cosine + _WAY[1] * sine < ZERO:
        cell += rows * columns
    return cell


@leaf
def place(simulation, start, car, visits):
    """Put a car at the start of an episode: start float32 [5], or [8] to continue a drive (`state.START_FIELDS`)."""
    road = simulation.road
    car[:] = ZERO
    car[X] = start[0] - math.floor(start[0] / road.width) * road.width
    car[Y] = start[1] - math.floor(start[1] / road.height) * road.height
    car[COS], car[SIN] = math.cos(start[2]), math.sin(start[2])
    car[SPEED], car[STEERING] = start[3], start[4]
    visits[:] = F(-1e6)
    cell = visit_cell(road, car[X], car[Y], car[COS], car[SIN])
    car[CELL], car[FRESH] = F(cell), ONE
    visits[cell] = ZERO
    set_clock(simulation.network, start, car)
    if sees(simulation.encoding, ROUTE):
        begin_route(simulation.network, start, car)


@leaf
def start_from(car, start):
    """The inverse of `place`: write a car's pose, route and clock to start float32 [8]."""
    start[0], start[1] = car[X], car[Y]
    start[2] = math.atan2(car[SIN], car[COS])
    start[3], start[4] = car[SPEED], car[STEERING]
    start[POSE], start[POSE + 1], start[POSE + 2] = car[ROUTE_LANE], car[ROUTE_KEY], car[CLOCK]


@leaf
def look(simulation, car, world, ranges, closing, observation, history):
    """Sense ranges (m), from the middle of the front axle to the road's edge, a car or a stop line, and observe.

    Writes: ranges float32 [rays]; with traffic also closing float32 [rays], the closing speeds of `rays.cast_boxes`,
    unless that array is empty; observation float32 [values]. With a `history`, the ranges and closing speeds are those
    of some control steps ago (`Delays.readings`).
    """
    road, constants, fan = simulation.road, simulation.constants, simulation.fan
    x = car[X] + constants.front_axle * car[COS]
    y = car[Y] + constants.front_axle * car[SIN]
    sense(road, fan, constants.ray_range, x, y, car[COS], car[SIN], ranges)
    if world is not None:
        velocity = front_velocity(simulation.model, constants, car) if closing.shape[0] > 0 else (ZERO, ZERO)
        cast_boxes(constants, fan, road.width, road.height, x, y, car[COS], car[SIN], velocity, world, ranges, closing)
    if simulation.network.lines.shape[0] > 0:
        seconds, reach = car[CLOCK] * constants.dt, constants.ray_range
        cast_lines(simulation.network, fan, reach, seconds, x, y, car[COS], car[SIN], ranges, closing)
    degrade(simulation.imperfections, constants.ray_range, car, ranges, closing)
    late_readings(history, car, ranges, closing)
    observe(simulation, car, world, ranges, closing, observation)


@leaf
def obey(constants, car, history, discrete, first, second):
    """Acceleration (m/s2) and steering (rad) of a command, which is late by `history`.

    A `discrete` command is the number of an action, and 0; any other is pedal and wheel.
    """
    first, second = late_command(history, car, first, second, NEUTRAL if discrete else ZERO)
    if discrete:
        return act(constants, I(first), car[SPEED], car[STEERING])
    return act_continuous(constants, first, second, car[SPEED], car[STEERING])


@leaf
def step(simulation, car, visits, world, acceleration, steering, target, max_steps):
    """One control step: advance in sub-steps with collision checks, count new ground, check for the end.

    Args: acceleration m/s2 and steering rad, as of `obey`; the episode's limits: `target`, m of new ground, and
    `max_steps`, control steps.
    Returns: an End as a number.
    """
    road, constants = simulation.road, simulation.constants
    if world is not None:
        step_traffic(simulation.network, simulation.drivers, world, car)
    car[STEERING] = steering
    x, y, cosine, sine, speed = car[X], car[Y], car[COS], car[SIN], car[SPEED]
    curvature = path_curvature(constants, speed, steering)
    fastest = max(abs(speed), abs(speed + acceleration * constants.dt))
    near = False
    if world is not None:
        closing = top_speed_near(world, constants.near, road.width, road.height, x, y)
        near = closing >= ZERO
        if near:
            fastest += closing
    parts = I(1) + I(fastest * constants.dt * road.per_m / SUBSTEP)
    dt = constants.dt / F(parts)
    moved = ZERO
    crashed = False
    for part in range(parts):
        x, y, cosine, sine, speed, length = move(
            simulation.model, constants, car, curvature, x, y, cosine, sine, speed, acceleration, dt
        )
        moved += length
        if collides(road, constants, x, y, cosine, sine):
            crashed = True
            break
        if world is not None and near:
            back = ONE - F(part + 1) / F(parts)
            if hits_box(constants, world, back, constants.dt, road.width, road.height, x, y, cosine, sine):
                crashed = True
                break
    waits = False
    if simulation.network.lines.shape[0] > 0:
        seconds = car[CLOCK] * constants.dt
        crashed |= crosses_line(simulation.network, seconds, car, constants.half_length, x, y, cosine, sine)
        way = way_to_line(simulation.network, seconds, CLEARING, x, y, cosine, sine)
        waits = way < constants.courtesy + constants.half_length
        car[CLOCK] += ONE
    if x < ZERO:
        x += road.width
    elif x >= road.width:
        x -= road.width
    if y < ZERO:
        y += road.height
    elif y >= road.height:
        y -= road.height
    car[X], car[Y], car[COS], car[SIN], car[SPEED] = x, y, cosine, sine, speed
    car[STEPS] += ONE
    odometer = car[ODOMETER] + abs(moved)
    car[ODOMETER] = odometer
    cell = visit_cell(road, x, y, cosine, sine)
    if F(cell) != car[CELL]:
        gap = odometer - visits[cell]
        car[CELL] = F(cell)
        if gap > REENTRY * road.unit:
            car[FRESH] = ONE if gap > constants.revisit else ZERO
    visits[cell] = odometer
    astray = False
    if car[ROUTE_KEY] > ZERO:  # progress along the route is new ground
        moved, away = follow_route(simulation.network, car, F(2.0) * abs(moved))
        astray = away > (ASTRAY * road.unit) ** 2
        car[FRESH] = ONE
    gained = ZERO
    if moved < ZERO:
        car[DEBT] -= moved
    else:
        paid = min(car[DEBT], moved)
        car[DEBT] -= paid
        gained = (moved - paid) * car[FRESH]
    car[DISTANCE] += gained
    if road.speed_low <= speed and speed <= road.speed_high:
        car[PACED] += gained
    if gained < constants.progress:
        # Waiting behind a standing car, or at a light, is not idleness.
        if world is not None and near and not waits:
            waits = stands_ahead(constants, world, road.width, road.height, car[X], car[Y], cosine, sine)
        if not waits:
            car[IDLE] += ONE
    else:
        car[IDLE] = ZERO
    if crashed:
        return 1
    if astray:
        return 5
    if car[IDLE] >= F(constants.patience):
        return 2
    if car[DISTANCE] >= target:
        return 3
    if car[STEPS] >= max_steps:
        return 4
    return 0
