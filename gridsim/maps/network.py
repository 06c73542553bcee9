"""The lane network of a map as the kernels read it: tables made once a map, and where places on the torus lie."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gridsim.config import TrafficConfig
from gridsim.jit import leaf, njit
from gridsim.maps.roads import Lanes, freeze

_F, _N = np.float32, np.uint64
_HALF, _NEXT = _F(0.5), _N(1)
_ROUNDED = 1e-3  # m, which is more than float32 rounds a box's sides by


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
    room: np.ndarray  # float32 [n], m that a car there can move over to the right for who comes the other way
    boxes: np.ndarray  # float32 [lanes, 4], m: middle x, y of the box around each lane's points and half its sides
    width: np.float32  # m, of the torus
    height: np.float32


@njit
def _speed_profile(points, offsets, steps, successors, top, lateral, comfort, speeds):
    """Greatest speed at each point: by lateral acceleration, and so that braking for what comes is comfortable."""
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
def _ease(offsets, steps, successors, slope, room):
    """Let the room on the right end and begin gently, so many m a m of way, over lanes' ends as well."""
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


def _boxes(points: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """The boxes around lanes: float32 [lanes, 4]."""
    if len(offsets) < 2:
        return freeze(np.zeros((0, 4), dtype=np.float32))
    low, high = (ufunc.reduceat(points.astype(np.float64), offsets[:-1]) for ufunc in (np.minimum, np.maximum))
    return freeze(np.concatenate([(low + high) / 2, (high - low) / 2 + _ROUNDED], axis=1).astype(np.float32))


def make_network(
    lanes: Lanes,
    width: float,
    height: float,
    speed_limit: float,
    config: TrafficConfig,
    clearances: np.ndarray | None = None,
) -> Network:
    """Tables of a map's lanes; `speed_limit` (m/s) is the scenario's own.

    Args: clearances float32 [points], m from each point of the lanes to the road's edge; without, nobody keeps right.
    """
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
    room = np.zeros(len(lanes.points), dtype=np.float32)
    if clearances is not None and len(lanes):
        beside = np.maximum(lanes.left, lanes.right) >= 0  # where a lane is beside, that is where one moves over to
        room = np.clip(clearances - f(config.kerb), 0.0, config.give_way).astype(np.float32)
        room[np.repeat(beside, np.diff(lanes.offsets))] = 0.0
        _ease(offsets, steps, successors, f(config.taper), room)
    return network_of_lanes(lanes, freeze(speeds), freeze(clear), freeze(room), width, height)


def network_of_lanes(
    lanes: Lanes, speeds: np.ndarray, clear: np.ndarray, room: np.ndarray, width: float, height: float
) -> Network:
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
        room=room,
        boxes=_boxes(lanes.points, lanes.offsets),
        width=np.float32(width),
        height=np.float32(height),
    )


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
def torus_distance(difference, side):
    """How far that is, either way."""
    size = abs(difference)
    return min(size, side - size)


@leaf
def wrapped_any(difference, side):
    """The same for any difference: lanes' points are not wrapped."""
    # NumPy's floor is a float32; that of `math` is an int64, whose product with a float32 is a float64.
    return difference - np.floor(difference / side + _HALF) * side


@leaf
def lane_length(network, lane):
    """Length (m) of a lane."""
    lane = _N(lane)  # unsigned, here and elsewhere: a signed index might count from the end, which would be looked up
    return _F(network.offsets[lane + _NEXT] - network.offsets[lane] - 1) * network.steps[lane]


@leaf
def is_junction(network, lane):
    """Whether a lane is a junction's: others cross it."""
    lane = _N(lane)
    return network.crossing_offsets[lane + _NEXT] > network.crossing_offsets[lane]
