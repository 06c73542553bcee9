"""The lane network of a map as kernels read it, and distances on the torus."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from gridsim.config import TRAFFIC_PACE, SimConfig
from gridsim.jit import HALF, ZERO, F, I, U, freeze, leaf, njit
from gridsim.maps.roads import Road, clearance

# Which cars of a crossing lane have priority over this lane's cars. NEVER: none. MOVING: those that do not stand; this
# is used where lanes give way to one another in a circle. ALWAYS: all, also those that stand.
NEVER, MOVING, ALWAYS = YIELDS = 0, 1, 2
_ALONG_SIDE = np.linspace(-1.0, 1.0, 9, dtype=np.float32)  # points of a car's side, as shares of its half length


class Network(NamedTuple):
    """Directed lanes as polylines of equally spaced points: s m along lane l, at index offsets[l] + s / steps[l].

    As kernels read them: arrays read-only and C-contiguous. `make_network` computes `speeds`, `clear` and `room`.
    """

    points: np.ndarray  # float32 [n, 2], m; those of a lane in driving direction, not wrapped over the torus
    speeds: np.ndarray  # float32 [n], m/s, traffic's top speed: low enough for bends and for gentle braking before them
    offsets: np.ndarray  # int32 [lanes + 1], where each lane's points begin
    steps: np.ndarray  # float32 [lanes], m between a lane's points; 1 m at most
    # int32 [lanes, k], padded with -1: the lanes, at least one, that begin where a lane ends, modulo the torus's sides
    successors: np.ndarray
    left: np.ndarray  # int32 [lanes], lane to the left to which a car may change, or -1; points i of both are abreast
    right: np.ndarray  # the same for the lane to the right
    crossing_offsets: np.ndarray  # int32 [lanes + 1], where each lane's part of `crossings` begins
    # int32 [c], for each lane the lanes with which it conflicts in a junction: they cross it or merge into its end.
    # Neighbours are never among them. Predecessors, successors and lanes with the same beginning are among them only on
    # real roads, if they come close to the lane once more (`real.shape.Conflicts`).
    crossings: np.ndarray
    clear: np.ndarray  # float32 [c], m along each crossing lane that a car's rear must pass before this lane is free
    # uint8 [c], which cars of each crossing lane have priority over this lane's: one of `YIELDS`. If the array is
    # empty, no car has priority.
    yields: np.ndarray
    # float32 [n], m that a car at each point can move towards the edge on its side of the road, to let the ego car
    # pass; 0 on lanes with a neighbour.
    room: np.ndarray
    boxes: np.ndarray  # float32 [lanes, 4], m: middle x, y and half sides of each lane's bounding box
    # float32 [lines, 5], the stop lines of traffic lights: middle x, y (m), direction of traffic (cosine, sine), and
    # half the length (m) across that direction. Program k is that of stop line k.
    lines: np.ndarray
    signals: np.ndarray  # int32 [lanes], the program of the light at which cars enter each lane, or -1
    program_offsets: np.ndarray  # int32 [programs + 1], where each program's part of `programs` begins
    programs: np.ndarray  # uint8 [s], `lights.GO`, CLEARING or STOP in each second of a program, which repeats
    width: np.float32  # m, of the torus
    height: np.float32
    hand: np.float32  # the side of the road on which traffic drives: 1 right, -1 left

    def scaled(self, factor: float) -> Network:
        """The network with lengths multiplied by a factor, a power of two; `speeds` and stop lines are kept."""
        if factor == 1.0:
            return self
        arrays = {
            name: freeze(getattr(self, name) * F(factor)) for name in ("points", "steps", "clear", "room", "boxes")
        }
        return self._replace(**arrays, width=self.width * F(factor), height=self.height * F(factor), hand=self.hand)


@njit
def _speed_profile(points, offsets, steps, successors, tops, lateral, comfort, speeds):
    """Write to `speeds` the top speed at each point, at most `tops` of its lane.

    It is limited by lateral acceleration, and by comfortable braking for slower points ahead.
    """
    lanes = offsets.shape[0] - 1
    for lane in range(lanes):
        first, last = offsets[lane], offsets[lane + 1] - 1
        for p in range(first, last + 1):
            b = min(max(p, first + 2), last - 2)
            a, c = b - 2, b + 2
            if last - first < 4:
                a, b, c = first, (first + last) // 2, last
            ux, uy = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
            vx, vy = points[c, 0] - points[b, 0], points[c, 1] - points[b, 1]
            turn = abs(math.atan2(ux * vy - uy * vx, ux * vx + uy * vy)) if a < b else 0.0
            length = 0.5 * (math.hypot(ux, uy) + math.hypot(vx, vy))
            bend = math.sqrt(lateral * length / max(turn, 1e-6)) if length > 1e-6 else tops[lane]
            speeds[p] = min(tops[lane], bend)
    for _ in range(4):  # repeated, so that a bend also limits the lanes before it
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
def _ease(offsets, steps, successors, slope, room):
    """Limit the slope of `room` (m per m of lane), also from lane to lane."""
    lanes = offsets.shape[0] - 1
    for _ in range(4):
        for lane in range(lanes):
            first, last = offsets[lane], offsets[lane + 1] - 1
            for k in range(successors.shape[1]):
                if successors[lane, k] >= 0:
                    onward = offsets[successors[lane, k]]
                    room[last] = min(room[last], room[onward] + slope * steps[lane])
            for p in range(last - 1, first - 1, -1):
                room[p] = min(room[p], room[p + 1] + slope * steps[lane])
            for p in range(first + 1, last + 1):
                room[p] = min(room[p], room[p - 1] + slope * steps[lane])
            for k in range(successors.shape[1]):
                if successors[lane, k] >= 0:
                    onward = offsets[successors[lane, k]]
                    room[onward] = min(room[onward], room[last] + slope * steps[lane])


@njit
def _room_at_side(points, offsets, road, hand, length, width, verge, most, room):
    """Write to `room` how far (m) a car at each point can move towards the edge on its side of the road.

    This is found by bisection, and is `most` at most.
    """
    for lane in range(offsets.shape[0] - 1):
        first, last = offsets[lane], offsets[lane + 1] - 1
        for p in range(first, last + 1):
            a, b = max(p - 1, first), min(p + 1, last)
            fx, fy = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
            norm = np.hypot(fx, fy)
            fx, fy = fx / norm, fy / norm
            ux, uy = (fy, -fx) if hand > ZERO else (-fy, fx)
            low, high, tried = F(0.0), most, most
            for _ in range(7):
                x, y = points[p, 0] + tried * ux, points[p, 1] + tried * uy
                gap = clearance(road, x, y) - HALF * width
                x, y = x + HALF * width * ux, y + HALF * width * uy
                for share in _ALONG_SIDE:
                    along = share * length * HALF
                    gap = min(gap, clearance(road, x + along * fx, y + along * fy))
                if gap >= verge:
                    low = tried
                else:
                    high = tried
                tried = HALF * (low + high)
            room[p] = low


@njit
def _clear_points(points, offsets, steps, crossing_offsets, crossings, width, height, apart, clear):
    """Write to `clear` the way (m) along the crossing lane to its last point within `apart` m of this lane.

    If there is no such point, it is negative.
    """
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


def make_network(lanes: Network, road: Road, config: SimConfig, paces: np.ndarray | None = None) -> Network:
    """Lanes with `speeds`, `clear` and `room`, which traffic needs, computed for a road.

    `paces` float32 [lanes]: traffic's speed (m/s) on straights; None: the same on all lanes, from the speed interval.
    """
    traffic = config.traffic
    points, offsets, steps, successors = lanes.points, lanes.offsets, lanes.steps, lanes.successors
    speeds, room = np.empty((2, len(points)), dtype=np.float32)
    clear = np.empty(len(lanes.crossings), dtype=np.float32)
    if paces is None:
        paces = np.full(len(steps), F(TRAFFIC_PACE) * (road.speed_low + road.speed_high))
    _speed_profile(points, offsets, steps, successors, paces, F(traffic.lateral), F(traffic.comfort), speeds)
    crossing = lanes.crossing_offsets, lanes.crossings
    apart = F(config.vehicle.width + traffic.beside)
    _clear_points(points, offsets, steps, *crossing, road.width, road.height, apart, clear)
    beside = np.maximum(lanes.left, lanes.right) >= 0  # cars with a lane beside theirs do not move over
    limits = config.vehicle.length, config.vehicle.width, traffic.verge, traffic.give_way
    _room_at_side(points, offsets, road, lanes.hand, *map(F, limits), room)
    room[np.repeat(beside, np.diff(offsets))] = 0.0
    _ease(offsets, steps, successors, F(traffic.taper), room)
    return lanes._replace(speeds=freeze(speeds), clear=freeze(clear), room=freeze(room))


def junctions(network: Network) -> int:
    """The number of junctions: sets of lanes that conflict, directly or through others of the set."""
    lanes = np.repeat(np.arange(len(network.steps)), np.diff(network.crossing_offsets))
    pairs = np.ones(len(lanes), dtype=np.bool_), (lanes, network.crossings)
    count, label = connected_components(coo_matrix(pairs, shape=(len(network.steps),) * 2), directed=False)
    return int((np.bincount(label, minlength=count) > 1).sum())


@leaf
def wrapped(difference, side):
    """Wrap the difference of two coordinates in [0, side) (m) to [-side / 2, side / 2]."""
    half = HALF * side
    if difference > half:
        return difference - side
    if difference < -half:
        return difference + side
    return difference


@leaf
def torus_distance(difference, side):
    """Shortest distance (m) on the torus, for the difference of two coordinates in [0, side)."""
    size = abs(difference)
    return min(size, side - size)


@leaf
def wrapped_any(difference, side):
    """As `wrapped`, for any difference; needed for points of lanes, which may lie outside [0, side)."""
    # NumPy's floor, because that of `math` returns int64, whose product with float32 is float64.
    return difference - np.floor(difference / side + HALF) * side


@leaf
def lane_length(network, lane):
    """Length (m) of a lane."""
    lane = U(lane)  # unsigned, here and elsewhere: Numba checks whether signed indices are negative
    return F(network.offsets[lane + U(1)] - network.offsets[lane] - 1) * network.steps[lane]


@leaf
def successor(network, lane, number):
    """The successor of a lane that a uniform random number in [0, 1) chooses."""
    count = 0
    for k in range(network.successors.shape[1]):
        if network.successors[lane, k] >= 0:
            count += 1
    return network.successors[lane, min(I(number * F(count)), I(count - 1))]


@leaf
def to_side(network, shift):
    """Convert a shift (m) to the left into one away from traffic's side of the road: -shift in left-hand traffic.

    The same call converts it back.
    """
    return shift if network.hand > ZERO else -shift


@leaf
def is_junction(network, lane):
    """Whether a lane is inside a junction, that is, whether other lanes conflict with it."""
    lane = U(lane)
    return network.crossing_offsets[lane + U(1)] > network.crossing_offsets[lane]
