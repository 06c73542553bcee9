"""Traffic: cars that follow lanes, keep their distance, give way where paths cross, and change lanes on the highway.

Longitudinal motion is the intelligent driver model (Treiber, Hennecke and Helbing 2000), lane changes are MOBIL
(Kesting, Treiber and Helbing 2007). A car is on rails: its centre of mass lies on its lane, shifted sideways while it
changes lanes. A junction lane is entered only with a permit, which nobody gets while the ground it crosses is taken.
The ego car is an obstacle like any other, and has the right of way at junctions.

A world is the traffic around one ego car: float32 [cars, FIELDS], the fields below. Whatever happens in it follows from
that array and from the ego car alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gridsim.config import SimConfig, TrafficConfig
from gridsim.counter import GOLDEN, mix, uniform
from gridsim.jit import leaf, njit
from gridsim.roads import Lanes, freeze

_F, _I, _U = np.float32, np.int32, np.uint64
_ZERO, _HALF, _ONE = _F(0.0), _F(0.5), _F(1.0)

# Fields of a traffic car's state; X to SPEED are where the ego car's are.
X, Y = 0, 1  # m, centre of mass
COS, SIN = 2, 3  # heading
SPEED = 4  # m/s
LANE = 5  # index of its lane, -1 for a car that is not there
ALONG = 6  # m along it
NEXT, AFTER = 7, 8  # the two lanes that come then
PAST = 9  # junction lane that its rear may still be on, or -1
PERMIT = 10  # junction lane that it may enter next, or -1
SHIFT = 11  # m to the left of its lane, while it changes lanes
FACTOR = 12  # desired speed over the lane's
SEED = 13  # of its turns, below 2 ** 24
TURNS = 14  # lanes it has chosen so far
PACE = 15  # m/s2, its acceleration in this step
HORIZON = 16  # m ahead that it looks in this step
GAP = 17  # m from its middle to where it must not get
LEAD = 18  # m/s of what is there
CLOCK = 19  # control steps until it thinks of another lane
FIELDS = 20

_THINKING = _F(10.0)  # control steps from one thought of another lane to the next
_LINE = _F(0.25)  # m that a car waits before a junction's line; further back its rear may be in the junction before
_CAUTION = _F(0.25)  # m, added on every side of a car that might be in the way
_SAMPLE = _F(1.25)  # m between the points of a path that are looked at, less than half a car's width and its caution
_CROSSING_TIME = _F(4.0)  # s, what it takes to leave a junction
_REACH = _F(2.4)  # m from the middle of a car within which all of it lies


class Network(NamedTuple):
    """Lanes as the kernels read them; arrays flat, read-only and C-contiguous. The rest is in `roads.Lanes`."""

    points: np.ndarray  # float32 [n, 2], m
    speeds: np.ndarray  # float32 [n], m/s: greatest speed there, so that bends ahead are met in comfort
    offsets: np.ndarray  # int32 [lanes + 1]
    steps: np.ndarray  # float32 [lanes], m between a lane's points
    successors: np.ndarray  # int32 [lanes, k]
    left: np.ndarray  # int32 [lanes], neighbour for a change of lanes, or -1
    right: np.ndarray
    crossing_offsets: np.ndarray  # int32 [lanes + 1]
    crossings: np.ndarray  # int32 [c], junction lanes that cross each lane
    clear: np.ndarray  # float32 [c], m along those from which on a car's middle is out of the way
    width: np.float32  # m, of the torus
    height: np.float32


class Drivers(NamedTuple):
    """`TrafficConfig` as the kernels read it, with the cars' size and the control period."""

    acceleration: np.float32  # m/s2
    comfort: np.float32  # m/s2, deceleration
    braking: np.float32  # m/s2, greatest deceleration
    headway: np.float32  # s
    jam: np.float32  # m
    politeness: np.float32
    threshold: np.float32  # m/s2
    safe: np.float32  # m/s2
    shift: np.float32  # m/s
    half_length: np.float32  # m
    half_width: np.float32  # m
    dt: np.float32  # s


def drivers(sim: SimConfig) -> Drivers:
    """The configuration for the kernels."""
    f, config = np.float32, sim.traffic
    return Drivers(
        acceleration=f(config.acceleration),
        comfort=f(config.comfort),
        braking=f(config.braking),
        headway=f(config.headway),
        jam=f(config.jam),
        politeness=f(config.politeness),
        threshold=f(config.threshold),
        safe=f(config.safe_braking),
        shift=f(config.lane_change_speed),
        half_length=f(sim.vehicle.length / 2),
        half_width=f(sim.vehicle.width / 2),
        dt=f(sim.episode.control_period),
    )


# --- Tables of a map -------------------------------------------------------------------------------------------------


@njit
def _speed_profile(points, offsets, steps, successors, top, lateral, comfort, speeds):
    """Greatest speed at each point: by lateral acceleration, and so that braking for what comes is comfortable."""
    lanes = offsets.shape[0] - 1
    for lane in range(lanes):
        first, last = offsets[lane], offsets[lane + 1] - 1
        for p in range(first, last + 1):
            a, b, c = max(p - 2, first), min(max(p, first + 2), last - 2), min(p + 2, last)
            if last - first < 4:
                a, b, c = first, (first + last) // 2, last
            ux, uy = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
            vx, vy = points[c, 0] - points[b, 0], points[c, 1] - points[b, 1]
            turn = abs(math.atan2(ux * vy - uy * vx, ux * vx + uy * vy))
            length = 0.5 * (math.hypot(ux, uy) + math.hypot(vx, vy))
            speeds[p] = min(top, math.sqrt(lateral * length / max(turn, 1e-6))) if length > 1e-6 else top
    for _ in range(4):  # a bend is felt through the lanes before it
        for lane in range(lanes):
            first, last = offsets[lane], offsets[lane + 1] - 1
            onward = speeds[last]
            for k in range(successors.shape[1]):
                if successors[lane, k] >= 0:
                    onward = min(onward, speeds[offsets[successors[lane, k]]])
            speeds[last] = onward
            for p in range(last - 1, first - 1, -1):
                speeds[p] = min(speeds[p], math.sqrt(speeds[p + 1] ** 2 + 2.0 * comfort * steps[lane]))


@njit
def _clear_points(points, offsets, steps, crossing_offsets, crossings, width, height, apart, clear):
    """For each crossing, the last point of the other lane within `apart` m of this one, as m along it."""
    for lane in range(offsets.shape[0] - 1):
        for c in range(crossing_offsets[lane], crossing_offsets[lane + 1]):
            other = crossings[c]
            last = -1
            for q in range(offsets[other + 1] - 1, offsets[other] - 1, -1):
                for p in range(offsets[lane], offsets[lane + 1]):
                    dx, dy = points[p, 0] - points[q, 0], points[p, 1] - points[q, 1]
                    dx -= round(dx / width) * width
                    dy -= round(dy / height) * height
                    if dx * dx + dy * dy < apart * apart:
                        last = q - offsets[other]
                        break
                if last >= 0:
                    break
            clear[c] = last * steps[other]


def make_network(lanes: Lanes, width: float, height: float, speed_limit: float, config: TrafficConfig) -> Network:
    """Tables of a map's lanes; `speed_limit` (m/s) is the scenario's own."""
    f = np.float32
    speeds = np.empty(len(lanes.points), dtype=np.float32)
    clear = np.zeros(len(lanes.crossings), dtype=np.float32)
    points, offsets, steps = freeze(lanes.points), freeze(lanes.offsets), freeze(lanes.steps)
    successors = freeze(lanes.successors)
    if len(lanes):
        _speed_profile(points, offsets, steps, successors, f(speed_limit), f(config.lateral), f(config.comfort), speeds)
        _clear_points(
            points, offsets, steps, freeze(lanes.crossing_offsets), freeze(lanes.crossings), f(width), f(height),
            f(config.apart), clear,
        )  # fmt: skip
    return network_of_lanes(lanes, freeze(speeds), freeze(clear), width, height)


def network_of_lanes(lanes: Lanes, speeds: np.ndarray, clear: np.ndarray, width: float, height: float) -> Network:
    """Tables from what `make_network` computed before; all arrays read-only already."""
    return Network(
        points=lanes.points,
        speeds=speeds,
        offsets=lanes.offsets,
        steps=lanes.steps,
        successors=lanes.successors,
        left=lanes.left,
        right=lanes.right,
        crossing_offsets=lanes.crossing_offsets,
        crossings=lanes.crossings,
        clear=clear,
        width=np.float32(width),
        height=np.float32(height),
    )


# --- Where a car is --------------------------------------------------------------------------------------------------


@leaf
def wrapped(difference, side):
    """The shortest way round a torus of a side (m) for a difference of two coordinates on it."""
    half = _HALF * side
    if difference > half:
        return difference - side
    if difference < -half:
        return difference + side
    return difference


@leaf
def turned(difference, side):
    """The same for any difference: lanes' points are not wrapped."""
    return difference - math.floor(difference / side + _HALF) * side


@leaf
def lane_length(network, lane):
    """Length (m) of a lane."""
    return _F(network.offsets[lane + 1] - network.offsets[lane] - 1) * network.steps[lane]


@leaf
def _pose(network, car, sway):
    """Put a car where its lane, its metres along it and its shift say; `sway` is the shift's speed over the car's."""
    lane = _I(car[LANE])
    first = network.offsets[lane]
    last = network.offsets[lane + 1] - first - 2
    at = car[ALONG] / network.steps[lane]
    k = min(max(_I(at), _I(0)), _I(last))
    part = at - _F(k)
    x0, y0 = network.points[first + k, 0], network.points[first + k, 1]
    dx, dy = network.points[first + k + 1, 0] - x0, network.points[first + k + 1, 1] - y0
    # The heading turns from the last piece's to the next one's, so that the car does not jerk at every point.
    before, after = max(k - 1, 0), min(k + 2, last + 1)
    ax, ay = x0 + dx - network.points[first + before, 0], y0 + dy - network.points[first + before, 1]
    bx, by = network.points[first + after, 0] - x0, network.points[first + after, 1] - y0
    tx, ty = ax + part * (bx - ax), ay + part * (by - ay)
    norm = _ONE / math.sqrt(max(tx * tx + ty * ty, _F(1e-12)))
    tx, ty = tx * norm, ty * norm
    x, y = x0 + part * dx - car[SHIFT] * ty, y0 + part * dy + car[SHIFT] * tx
    car[X] = x - math.floor(x / network.width) * network.width
    car[Y] = y - math.floor(y / network.height) * network.height
    norm = _ONE / math.sqrt(_ONE + sway * sway)
    car[COS], car[SIN] = (tx - sway * ty) * norm, (ty + sway * tx) * norm


@leaf
def _draw(car):
    """A random number in [0, 1) of a car's own."""
    car[TURNS] += _ONE
    return uniform(mix(mix(_U(car[SEED])) + _U(car[TURNS]) * GOLDEN))


@leaf
def _choose(network, lane, car):
    """A lane after `lane`, at random."""
    count = 0
    for k in range(network.successors.shape[1]):
        if network.successors[lane, k] >= 0:
            count += 1
    return network.successors[lane, min(_I(_draw(car) * _F(count)), _I(count - 1))]


@njit
def _is_free(network, world, n, x, y, apart):
    for j in range(n):
        if world[j, LANE] >= _ZERO:
            dx, dy = world[j, X] - x, world[j, Y] - y
            dx, dy = wrapped(dx, network.width), wrapped(dy, network.height)
            if dx * dx + dy * dy < apart * apart:
                return False
    return True


@njit(nogil=True)
def _spawn(network, mileage, start, key, gap, ego_gap, world):
    """Fill a world [cars, FIELDS]: uniformly over the lanes outside junctions, away from each other and the ego car."""
    draws = 0
    for i in range(world.shape[0]):
        car = world[i]
        car[:] = _ZERO
        car[LANE], car[PAST], car[PERMIT] = -_ONE, -_ONE, -_ONE
        car[CLOCK] = _F(i) % _THINKING  # not all at once
        for _ in range(60):
            draws += 1
            bits = mix(key + _U(draws) * GOLDEN)
            metres = (bits >> _U(11)) * (1.0 / (1 << 53)) * mileage[-1]
            lane = np.searchsorted(mileage, metres, side="right") - 1
            lane = min(lane, len(mileage) - 2)
            if network.crossing_offsets[lane + 1] > network.crossing_offsets[lane]:
                continue
            car[LANE], car[ALONG] = _F(lane), _F(metres - mileage[lane])
            _pose(network, car, _ZERO)
            dx, dy = car[X] - start[0], car[Y] - start[1]
            dx, dy = wrapped(dx, network.width), wrapped(dy, network.height)
            if dx * dx + dy * dy >= ego_gap * ego_gap and _is_free(network, world, i, car[X], car[Y], gap):
                car[SEED] = _F(mix(bits) >> _U(40))
                car[FACTOR] = _F(0.9) + _F(0.3) * uniform(mix(bits + GOLDEN))
                car[NEXT] = _F(_choose(network, lane, car))
                car[AFTER] = _F(_choose(network, _I(car[NEXT]), car))
                at = network.offsets[lane] + _I(car[ALONG] / network.steps[lane])
                car[SPEED] = _HALF * car[FACTOR] * network.speeds[at]
                break
            car[LANE] = -_ONE


def spawn(network: Network, starts: np.ndarray, cars: int, keys: np.ndarray, config: TrafficConfig) -> np.ndarray:
    """Worlds float32 [n, cars, FIELDS] around ego cars at `starts` [n, 5], from keys uint64 [n].

    Uniform over the lanes outside junctions; a car for which there is no room is not there (LANE is -1).
    """
    worlds = np.zeros((len(starts), cars, FIELDS), dtype=np.float32)
    if cars and len(network.offsets) > 1:
        lengths = (np.diff(network.offsets) - 1) * network.steps.astype(np.float64)
        mileage = np.concatenate([[0.0], np.cumsum(lengths)])
        for world, start, key in zip(worlds, np.asarray(starts, dtype=np.float32), keys, strict=True):
            _spawn(network, mileage, start, _U(key), _F(config.spawn_gap), _F(config.spawn_gap_ego), world)
    else:
        worlds[:, :, LANE] = -1.0
    return worlds


# --- Driving ---------------------------------------------------------------------------------------------------------


@leaf
def idm(drivers, speed, desired, gap, leader):
    """Acceleration (m/s2) of the intelligent driver model: Treiber et al. 2000, equations 2 and 3.

    Args: own speed and the desired one, m/s; m to the leader's rear; the leader's speed, m/s. Without a leader the gap
    is infinite.
    """
    ratio = speed / max(desired, _F(0.1))
    free = ratio * ratio
    free *= free
    wanted = drivers.jam + max(
        _ZERO,
        speed * drivers.headway
        + speed * (speed - leader) / (_F(2.0) * math.sqrt(drivers.acceleration * drivers.comfort)),
    )
    near = wanted / max(gap, _F(0.01))
    return max(drivers.acceleration * (_ONE - free - near * near), -drivers.braking)


@leaf
def _ahead(network, car, other_lane, other_along):
    """Way (m) from a car to a place on its lane or one of the two that come then; 1e9 if it is on none, or behind."""
    lane, after, third = _I(car[LANE]), _I(car[NEXT]), _I(car[AFTER])
    if other_lane == lane and other_along > car[ALONG]:
        return other_along - car[ALONG]
    rest = lane_length(network, lane) - car[ALONG]
    if other_lane == after:
        return rest + other_along
    if other_lane == third:
        return rest + lane_length(network, after) + other_along
    return _F(1e9)


@leaf
def _in_the_way(network, drivers, car, x, y, cosine, sine, horizon):
    """M from a car's middle along its path to where its way is blocked by a car at (x, y) with a heading; 1e9 if not.

    Looks at points of the path from the car's front on, up to `horizon` m.
    """
    half_length = drivers.half_length + drivers.half_width + _CAUTION
    half_width = drivers.half_width + drivers.half_width + _CAUTION
    lane = _I(car[LANE])
    along = car[ALONG]
    travelled = drivers.half_length
    along += travelled
    for _ in range(3):
        length = lane_length(network, lane)
        first = network.offsets[lane]
        step = network.steps[lane]
        while along <= length:
            if travelled > horizon:
                return _F(1e9)
            k = first + _I(along / step)
            dx, dy = turned(network.points[k, 0] - x, network.width), turned(network.points[k, 1] - y, network.height)
            forward, aside = dx * cosine + dy * sine, dy * cosine - dx * sine
            away = max(abs(forward) - half_length, abs(aside) - half_width)
            if away < _ZERO:
                return travelled
            hop = max(away, _SAMPLE)  # nothing can be in the way any sooner
            along += hop
            travelled += hop
        along -= length
        if lane == _I(car[LANE]):
            lane = _I(car[NEXT])
        else:
            lane = _I(car[AFTER])
    return _F(1e9)


@leaf
def _is_junction(network, lane):
    return network.crossing_offsets[lane + 1] > network.crossing_offsets[lane]


@leaf
def _passes(network, drivers, lane, other):
    """Whether a lane passes where a car's rear is that waits at the end of another lane with the same beginning."""
    step = network.steps[other]
    q = network.offsets[other + 1] - 1 - _I((_F(2.0) * drivers.half_length + drivers.jam) / step)
    reach = _F(2.0) * drivers.half_width + _F(2.0) * _CAUTION
    for p in range(network.offsets[lane], network.offsets[lane + 1]):
        dx = turned(network.points[p, 0] - network.points[q, 0], network.width)
        dy = turned(network.points[p, 1] - network.points[q, 1], network.height)
        if dx * dx + dy * dy < reach * reach:
            return True
    return False


@leaf
def _reaches(network, lane, x, y, within):
    """M along a lane to its first point so many m or less from (x, y); 1e9 if it does not come so near."""
    first, k = network.offsets[lane], network.offsets[lane]
    while k < network.offsets[lane + 1]:
        dx, dy = turned(network.points[k, 0] - x, network.width), turned(network.points[k, 1] - y, network.height)
        apart = math.sqrt(dx * dx + dy * dy)
        if apart < within:
            return _F(k - first) * network.steps[lane]
        k += max(_I((apart - within) / network.steps[lane]), _I(1))
    return _F(1e9)


@leaf
def _may_enter(network, drivers, world, i, ego):
    """Whether car i may enter its next lane, a junction's: nobody's way crosses it, and there is room behind it."""
    car = world[i]
    here, lane, beyond = _I(car[LANE]), _I(car[NEXT]), _I(car[AFTER])
    first, last = network.crossing_offsets[lane], network.crossing_offsets[lane + 1]
    # Who enters must be able to leave, or junctions would block each other. Before another junction there is room for
    # one, else for as many as the lane beyond holds.
    chained = _is_junction(network, beyond)
    place = _F(2.0) * drivers.half_length + drivers.jam
    room, needed = max(lane_length(network, beyond), place), place
    for j in range(world.shape[0]):
        if j == i or world[j, LANE] < _ZERO:
            continue
        there, past, permit = _I(world[j, LANE]), _I(world[j, PAST]), _I(world[j, PERMIT])
        onward = _I(world[j, NEXT])
        for c in range(first, last):
            other = network.crossings[c]
            if permit == other:
                return False
            if there == other and world[j, ALONG] - drivers.half_length < network.clear[c] + _HALF:
                return False
            if past == other and lane_length(network, other) + world[j, ALONG] - drivers.half_length < (
                network.clear[c] + _HALF
            ):
                return False
        waits = _I(-1)  # lane at whose end the other may have to wait, still in this junction
        if there == here and world[j, ALONG] > car[ALONG]:
            if permit != onward:
                return False  # who is in front of this one waits for others, who must not wait for this one
            if _is_junction(network, _I(world[j, AFTER])):
                waits = permit
        elif permit != onward and _is_junction(network, there) and _is_junction(network, onward):
            for k in range(network.successors.shape[1]):
                if there == network.successors[here, k]:
                    waits = there
        if waits >= 0 and waits != lane and _passes(network, drivers, lane, waits):
            return False
        if chained:
            if there == lane or permit == lane:
                return False
            for k in range(network.successors.shape[1]):
                slow = there == network.successors[lane, k] and world[j, SPEED] < _F(2.0)
                if slow and world[j, ALONG] < place + drivers.half_length:
                    return False
        elif there == beyond:
            rear = world[j, ALONG] - drivers.half_length
            room = min(room, rear + world[j, SPEED] * world[j, SPEED] / (_F(2.0) * drivers.comfort))
        elif (permit >= 0 and _I(world[j, AFTER]) == beyond) or (onward == beyond and _is_junction(network, there)):
            needed += place
    # The ego car goes first, unless it is behind this one.
    if ego[COS] != _ZERO or ego[SIN] != _ZERO:
        dx, dy = ego[X] - car[X], ego[Y] - car[Y]
        dx, dy = wrapped(dx, network.width), wrapped(dy, network.height)
        forward, aside = dx * car[COS] + dy * car[SIN], dy * car[COS] - dx * car[SIN]
        way = _CROSSING_TIME * max(ego[SPEED], _ZERO)
        far = car[HORIZON] + lane_length(network, lane) + way + _F(2.0) * place
        if dx * dx + dy * dy < far * far and not (forward < _ZERO and abs(aside) < _F(2.5)):
            for k in range(1 + _I(way / _F(4.0))):
                x, y = ego[X] + _F(4.0) * _F(k) * ego[COS], ego[Y] + _F(4.0) * _F(k) * ego[SIN]
                if _reaches(network, lane, x, y, _F(3.0)) < _F(1e8):
                    return False
            rear = _reaches(network, beyond, ego[X], ego[Y], _F(1.5)) - drivers.half_length
            room = min(room, rear + ego[SPEED] * ego[SPEED] / (_F(2.0) * drivers.comfort))
    return room >= needed


@leaf
def follow(network, drivers, car, other, is_ego):
    """Take another car within a car's horizon into account: whether it is the nearest thing to keep behind."""
    along = max((car[COS] * other[COS] + car[SIN] * other[SIN]) * other[SPEED], _ZERO)
    at = _F(1e9)
    dx, dy = wrapped(other[X] - car[X], network.width), wrapped(other[Y] - car[Y], network.height)
    forward = dx * car[COS] + dy * car[SIN]
    looked = forward < _F(-6.0)  # who is behind is not in the way
    if not is_ego:
        lane = _I(other[LANE])
        at = _ahead(network, car, lane, other[ALONG]) - drivers.half_length
        # Neither is who keeps to a lane beside others.
        looked = looked or at < _F(1e8) or (other[SHIFT] == _ZERO and max(network.left[lane], network.right[lane]) >= 0)
    if not looked:
        at = _in_the_way(network, drivers, car, other[X], other[Y], other[COS], other[SIN], car[HORIZON])
    if at < car[GAP]:
        car[GAP], car[LEAD] = at, along
    same_way = car[COS] * other[COS] + car[SIN] * other[SIN] > _HALF
    if is_ego and not looked and same_way and other[SPEED] > _ONE:
        # Where the ego car will be in a second: it may be about to cut in.
        x, y = other[X] + other[SPEED] * other[COS], other[Y] + other[SPEED] * other[SIN]
        at = _in_the_way(network, drivers, car, x, y, other[COS], other[SIN], car[HORIZON])
        if at < car[GAP] and forward > _ZERO:
            car[GAP], car[LEAD] = at, along


@leaf
def _see(network, drivers, world, ego):
    """Find for each car the nearest thing that it has to keep behind, within its horizon: GAP and LEAD."""
    cars = world.shape[0]
    for i in range(cars):
        speed = world[i, SPEED]
        world[i, HORIZON] = drivers.jam + _F(8.0) + speed * (_F(1.5) + speed / (_F(2.0) * drivers.comfort))
        world[i, GAP], world[i, LEAD] = _F(1e9), _ZERO
    for i in range(cars):
        if world[i, LANE] < _ZERO:
            continue
        x, y = world[i, X], world[i, Y]
        for j in range(i):
            if world[j, LANE] < _ZERO:
                continue
            dx, dy = wrapped(world[j, X] - x, network.width), wrapped(world[j, Y] - y, network.height)
            apart = math.sqrt(dx * dx + dy * dy) - _F(5.0)
            if apart < world[i, HORIZON]:
                follow(network, drivers, world[i], world[j], False)
            if apart < world[j, HORIZON]:
                follow(network, drivers, world[j], world[i], False)
        dx, dy = wrapped(ego[X] - x, network.width), wrapped(ego[Y] - y, network.height)
        if (
            math.sqrt(dx * dx + dy * dy) - _F(5.0) < world[i, HORIZON]
            and ego[COS] * ego[COS] + ego[SIN] * ego[SIN] > _HALF
        ):
            follow(network, drivers, world[i], ego, True)


@leaf
def _desired(network, car):
    """Speed (m/s) that a car would like to go where it is."""
    lane = _I(car[LANE])
    at = network.offsets[lane] + _I(car[ALONG] / network.steps[lane])
    return car[FACTOR] * network.speeds[min(at, _I(network.offsets[lane + 1] - 1))]


@njit(_nrt=False)
def change_lanes(network, drivers, world, i, ego):
    """MOBIL (Kesting et al. 2007): move car i to a neighbouring lane where that is safe and it gains by it."""
    car = world[i]
    lane = _I(car[LANE])
    if car[CLOCK] > _ZERO:
        car[CLOCK] -= _ONE
        return
    car[CLOCK] = _THINKING - _ONE
    if car[SHIFT] != _ZERO:
        return
    if network.left[lane] < 0 and network.right[lane] < 0:
        return
    mine = car[PACE]
    best, gain = _I(-1), drivers.threshold
    for side in range(2):
        target = network.left[lane] if side == 0 else network.right[lane]
        if target < 0:
            continue
        along = car[ALONG] / network.steps[lane] * network.steps[target]
        # The gaps to the next cars ahead and behind in the target lane.
        front, front_speed, rear, rear_speed, rear_desired = _F(1e9), _ZERO, _F(1e9), _ZERO, _ONE
        free = True
        for j in range(world.shape[0] + 1):
            if j == i:
                continue
            other = world[j] if j < world.shape[0] else ego
            if (j < world.shape[0] and other[LANE] < _ZERO) or (other[COS] == _ZERO and other[SIN] == _ZERO):
                continue
            dx, dy = other[X] - car[X], other[Y] - car[Y]
            dx, dy = wrapped(dx, network.width), wrapped(dy, network.height)
            if dx * dx + dy * dy > _F(10000.0):
                continue
            if j < world.shape[0]:
                there = _I(other[LANE])
                place = other[ALONG]
                ahead = _F(1e9)
                if there == target:
                    ahead = place - along
                elif network.successors[target, 0] == there:
                    ahead = lane_length(network, target) - along + place
                elif network.successors[there, 0] == target:
                    ahead = along + lane_length(network, there) - place
                    ahead = -ahead
                elif there != lane and other[SHIFT] != _ZERO and dx * dx + dy * dy < _F(400.0):
                    free = False  # somebody else is moving over, from beyond the target lane or out of it
                if ahead > _F(1e8):
                    continue
            else:
                ahead = dx * car[COS] + dy * car[SIN]  # of the ego car, which is on no lane
                aside = dy * car[COS] - dx * car[SIN]
                sideways = _F(3.75) if side == 0 else _F(-3.75)
                if abs(aside - sideways) > _F(2.8) + _F(0.004) * ahead * ahead:
                    continue
            if abs(ahead) < _F(2.0) * drivers.half_length + drivers.jam:
                free = False
            if ahead >= _ZERO and ahead < front:
                front, front_speed = ahead, other[SPEED]
            if ahead < _ZERO and -ahead < rear:
                rear, rear_speed = -ahead, other[SPEED]
                rear_desired = _desired(network, other) if j < world.shape[0] else other[SPEED]
        if not free:
            continue
        desired = _desired(network, car)
        there = idm(drivers, car[SPEED], desired, front - _F(2.0) * drivers.half_length, front_speed)
        behind = _ZERO
        lost = _ZERO
        if rear < _F(1e8):
            behind = idm(drivers, rear_speed, rear_desired, rear - _F(2.0) * drivers.half_length, car[SPEED])
            alone = idm(drivers, rear_speed, rear_desired, _F(1e9), _ZERO)
            lost = max(alone - behind, _ZERO)
        if behind < -drivers.safe or there < -drivers.safe:
            continue
        advantage = there - mine - drivers.politeness * lost
        if advantage > gain:
            best, gain = _I(target), advantage
    if best >= 0:
        toward = _ONE if best == network.left[lane] else -_ONE
        car[ALONG] = car[ALONG] / network.steps[lane] * network.steps[best]
        first, second = network.offsets[lane], network.offsets[best]
        k = _I(car[ALONG] / network.steps[best])
        dx = network.points[second + k, 0] - network.points[first + k, 0]
        dy = network.points[second + k, 1] - network.points[first + k, 1]
        dx, dy = turned(dx, network.width), turned(dy, network.height)
        car[SHIFT] = -toward * math.sqrt(dx * dx + dy * dy)
        car[LANE] = _F(best)
        car[NEXT] = _F(_choose(network, best, car))
        car[AFTER] = _F(_choose(network, _I(car[NEXT]), car))


@leaf
def _go(network, drivers, car):
    """Move one car by its acceleration for a control period."""
    after = max(car[SPEED] + car[PACE] * drivers.dt, _ZERO)
    car[ALONG] += _HALF * (car[SPEED] + after) * drivers.dt
    car[SPEED] = after
    sway = _ZERO
    if car[SHIFT] != _ZERO:
        slide = min(drivers.shift * drivers.dt, abs(car[SHIFT])) * min(after, _ONE)
        if car[SHIFT] > _ZERO:
            slide = -slide
        car[SHIFT] += slide
        if abs(car[SHIFT]) < _F(1e-3):
            car[SHIFT] = _ZERO
        sway = slide / max(after * drivers.dt, _F(0.1))
        sway = min(max(sway, _F(-0.2)), _F(0.2))
    length = lane_length(network, _I(car[LANE]))
    if car[ALONG] >= length:
        lane = _I(car[LANE])
        car[ALONG] -= length
        car[PAST] = car[LANE] if _is_junction(network, lane) else -_ONE
        car[LANE], car[NEXT] = car[NEXT], car[AFTER]
        car[PERMIT] = -_ONE
        car[AFTER] = _F(_choose(network, _I(car[NEXT]), car))
    elif car[PAST] >= _ZERO and car[ALONG] > drivers.half_length + _ONE:
        car[PAST] = -_ONE
    _pose(network, car, sway)


@njit(nogil=True, _nrt=False)
def flow(network, drivers, world, ego):
    """One control period of a world's traffic around the ego car as it was before its own move.

    Args: world [cars, FIELDS], changed; ego, a car of which X to SPEED are read (without a heading, COS and SIN 0, it
    is not there).
    """
    cars = world.shape[0]
    _see(network, drivers, world, ego)
    for i in range(cars):
        car = world[i]
        if car[LANE] < _ZERO:
            continue
        lane, onward = _I(car[LANE]), _I(car[NEXT])
        desired = _desired(network, car)
        pace = idm(drivers, car[SPEED], desired, car[GAP] - drivers.half_length, car[LEAD])
        if _is_junction(network, onward) and car[PERMIT] != car[NEXT]:
            # A junction comes: up to its line without a permit.
            line = lane_length(network, lane) - car[ALONG] - drivers.half_length
            if line < car[HORIZON]:
                if _may_enter(network, drivers, world, i, ego):
                    car[PERMIT] = car[NEXT]
                else:
                    pace = min(pace, idm(drivers, car[SPEED], desired, line + drivers.jam - _LINE, _ZERO))
        car[PACE] = pace
    for i in range(cars):
        if world[i, LANE] >= _ZERO:
            change_lanes(network, drivers, world, i, ego)
    for i in range(cars):
        if world[i, LANE] >= _ZERO:
            _go(network, drivers, world[i])
