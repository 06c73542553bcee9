"""How traffic reacts to an oncoming or crossing ego car: keep to the right, predict collisions and stop.

Where traffic drives on the left (`Network.hand`), cars keep to the left instead.
"""

from __future__ import annotations

import math

from gridsim import state as s
from gridsim.car.kinematic import move, path_curvature
from gridsim.collision import boxes_touch
from gridsim.config import EMERGENCY_BRAKING, FORESIGHT, FORESIGHT_STEP, MEETING_DISTANCE, SAME_WAY_COSINE
from gridsim.jit import ONE, ZERO, F, I, U, leaf, njit
from gridsim.maps.network import lane_length, to_side, wrapped, wrapped_any
from gridsim.traffic.world import lane_after


@leaf
def meets_ego(network, drivers, car, ego):
    """Whether a car keeps right for the ego car, which must be near, at most a length behind, and oncoming or crossing.

    A car that has already moved to the right stays there, however the ego car turns, until that has passed or is far.
    """
    if car[s.COS] * ego[s.COS] + car[s.SIN] * ego[s.SIN] > SAME_WAY_COSINE and to_side(network, car[s.SHIFT]) >= ZERO:
        return False  # they go the same way
    dx, dy = wrapped(ego[s.X] - car[s.X], network.width), wrapped(ego[s.Y] - car[s.Y], network.height)
    behind = F(-2.0) * drivers.half_length
    return dx * dx + dy * dy < MEETING_DISTANCE * MEETING_DISTANCE and dx * car[s.COS] + dy * car[s.SIN] > behind


@leaf
def touches_ego(network, drivers, car, ego):
    """Whether a car touches the ego car."""
    dx, dy = wrapped(ego[s.X] - car[s.X], network.width), wrapped(ego[s.Y] - car[s.Y], network.height)
    return boxes_touch(drivers, dx, dy, car[s.COS], car[s.SIN], ego[s.COS], ego[s.SIN])


@leaf
def shifted_right(network, k, other, right):
    """Point k of a lane, shifted `right` m to the right; other is the point before or after it."""
    one, two = max(k, other), min(k, other)
    x, y = network.points[k, 0], network.points[k, 1]
    ux, uy = network.points[one, 0] - network.points[two, 0], network.points[one, 1] - network.points[two, 1]
    by = right / max(math.sqrt(ux * ux + uy * uy), F(1e-6))
    return x + by * uy, y - by * ux


@njit(_nrt=False)
def way_to_ego_collision(network, drivers, car, ego):
    """Distance (m) from a car's middle along its path to its predicted collision with the ego car; 1e9: drive on.

    Both are predicted at constant speed: the car along its lanes, keeping to the right, the ego car on its current arc.
    The car drives on if they do not touch within FORESIGHT or on the lanes that it is known to take, or if the ego car
    would hit the car's rear half and the car can no longer stop in time.
    Not inlined: calls, with all the network's arguments, are expensive but rare.
    """
    lane = I(car[s.LANE])
    length, begin = lane_length(network, lane), -car[s.ALONG]  # length of the lane, distance to its beginning (m)
    contact = F(2.0) * math.sqrt(drivers.half_length * drivers.half_length + drivers.half_width * drivers.half_width)
    x, y, cosine, sine, speed = ego[s.X], ego[s.Y], ego[s.COS], ego[s.SIN], ego[s.SPEED]
    curvature = path_curvature(drivers.ego, speed, ego[s.STEERING])
    dx, dy = wrapped(x - car[s.X], network.width), wrapped(y - car[s.Y], network.height)
    t = ZERO
    while True:
        # s until the two can touch at the earliest, but at least FORESIGHT_STEP.
        hop = max((math.sqrt(dx * dx + dy * dy) - contact) / (car[s.SPEED] + abs(speed)), FORESIGHT_STEP)
        t += hop
        if t > FORESIGHT:
            return F(1e9)
        way = car[s.SPEED] * t
        while way - begin >= length:
            begin += length
            lane = lane_after(car, lane)
            if lane < 0:
                return F(1e9)
            length = lane_length(network, lane)
        k = U(network.offsets[U(lane)]) + U(I((way - begin) / network.steps[U(lane)]))
        k = min(k, U(network.offsets[U(lane) + U(1)]) - U(2))
        aside = min(network.room[k], drivers.lane_change_speed * t - to_side(network, car[s.SHIFT]))
        px, py = shifted_right(network, k, k + U(1), to_side(network, aside))
        x, y, cosine, sine, speed, _ = move(None, drivers.ego, ego, curvature, x, y, cosine, sine, speed, ZERO, hop)
        dx, dy = wrapped_any(x - px, network.width), wrapped_any(y - py, network.height)
        if dx * dx + dy * dy > contact * contact:
            continue
        ux, uy = network.points[k + U(1), 0], network.points[k + U(1), 1]
        ux, uy = ux - network.points[k, 0], uy - network.points[k, 1]
        norm = ONE / math.sqrt(max(ux * ux + uy * uy, F(1e-12)))
        ux, uy = ux * norm, uy * norm
        if boxes_touch(drivers, dx, dy, ux, uy, cosine, sine):
            ahead = dx * ux + dy * uy
            at = way + ahead - drivers.half_width
            stops = at - drivers.half_length > car[s.SPEED] * car[s.SPEED] / (F(2.0) * EMERGENCY_BRAKING)
            return max(at, ZERO) if ahead >= ZERO or stops else F(1e9)
