"""Collisions of a car with the edge of the road and with other cars, and distances between cars."""

from __future__ import annotations

import math

import numpy as np

from gridsim.jit import HALF, ONE, ZERO, F, leaf
from gridsim.maps.network import wrapped
from gridsim.maps.roads import THICK_WALL, clearance
from gridsim.state import COS, LANE, SIN, SPEED, X, Y

# Points on a car's outline that are checked on maps without thin walls (`THICK_WALL`), as shares of the car's half
# length and half width: the car's corners first.
_OUTLINE = np.array(
    [[1, 1], [1, -1], [-1, 1], [-1, -1], [0.5, 1], [0.5, -1], [0, 1], [0, -1], [-0.5, 1], [-0.5, -1], [1, 0], [-1, 0]],
    dtype=np.float32,
)
_OUTLINE.setflags(write=False)
# Least distance (units) between points of the outline that are checked on maps with thin walls. A right-angled corner
# of a wall that reaches into the car by less than half this distance may be missed.
_OUTLINE_STEP = F(0.1)


@leaf
def _outline_leaves_road(road, length, width, x, y, cosine, sine):
    """Whether a rectangle's outline leaves the road; `length` and `width` are half its sides (m).

    The check steps along each side by the clearance, but at least by `_OUTLINE_STEP`. So it also finds a parked car's
    corner that reaches in between two corners of the rectangle.
    """
    for _ in range(4):  # the right side from rear to front, then the others counter-clockwise
        x0, y0 = x - length * cosine + width * sine, y - length * sine - width * cosine
        at = ZERO
        while at < F(2.0) * length:
            free = clearance(road, x0 + at * cosine, y0 + at * sine)
            if free < ZERO:
                return True
            at += max(free, _OUTLINE_STEP * road.unit)
        length, width, cosine, sine = width, length, -sine, cosine
    return False


@leaf
def collides(road, constants, x, y, cosine, sine):
    """Whether a car at this pose is off the road, judged by points of its outline.

    On maps with thin walls, points all along the outline are checked (`_outline_leaves_road`). On others, no wall has
    corners as sharp as a parked car's: twelve points are enough (`_OUTLINE`).
    """
    length, width = constants.half_length, constants.half_width
    # Two circles cover the car, one for each half. If both are clear of the edge, the outline need not be checked.
    half = HALF * length
    radius = math.sqrt(half * half + width * width)
    front = clearance(road, x + half * cosine, y + half * sine)
    rear = clearance(road, x - half * cosine, y - half * sine)
    if min(front, rear) > radius + F(0.02):
        return False
    if min(front, rear) < ZERO:
        return True
    if road.thinnest < THICK_WALL:
        return _outline_leaves_road(road, length, width, x, y, cosine, sine)
    for k in range(_OUTLINE.shape[0]):
        along, across = _OUTLINE[k, 0] * length, _OUTLINE[k, 1] * width
        if clearance(road, x + along * cosine - across * sine, y + along * sine + across * cosine) < ZERO:
            return True
    return False


@leaf
def separation(constants, dx, dy, cosine, sine, other_cosine, other_sine):
    """Gap (m) between two cars of the same size, whose middles are (dx, dy) m apart; negative if they overlap.

    It is the largest gap along any of their four axes (separating axis theorem, Gottschalk et al. 1996). If two corners
    are closest, the cars are farther apart than that.
    """
    length, breadth = constants.half_length, constants.half_width
    along = abs(cosine * other_cosine + sine * other_sine)
    across = abs(cosine * other_sine - sine * other_cosine)
    long_side = length + length * along + breadth * across
    short_side = breadth + length * across + breadth * along
    lengthwise = max(abs(dx * cosine + dy * sine), abs(dx * other_cosine + dy * other_sine)) - long_side
    return max(lengthwise, max(abs(dy * cosine - dx * sine), abs(dy * other_cosine - dx * other_sine)) - short_side)


@leaf
def boxes_touch(constants, dx, dy, cosine, sine, other_cosine, other_sine):
    """Whether two cars overlap or touch; args as in `separation`."""
    return separation(constants, dx, dy, cosine, sine, other_cosine, other_sine) <= ZERO


@leaf
def top_speed_near(world, reach, width, height, x, y):
    """Speed (m/s) of the fastest of a world's cars whose middles are within `reach` m of a point; -1 if none is."""
    fastest = -ONE
    for j in range(world.shape[0]):
        if world[j, LANE] >= ZERO:
            dx, dy = wrapped(world[j, X] - x, width), wrapped(world[j, Y] - y, height)
            if dx * dx + dy * dy < reach * reach:
                fastest = max(fastest, abs(world[j, SPEED]))
    return fastest


@leaf
def hits_box(constants, world, back, dt, width, height, x, y, cosine, sine):
    """Whether a car at this pose touches one of a world's cars, each moved back by `back` (0 to 1) control periods."""
    for j in range(world.shape[0]):
        if world[j, LANE] >= ZERO:
            behind = back * dt * world[j, SPEED]
            dx = wrapped(world[j, X] - behind * world[j, COS] - x, width)
            dy = wrapped(world[j, Y] - behind * world[j, SIN] - y, height)
            if dx * dx + dy * dy < constants.contact * constants.contact and boxes_touch(
                constants, dx, dy, cosine, sine, world[j, COS], world[j, SIN]
            ):
                return True
    return False


@leaf
def stands_ahead(constants, world, width, height, x, y, cosine, sine):
    """Whether a standing car of a world is in front of a car at this pose.

    It counts if it is slower than 0.5 m/s and straight ahead, with a gap of less than `courtesy` m.
    """
    for j in range(world.shape[0]):
        if world[j, LANE] >= ZERO and world[j, SPEED] < HALF:
            dx, dy = wrapped(world[j, X] - x, width), wrapped(world[j, Y] - y, height)
            forward, aside = dx * cosine + dy * sine, dy * cosine - dx * sine
            limit = constants.courtesy + F(2.0) * constants.half_length
            if ZERO < forward < limit and abs(aside) < F(2.0) * constants.half_width:
                return True
    return False
