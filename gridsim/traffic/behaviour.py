"""Traffic: cars that follow lanes, keep their distance, give way where paths cross, and change to lanes beside theirs.

Car following is the intelligent driver model (IDM; Treiber, Hennecke and Helbing 2000), and lane changes are MOBIL
(Kesting, Treiber and Helbing 2007). The ego car is an obstacle like the other cars, but has the right of way at
junctions (`junctions.py`), and oncoming and crossing cars move to their side of the road for it (`encounters.py`).
`gridsim/state.py` defines a car's state, `maps/network.py` the lanes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gridsim import config
from gridsim import state as s
from gridsim.config import Constants, SimConfig, constants
from gridsim.jit import HALF, ONE, ZERO, F, I, U, leaf, njit
from gridsim.maps.lights import GO, NO_LINE, STOP, light, way_to_line
from gridsim.maps.network import is_junction, lane_length, to_side, torus_distance, wrapped, wrapped_any
from gridsim.traffic.encounters import meets_ego, shifted_right, touches_ego, way_to_ego_collision
from gridsim.traffic.junctions import may_enter
from gridsim.traffic.world import choose_lane, lane_after, lane_change_steps, point_at, set_pose


class Drivers(NamedTuple):
    """What kernels read of how traffic drives: fields of `TrafficConfig` by their names, then further numbers."""

    acceleration: np.float32  # m/s2
    comfort: np.float32  # m/s2, comfortable deceleration
    braking: np.float32  # m/s2, greatest deceleration
    headway: np.float32  # s
    jam: np.float32  # m
    politeness: np.float32
    threshold: np.float32  # m/s2
    safe_braking: np.float32  # m/s2
    lateral: np.float32  # m/s2
    give_way: np.float32  # m
    lane_change_speed: np.float32  # m/s
    half_length: np.float32  # m
    half_width: np.float32  # m
    dt: np.float32  # s, control period
    lane_change_steps: np.float32  # control steps between two decisions whether to change lanes
    ego: Constants  # of the ego car, to predict its motion


def drivers(sim: SimConfig) -> Drivers:
    """The parameters of traffic in a configuration, as kernels read them."""
    traffic = {name: np.float32(value) for name, value in vars(sim.traffic).items() if name in Drivers._fields}
    k, steps = constants(sim), F(lane_change_steps(sim))
    return Drivers(
        **traffic, half_length=k.half_length, half_width=k.half_width, dt=k.dt, lane_change_steps=steps, ego=k
    )


@leaf
def idm(drivers, speed, desired, gap, leader):
    """Acceleration (m/s2) of the intelligent driver model: Treiber et al. 2000, equations 2 and 3.

    It is -`Drivers.braking` at least.
    Args: own `speed` and `desired` speed, m/s; `gap` to the leader's rear, m, or 1e9 without a leader; `leader`, the
    leader's speed, m/s.
    """
    ratio = speed / max(desired, F(0.1))
    free = ratio * ratio
    free *= free
    wanted = drivers.jam + max(
        ZERO,
        speed * drivers.headway
        + speed * (speed - leader) / (F(2.0) * math.sqrt(drivers.acceleration * drivers.comfort)),
    )
    near = wanted / max(gap, F(0.01))
    return max(drivers.acceleration * (ONE - free - near * near), -drivers.braking)


@leaf
def _ahead(network, car, other):
    """Distance (m) along the lanes from a car to another ahead on its lane or its next two lanes; else 1e9."""
    lane, along = other[s.LANE], other[s.ALONG]
    if lane == car[s.LANE] and along > car[s.ALONG]:
        return along - car[s.ALONG]
    if lane == car[s.NEXT]:
        return lane_length(network, I(car[s.LANE])) - car[s.ALONG] + along
    if lane == car[s.SECOND_NEXT]:
        return lane_length(network, I(car[s.LANE])) - car[s.ALONG] + lane_length(network, I(car[s.NEXT])) + along
    return F(1e9)


@leaf
def _swerve(drivers, speed, shift, sway, place, way):
    """Shift and sway of a car that has moved from `shift` towards `place` (m left of its lane) while driving `way` m.

    Sway is m to the left per m driven. The path bends no harder than SWERVE_RADIUS and the lateral acceleration of
    traffic in bends allow.
    """
    bend = min(ONE / config.SWERVE_RADIUS, drivers.lateral / max(speed * speed, ONE))
    steepest = min(config.STEEPEST_SWERVE, drivers.lane_change_speed / max(speed, ONE))
    left = place - shift
    # From this slope, a path with half the greatest curvature is parallel to the lane when it reaches `place`.
    wanted = math.copysign(min(math.sqrt(bend * abs(left)), steepest), left)
    after = min(max(wanted, sway - bend * way), sway + bend * way)
    moved = HALF * (sway + after) * way
    if abs(left - moved) < F(0.01) or (moved * left > ZERO and abs(moved) > abs(left)):
        return place, ZERO
    return shift + moved, after


@leaf
def _in_the_way(network, drivers, car, x, y, cosine, sine, horizon, furthest):
    """Distance (m) from a car's middle along its path to where another car, at (x, y), blocks it; 1e9 if it does not.

    Tests points of the path from the car's front to `horizon` m from its middle. The path swerves from the car's SHIFT
    to `furthest` m towards its side of the road, but at most to what `Network.room` allows. `room` is 0 on roads with
    several lanes: there the path returns to its lane.
    """
    shift, sway = car[s.SHIFT], car[s.SWAY]
    aside_by = furthest > ZERO or shift != ZERO
    swerved = ZERO  # distance (m) at which shift and sway were last updated
    half_length = drivers.half_length + drivers.half_width + config.CAUTION
    half_width = drivers.half_width + drivers.half_width + config.CAUTION
    lane = I(car[s.LANE])
    travelled = drivers.half_length
    along = car[s.ALONG] + travelled
    beside = max(abs(shift), min(furthest, drivers.give_way))  # the path's distance from the lane, at most
    reach_x = abs(cosine) * half_length + abs(sine) * half_width + beside
    reach_y = abs(sine) * half_length + abs(cosine) * half_width + beside
    while lane >= 0 and travelled <= horizon:
        length = lane_length(network, lane)
        box = network.boxes[U(lane)]
        beside_x = abs(wrapped_any(box[0] - x, network.width)) - box[2]
        beside_y = abs(wrapped_any(box[1] - y, network.height)) - box[3]
        if beside_x > reach_x or beside_y > reach_y:  # the lane's bounding box is out of reach
            travelled += max(length - along, ZERO)
            along = max(along, length)
        else:
            first, step = U(network.offsets[U(lane)]), network.steps[U(lane)]
            while along <= length:
                if travelled > horizon:
                    return F(1e9)
                k = first + U(I(along / step))
                px, py = network.points[k, 0], network.points[k, 1]
                if aside_by:
                    place = to_side(network, -min(network.room[k], furthest))
                    shift, sway = _swerve(drivers, car[s.SPEED], shift, sway, place, travelled - swerved)
                    swerved = travelled
                    px, py = shifted_right(network, k, k + U(1) if along + step <= length else k - U(1), -shift)
                dx, dy = wrapped_any(px - x, network.width), wrapped_any(py - y, network.height)
                forward, aside = dx * cosine + dy * sine, dy * cosine - dx * sine
                free = max(abs(forward) - half_length, abs(aside) - half_width)
                if free < ZERO:
                    return travelled
                hop = max(free, drivers.half_width + config.CAUTION)  # the path is free for at least `free` m
                along += hop
                travelled += hop
        along -= length
        lane = lane_after(car, lane)
    return F(1e9)


@leaf
def update_gap(network, drivers, car, other, is_ego):
    """Update a car's GAP and LEAD_SPEED if another car within its horizon is the nearest obstacle so far."""
    along = max((car[s.COS] * other[s.COS] + car[s.SIN] * other[s.SIN]) * other[s.SPEED], ZERO)
    at = F(1e9)
    dx, dy = wrapped(other[s.X] - car[s.X], network.width), wrapped(other[s.Y] - car[s.Y], network.height)
    forward = dx * car[s.COS] + dy * car[s.SIN]
    done = forward < F(-3.0) * drivers.half_length  # a car farther behind is no obstacle
    if not is_ego:
        lane = U(I(other[s.LANE]))
        at = _ahead(network, car, other) - drivers.half_length
        # On a road with several lanes, a car in another lane is no obstacle either, if neither changes lanes.
        keep = other[s.SHIFT] == ZERO and car[s.SHIFT] == ZERO
        done = done or at < F(1e8) or (keep and max(network.left[lane], network.right[lane]) >= 0)
    aside = max(-to_side(network, car[s.SHIFT]), ZERO)
    if not done:
        near = min(car[s.HORIZON], car[s.GAP])  # only obstacles nearer than the nearest so far matter
        furthest = F(1e9) if is_ego and meets_ego(network, drivers, car, other) else aside
        at = _in_the_way(network, drivers, car, other[s.X], other[s.Y], other[s.COS], other[s.SIN], near, furthest)
    if at < car[s.GAP]:
        car[s.GAP], car[s.LEAD_SPEED] = at, along
    if is_ego and not done and other[s.SPEED] > ONE:
        if car[s.COS] * other[s.COS] + car[s.SIN] * other[s.SIN] <= HALF:
            at = way_to_ego_collision(network, drivers, car, other)
        elif forward > ZERO:
            # The ego car's position in a second, as it may be about to cut in.
            x, y = other[s.X] + other[s.SPEED] * other[s.COS], other[s.Y] + other[s.SPEED] * other[s.SIN]
            near = min(car[s.HORIZON], car[s.GAP])
            at = _in_the_way(network, drivers, car, x, y, other[s.COS], other[s.SIN], near, aside)
        if at < car[s.GAP]:
            car[s.GAP], car[s.LEAD_SPEED] = at, along


@leaf
def _find_gaps(network, drivers, world, ego):
    """Set each car's HORIZON, and GAP and LEAD_SPEED of the nearest obstacle within it (1e9 and 0 if there is none)."""
    cars = world.shape[0]
    for i in range(cars):
        speed = world[i, s.SPEED]
        way = speed * (config.LOOK_AHEAD_TIME + speed / (F(2.0) * drivers.comfort))  # to notice something and to stop
        world[i, s.HORIZON] = drivers.jam + config.LOOK_AHEAD + way
        world[i, s.GAP], world[i, s.LEAD_SPEED] = F(1e9), ZERO
    # A gap ends at the rear of the car ahead, widened by CAUTION. That car's middle may lie beyond the horizon.
    beyond = F(2.0) * (drivers.half_length + config.CAUTION)
    for i in range(cars):
        if world[i, s.LANE] < ZERO:
            continue
        x, y, far = world[i, s.X], world[i, s.Y], world[i, s.HORIZON] + beyond
        for j in range(i):
            if world[j, s.LANE] < ZERO:
                continue
            dx, dy = torus_distance(world[j, s.X] - x, network.width), torus_distance(world[j, s.Y] - y, network.height)
            squared, other_far = dx * dx + dy * dy, world[j, s.HORIZON] + beyond
            if squared < far * far:
                update_gap(network, drivers, world[i], world[j], False)
            if squared < other_far * other_far:
                update_gap(network, drivers, world[j], world[i], False)
        dx, dy = torus_distance(ego[s.X] - x, network.width), torus_distance(ego[s.Y] - y, network.height)
        if dx * dx + dy * dy < far * far:
            update_gap(network, drivers, world[i], ego, True)


@leaf
def _desired(network, car):
    """A car's desired speed (m/s) at its place."""
    return car[s.SPEED_FACTOR] * network.speeds[point_at(network, car)]


@leaf
def change_lanes(network, drivers, world, i, ego):
    """When its timer has run out, let car i begin to change to a neighbouring lane if that is safe and a gain.

    It does not while it is still shifted, or near a junction or a lane without neighbours (`config.KEEP_LANE`).
    """
    car = world[i]
    if car[s.LANE_TIMER] > ZERO:
        car[s.LANE_TIMER] -= ONE
        return
    car[s.LANE_TIMER] = drivers.lane_change_steps - ONE
    lane = I(car[s.LANE])
    onward = I(car[s.NEXT])
    ends = is_junction(network, onward) or max(network.left[onward], network.right[onward]) < 0
    near = ends and lane_length(network, lane) - car[s.ALONG] < config.KEEP_LANE
    if car[s.SHIFT] == ZERO and max(network.left[lane], network.right[lane]) >= 0 and not near:
        _choose_neighbour(network, drivers, world, i, ego)


@leaf
def _way_ahead(network, car, lane, along, there, place):
    """Distance (m) forwards from `along` m on `lane` to `place` m on lane `there`; 1e9 if it is too far.

    The way follows the car's own lanes where they are known (`lane_after`), else each lane's first successor, and the
    search ends after LANE_CHANGE_SIGHT.
    """
    begins = -along  # m ahead at which the lane begins
    while lane >= 0 and begins <= config.LANE_CHANGE_SIGHT:
        if lane == there and begins + place >= ZERO:
            return begins + place
        begins += lane_length(network, lane)
        onward = lane_after(car, lane)
        lane = onward if onward >= 0 else I(network.successors[lane, 0])
    return F(1e9)


@leaf
def _way_between(network, car, lane, along, other):
    """Distance (m) from `along` m on a lane to another car, negative if that is behind; 1e9 if it is neither."""
    there, place = I(other[s.LANE]), other[s.ALONG]
    ahead = _way_ahead(network, car, lane, along, there, place)
    behind = _way_ahead(network, other, there, place, lane, along)
    return ahead if ahead <= behind else -behind


@leaf
def _lanes_apart(network, lane, along, target):
    """Distance (m) between a lane, at `along` m, and its neighbour `target`."""
    k = I(along / network.steps[lane])
    one, other = network.offsets[lane] + k, network.offsets[target] + k
    dx = wrapped_any(network.points[other, 0] - network.points[one, 0], network.width)
    dy = wrapped_any(network.points[other, 1] - network.points[one, 1], network.height)
    return math.sqrt(dx * dx + dy * dy)


@leaf
def _skew(network, lane, along, target):
    """How far (m) `target`'s point is ahead of the lane's point with the same index, at `along` m of the lane.

    Negative if it is behind; 0 if it is SKEW or less either way.
    """
    k = I(along / network.steps[lane])
    one, other = network.offsets[lane] + k, network.offsets[target] + k
    first = min(other, network.offsets[target + 1] - 2)
    dx = wrapped_any(network.points[other, 0] - network.points[one, 0], network.width)
    dy = wrapped_any(network.points[other, 1] - network.points[one, 1], network.height)
    tx = network.points[first + 1, 0] - network.points[first, 0]
    ty = network.points[first + 1, 1] - network.points[first, 1]
    skew = (dx * tx + dy * ty) / network.steps[target]
    return skew if abs(skew) > config.SKEW else ZERO


@njit(_nrt=False)
def _choose_neighbour(network, drivers, world, i, ego):
    """Let car i begin to change to the lane that MOBIL prefers, if any (Kesting et al. 2007, equations 1 and 2).

    The car is then assigned to that lane, with a SHIFT to where it is. Not inlined: calls are expensive but rare.
    """
    car = world[i]
    lane = I(car[s.LANE])
    own_length = F(2.0) * drivers.half_length
    desired = _desired(network, car)
    best, gain = I(-1), drivers.threshold
    for side in range(2):
        target = network.left[lane] if (side == 0) == (network.hand > ZERO) else network.right[lane]
        if target < 0 or is_junction(network, target):
            continue  # it would enter a junction lane without a permit
        skew = _skew(network, lane, car[s.ALONG], target)
        along = max(car[s.ALONG] / network.steps[lane] * network.steps[target] - skew, ZERO)
        apart = _lanes_apart(network, lane, car[s.ALONG], target)
        # Distance (m) and speed (m/s) of the nearest cars ahead and behind in the target lane, and of the nearest one
        # behind in car i's lane; for those behind, also the desired speed.
        front, front_speed, rear, rear_speed, rear_desired = F(1e9), ZERO, F(1e9), ZERO, ONE
        left_behind, left_speed, left_desired = F(1e9), ZERO, ONE
        free = True
        for j in range(world.shape[0] + 1):
            if j == i:
                continue
            other = world[j] if j < world.shape[0] else ego
            if j < world.shape[0] and other[s.LANE] < ZERO:
                continue
            dx, dy = other[s.X] - car[s.X], other[s.Y] - car[s.Y]
            dx, dy = wrapped(dx, network.width), wrapped(dy, network.height)
            if dx * dx + dy * dy > config.LANE_CHANGE_SIGHT * config.LANE_CHANGE_SIGHT:
                continue
            if j < world.shape[0]:
                ahead = _way_between(network, car, target, along, other)
                behind = -_way_between(network, car, lane, car[s.ALONG], other)
                changes = ahead > F(1e8) and behind < F(-1e8) and other[s.SHIFT] != ZERO
                if changes and dx * dx + dy * dy < config.LANE_CHANGE_ALONE * config.LANE_CHANGE_ALONE:
                    free = False  # a car on a third lane is changing lanes close by, perhaps from the target lane
                wish = _desired(network, other)
            else:
                forward = dx * car[s.COS] + dy * car[s.SIN]  # the ego car is on no lane
                aside = dy * car[s.COS] - dx * car[s.SIN]
                reach = HALF * apart + drivers.half_width + config.NEIGHBOUR_WIDENING * forward * forward
                sideways = apart if target == network.left[lane] else -apart
                ahead = forward if abs(aside - sideways) <= reach else F(1e9)
                behind = -forward if abs(aside) <= reach else F(-1e9)
                wish = other[s.SPEED]
            if abs(ahead) < own_length + drivers.jam:
                free = False
            if ZERO <= ahead < front:
                front, front_speed = ahead, other[s.SPEED]
            if ahead < ZERO and -ahead < rear:
                rear, rear_speed, rear_desired = -ahead, other[s.SPEED], wish
            if ZERO < behind < left_behind:
                left_behind, left_speed, left_desired = behind, other[s.SPEED], wish
        if not free:
            continue
        there = idm(drivers, car[s.SPEED], desired, front - own_length, front_speed)
        others = ZERO  # m/s2 that the followers gain
        new_follower = ZERO
        if rear < F(1e8):
            new_follower = idm(drivers, rear_speed, rear_desired, rear - own_length, car[s.SPEED])
            others += new_follower - idm(drivers, rear_speed, rear_desired, rear + front - own_length, front_speed)
        if left_behind < F(1e8):
            gap = left_behind - drivers.half_length + car[s.GAP]
            others += idm(drivers, left_speed, left_desired, gap, car[s.LEAD_SPEED])
            others -= idm(drivers, left_speed, left_desired, left_behind - own_length, car[s.SPEED])
        if new_follower < -drivers.safe_braking or there < -drivers.safe_braking:
            continue
        advantage = there - car[s.ACCELERATION] + drivers.politeness * others
        if advantage > gain:
            best, gain = I(target), advantage
    if best >= 0:
        along, onward, beyond = car[s.ALONG], car[s.NEXT], car[s.SECOND_NEXT]
        nearest, lead_speed = car[s.GAP], car[s.LEAD_SPEED]
        apart = _lanes_apart(network, lane, along, best)
        skew = _skew(network, lane, along, best)
        if skew != ZERO:
            apart = math.sqrt(max(apart * apart - skew * skew, ZERO))
        car[s.SHIFT] = -apart if best == network.left[lane] else apart
        car[s.ALONG] = max(along / network.steps[lane] * network.steps[best] - skew, ZERO)
        car[s.LANE], car[s.PERMIT] = F(best), -ONE
        car[s.NEXT] = F(choose_lane(network, best, car))
        car[s.SECOND_NEXT] = F(choose_lane(network, I(car[s.NEXT]), car))
        # While it moves over, it must not touch the car ahead in its old lane: if it might, the change is undone.
        car[s.GAP], car[s.LEAD_SPEED] = F(1e9), ZERO
        for j in range(world.shape[0]):
            if j != i and world[j, s.LANE] >= ZERO:
                update_gap(network, drivers, car, world[j], False)
        update_gap(network, drivers, car, ego, True)
        gap = car[s.GAP] - drivers.half_length
        if idm(drivers, car[s.SPEED], desired, gap, car[s.LEAD_SPEED]) < -drivers.safe_braking:
            car[s.LANE], car[s.ALONG], car[s.SHIFT] = F(lane), along, ZERO
            car[s.NEXT], car[s.SECOND_NEXT] = onward, beyond
            car[s.GAP], car[s.LEAD_SPEED] = nearest, lead_speed


@leaf
def _move(network, drivers, car, ego):
    """Move one car for a control period along its lane, and sideways: aside for the ego car, or back to its lane."""
    before, after = car[s.SPEED], max(car[s.SPEED] + car[s.ACCELERATION] * drivers.dt, ZERO)
    car[s.ALONG] += HALF * (before + after) * drivers.dt
    car[s.SPEED] = after
    place = to_side(network, -network.room[point_at(network, car)]) if meets_ego(network, drivers, car, ego) else ZERO
    shift = car[s.SHIFT]
    if shift != place or car[s.SWAY] != ZERO:
        way = HALF * (before + after) * drivers.dt
        car[s.SHIFT], car[s.SWAY] = _swerve(drivers, after, shift, car[s.SWAY], place, way)
    length = lane_length(network, I(car[s.LANE]))
    if car[s.ALONG] >= length:
        lane = I(car[s.LANE])
        car[s.ALONG] -= length
        car[s.JUNCTION_BEHIND] = car[s.LANE] if is_junction(network, lane) else -ONE
        car[s.LANE], car[s.NEXT] = car[s.NEXT], car[s.SECOND_NEXT]
        car[s.PERMIT] = -ONE
        car[s.SECOND_NEXT] = F(choose_lane(network, I(car[s.NEXT]), car))
    elif car[s.JUNCTION_BEHIND] >= ZERO and car[s.ALONG] > drivers.half_length + ONE:
        car[s.JUNCTION_BEHIND] = -ONE
    set_pose(network, car)
    if car[s.SHIFT] != shift and touches_ego(network, drivers, car, ego):
        car[s.SHIFT], car[s.SWAY] = shift, ZERO  # do not move sideways into the ego car
        set_pose(network, car)


@leaf
def step_traffic(network, drivers, world, ego):
    """Move all cars of a world for one control period. Call it before the ego car moves.

    Args: world [cars, TRAFFIC_FIELDS], changed; ego, the ego car's state: X to STEERING are read, and CLOCK if the
    network has lights.
    """
    cars = world.shape[0]
    _find_gaps(network, drivers, world, ego)
    lit, seconds, ego_way = network.lines.shape[0] > 0, ZERO, NO_LINE
    if lit:
        seconds = ego[s.CLOCK] * drivers.dt
        ego_way = way_to_line(network, seconds, STOP, ego[s.X], ego[s.Y], ego[s.COS], ego[s.SIN])
    for i in range(cars):
        car = world[i]
        if car[s.LANE] < ZERO:
            continue
        lane, onward = I(car[s.LANE]), I(car[s.NEXT])
        desired = _desired(network, car)
        pace = idm(drivers, car[s.SPEED], desired, car[s.GAP] - drivers.half_length, car[s.LEAD_SPEED])
        stops = lit and network.signals[U(onward)] >= 0 and light(network, network.signals[U(onward)], seconds) != GO
        line = lane_length(network, lane) - car[s.ALONG] - drivers.half_length
        can_stop = line > car[s.SPEED] * car[s.SPEED] / (F(2.0) * drivers.comfort)
        if stops and can_stop and car[s.PERMIT] == car[s.NEXT]:
            car[s.PERMIT] = -ONE
        # Stop at the line without a permit for the junction ahead; where there is no junction, at a light that is not
        # green, unless the car can no longer stop comfortably.
        must_stop = car[s.PERMIT] != car[s.NEXT] if is_junction(network, onward) else stops and can_stop
        if must_stop and line < car[s.HORIZON]:
            if not stops and may_enter(network, drivers, world, i, ego, ego_way, seconds):
                car[s.PERMIT] = car[s.NEXT]
            else:
                gap = line + drivers.jam - config.STOP_LINE_GAP
                pace = min(pace, idm(drivers, car[s.SPEED], desired, gap, ZERO))
                waits = is_junction(network, lane) and car[s.SPEED] < config.STANDING and not stops
                car[s.PERMIT] = car[s.PERMIT] - ONE if waits else -ONE
                if -car[s.PERMIT] * drivers.dt > config.GRIDLOCK:
                    car[s.LANE] = -ONE
        car[s.ACCELERATION] = pace
    for i in range(cars):
        if world[i, s.LANE] >= ZERO:
            change_lanes(network, drivers, world, i, ego)
    for i in range(cars):
        if world[i, s.LANE] >= ZERO:
            _move(network, drivers, world[i], ego)
