"""Right of way at junctions. A car needs a permit to enter a junction lane; it gets one when no other car conflicts.

There must also be room beyond the junction, and its light, if any, must be green. The ego car has the right of way.
"""

from __future__ import annotations

import math

from gridsim import config
from gridsim import state as s
from gridsim.jit import HALF, ZERO, F, I, U, leaf
from gridsim.maps.lights import GO, light
from gridsim.maps.network import ALWAYS, MOVING, is_junction, lane_length, wrapped, wrapped_any


@leaf
def _blocked_by_waiting_car(network, drivers, lane, other):
    """Whether the rear of a car that waits at the end of lane `other` blocks `lane`, which begins at the same point."""
    step = network.steps[other]
    q = network.offsets[other + 1] - 1 - I((F(2.0) * drivers.half_length + drivers.jam) / step)
    q = max(q, network.offsets[other])
    reach = F(2.0) * drivers.half_width + F(2.0) * config.CAUTION
    for p in range(network.offsets[lane], network.offsets[lane + 1]):
        dx = wrapped_any(network.points[p, 0] - network.points[q, 0], network.width)
        dy = wrapped_any(network.points[p, 1] - network.points[q, 1], network.height)
        if dx * dx + dy * dy < reach * reach:
            return True
    return False


@leaf
def _way_to_point(network, lane, x, y, within):
    """Way (m) along a lane to its first point within `within` m of (x, y); 1e9 if there is none."""
    first, k = network.offsets[lane], network.offsets[lane]
    while k < network.offsets[lane + 1]:
        dx = wrapped_any(network.points[k, 0] - x, network.width)
        dy = wrapped_any(network.points[k, 1] - y, network.height)
        apart = math.sqrt(dx * dx + dy * dy)
        if apart < within:
            return F(k - first) * network.steps[lane]
        k += max(I((apart - within) / network.steps[lane]), I(1))
    return F(1e9)


@leaf
def _in_ego_path(network, lane, ego, way):
    """Whether a point of a lane, less than `way` m from the ego car, is in the sector ahead or within EGO_CLEARANCE."""
    for p in range(network.offsets[lane], network.offsets[lane + 1], 2):
        dx = wrapped_any(network.points[p, 0] - ego[s.X], network.width)
        dy = wrapped_any(network.points[p, 1] - ego[s.Y], network.height)
        squared = dx * dx + dy * dy
        if squared < way * way:
            forward = dx * ego[s.COS] + dy * ego[s.SIN]
            if squared < config.EGO_CLEARANCE * config.EGO_CLEARANCE or (
                forward > ZERO and forward * forward > config.EGO_SECTOR_COSINE * config.EGO_SECTOR_COSINE * squared
            ):
                return True
    return False


@leaf
def _must_yield(network, drivers, car, other, first, last, seconds):
    """Whether `car` must give way to `other`, as that is about to enter a lane with priority over `car`'s next lane.

    Args: `first` to `last`, the range of `car`'s next lane in `Network.crossings`; `seconds` on the lights' clock.
    """
    onward, speed = I(other[s.NEXT]), other[s.SPEED]
    if not is_junction(network, onward):
        return False
    if network.signals[U(onward)] >= 0 and light(network, network.signals[U(onward)], seconds) != GO:
        return False
    way = lane_length(network, I(other[s.LANE])) - other[s.ALONG] - drivers.half_length
    own = max(lane_length(network, I(car[s.LANE])) - car[s.ALONG] - drivers.half_length, ZERO)
    time = config.PRIORITY_TIME + own / max(car[s.SPEED], config.WALKING_PACE)
    stands = speed < config.WALKING_PACE
    if way > (F(2.0) * config.STOP_LINE_GAP if stands else speed * time):
        return False
    for c in range(first, last):
        if network.crossings[c] == onward:
            return network.yields[c] == ALWAYS or (network.yields[c] == MOVING and not stands)
    return False


@leaf
def _has_no_room(drivers, world, car):
    """Whether a car waits before a junction because another one stands where it would leave the junction."""
    place = F(3.0) * drivers.half_length + drivers.jam
    for k in range(world.shape[0] if car[s.SPEED] < config.WALKING_PACE else 0):
        stands = world[k, s.SPEED] < config.WALKING_PACE
        if stands and world[k, s.LANE] == car[s.SECOND_NEXT] and world[k, s.ALONG] < place:
            return True
    return False


@leaf
def may_enter(network, drivers, world, i, ego, ego_way, seconds):
    """Whether car i may enter its next lane, in a junction: no car conflicts, and there is room beyond.

    The ego car has the right of way on the ground ahead of it, but not beyond `ego_way` m, where a red light stops it.
    `seconds` is the time on the lights' clock.
    """
    car = world[i]
    here, lane, beyond = I(car[s.LANE]), I(car[s.NEXT]), I(car[s.SECOND_NEXT])
    first, last = network.crossing_offsets[lane], network.crossing_offsets[lane + 1]
    # Enter only if there is room beyond the junction: otherwise, junctions block each other. If the lane beyond is in a
    # junction, too, room for one car is enough.
    chained = is_junction(network, beyond)
    place = F(2.0) * drivers.half_length + drivers.jam
    room, needed = max(lane_length(network, beyond), place), place
    for j in range(world.shape[0]):
        if j == i or world[j, s.LANE] < ZERO:
            continue
        there, past, permit = I(world[j, s.LANE]), I(world[j, s.JUNCTION_BEHIND]), I(world[j, s.PERMIT])
        onward = I(world[j, s.NEXT])
        goes_first = network.yields.shape[0] > 0 and _must_yield(network, drivers, car, world[j], first, last, seconds)
        if goes_first and not _has_no_room(drivers, world, world[j]):
            return False
        behind = there == here and world[j, s.ALONG] < car[s.ALONG]  # no obstacle, even if the way crosses itself
        # Most cars are not near a junction and need no check.
        for c in range(first, last if permit >= 0 or past >= 0 or is_junction(network, there) else first):
            other = network.crossings[c]
            if permit == other:
                return False
            rear = world[j, s.ALONG] - drivers.half_length
            if there == other and not behind and rear < network.clear[c] + config.JUNCTION_MARGIN:
                return False
            if past == other and lane_length(network, other) + world[j, s.ALONG] - drivers.half_length < (
                network.clear[c] + config.JUNCTION_MARGIN
            ):
                return False
        waits = I(-1)  # lane of this junction at whose end the other car may have to wait
        if there == here and world[j, s.ALONG] > car[s.ALONG]:
            if permit != onward:
                return False  # the leader has no permit yet; granting one here could deadlock
            if is_junction(network, I(world[j, s.SECOND_NEXT])):
                waits = permit
        elif permit != onward and is_junction(network, there) and is_junction(network, onward):
            for k in range(network.successors.shape[1]):
                if there == network.successors[here, k]:
                    waits = there
        if waits >= 0 and waits != lane and _blocked_by_waiting_car(network, drivers, lane, waits):
            return False
        if chained:
            if there == lane or permit == lane:
                return False
            for k in range(network.successors.shape[1]):
                slow = there == network.successors[lane, k] and world[j, s.SPEED] < config.WALKING_PACE
                if slow and world[j, s.ALONG] < place + drivers.half_length:
                    return False
        elif there == beyond:
            rear = world[j, s.ALONG] - drivers.half_length
            room = min(room, rear + world[j, s.SPEED] * world[j, s.SPEED] / (F(2.0) * drivers.comfort))
        elif (permit >= 0 and I(world[j, s.SECOND_NEXT]) == beyond) or (
            onward == beyond and is_junction(network, there)
        ):
            needed += place
    # The ego car goes first, unless it is behind this car. Nobody knows which way it will turn, so all the ground ahead
    # of it is kept free. A car that is already in a junction, as in a roundabout, does not wait for that: it only needs
    # room beyond.
    dx, dy = ego[s.X] - car[s.X], ego[s.Y] - car[s.Y]
    dx, dy = wrapped(dx, network.width), wrapped(dy, network.height)
    forward, aside = dx * car[s.COS] + dy * car[s.SIN], dy * car[s.COS] - dx * car[s.SIN]
    same_way = ego[s.COS] * car[s.COS] + ego[s.SIN] * car[s.SIN] > HALF
    way = min(config.EGO_CLEARANCE + config.CROSSING_TIME * max(ego[s.SPEED], ZERO), ego_way)
    far = car[s.HORIZON] + lane_length(network, lane) + way + F(2.0) * place
    if dx * dx + dy * dy < far * far and not (forward < ZERO and (same_way or abs(aside) < config.EGO_BEHIND)):
        if not is_junction(network, here) and _in_ego_path(network, lane, ego, way):
            return False
        within = drivers.half_width + config.EGO_INSIDE
        rear = _way_to_point(network, beyond, ego[s.X], ego[s.Y], within) - drivers.half_length
        room = min(room, rear + ego[s.SPEED] * ego[s.SPEED] / (F(2.0) * drivers.comfort))
    return room >= needed
