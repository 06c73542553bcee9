"""The range sensor: rays over the forward field of view, to the road's edge (`sense`), other cars (`cast_boxes`) and
stop lines of lights (`cast_lines`).

A ray is marched through the signed clearance field d to its root. Far from the edge, its steps are 1.5 times the
clearance; near the edge, they are Newton steps with the slope of the bilinearly interpolated field.

A step longer than the clearance may skip a wall. On maps with walls thinner than THICK_WALL, Newton steps are shorter,
and each step is checked: of a step from t0 to t1, the ground is known up to t0 + d(t0) and from t1 - |d(t1)| on. If a
wall of the map may fit into the part between these, the ray goes back.
"""

from __future__ import annotations

import math

import numpy as np

from gridsim.jit import ONE, ZERO, F, I, freeze, leaf
from gridsim.maps.lights import GO, light
from gridsim.maps.network import wrapped
from gridsim.maps.roads import CELLS_PER_UNIT, THICK_WALL
from gridsim.sensing.simd import LEAP, MARGIN, SIMD_RAYS, vector_march
from gridsim.state import COS, LANE, SIN, SPEED, X, Y

_SCALE = np.float32(CELLS_PER_UNIT)
_march, _march_among_thin_walls = vector_march(16, False), vector_march(24, True)


def fan(count: int, first: float | np.float32, step: float | np.float32) -> np.ndarray:
    """Cosine and sine of each ray's angle from the heading, `first + k * step` rad for ray k: float32 [2, lanes].

    `lanes` is count rounded up to a multiple of SIMD_RAYS; the extra columns repeat the last ray.
    """
    ray = np.minimum(np.arange(-(-count // SIMD_RAYS) * SIMD_RAYS), count - 1)
    angle = first + step * ray
    return freeze(np.stack([np.cos(angle), np.sin(angle)]).astype(np.float32))


@leaf
def sense(road, fan, reach, x, y, cosine, sine, ranges):
    """Ranges (m) of all rays from a point to the road's edge.

    Args: fan of `fan()`, reach m, position m, heading as cosine and sine.
    Writes: ranges float32 [rays], in [0, reach].
    """
    scale = _SCALE * road.per_m
    px0, py0, far = x * scale, y * scale, reach * road.per_m
    for block in range(0, fan.shape[1], SIMD_RAYS):
        # fmt: off
        if road.thinnest < THICK_WALL:  # two calls, because a variable that holds either function would not be inlined
            _march_among_thin_walls(road.field, road.columns, road.rows, px0, py0, far, cosine, sine,
                                    fan, block, road.thinnest - MARGIN, ranges)
        else:
            _march(road.field, road.columns, road.rows, px0, py0, far, cosine, sine,
                   fan, block, LEAP, ranges)
        # fmt: on
    if road.unit != ONE:
        for ray in range(ranges.shape[0]):
            ranges[ray] *= road.unit


@leaf
def cast_boxes(constants, fan, width, height, x, y, cosine, sine, velocity, world, ranges, closing):
    """Shorten ranges (m) to the first car of a world that each ray hits: slab test of boxes (Kay and Kajiya 1986).

    Args: fan of `rays.fan`; sides of the torus, m; the sensor's position (m), heading, and velocity (m/s) along the
    heading and to the left; world as in `traffic.world`.
    Writes: ranges float32 [rays] and, unless it is empty, closing float32 [rays]: how fast (m/s, along the ray) the
    sensor and the car that the ray hits approach each other, as a radar measures it; 0 where a ray hits no car.
    """
    for r in range(closing.shape[0]):
        closing[r] = ZERO
    length, breadth = constants.half_length, constants.half_width
    radius = math.sqrt(length * length + breadth * breadth)
    last_ray = I(ranges.shape[0] - 1)
    # A field of view below 180 degrees is the intersection of two half planes, along the first and the last ray. Boxes
    # outside it are skipped without computing an angle.
    narrow = fan[0, 0] > ZERO
    margin, reach = F(-1.01) * radius, constants.ray_range + radius
    for j in range(world.shape[0]):
        if world[j, LANE] < ZERO:
            continue
        dx, dy = wrapped(world[j, X] - x, width), wrapped(world[j, Y] - y, height)
        squared = dx * dx + dy * dy
        if squared > reach * reach:
            continue
        forward, aside = dx * cosine + dy * sine, dy * cosine - dx * sine
        if (
            narrow
            and min(aside * fan[0, 0] - forward * fan[1, 0], forward * fan[1, last_ray] - aside * fan[0, last_ray])
            < margin
        ):
            continue
        first, last = I(0), last_ray
        if squared > F(4.0) * radius * radius:
            # Test only rays that may hit the circle around the box, which spans asin(radius / distance) to either side.
            # At this distance, the arc sine is at most 1.05 times its argument.
            half = F(1.06) * radius / math.sqrt(squared)
            angle = math.atan2(aside, forward)
            low, high = (angle - half - constants.ray_first), (angle + half - constants.ray_first)
            if high < ZERO or low > constants.ray_step * F(last_ray):
                continue
            first = max(I(low / constants.ray_step), I(0))
            last = min(I(high / constants.ray_step) + I(1), last_ray)
        bc, bs = world[j, COS], world[j, SIN]
        ox, oy = -(dx * bc + dy * bs), -(dy * bc - dx * bs)  # the sensor's position in the box's frame
        rc, rs = cosine * bc + sine * bs, sine * bc - cosine * bs
        for r in range(first, last + 1):
            ux, uy = rc * fan[0, r] - rs * fan[1, r], rs * fan[0, r] + rc * fan[1, r]
            ix, iy = ONE / ux, ONE / uy
            x0, x1 = (-length - ox) * ix, (length - ox) * ix
            y0, y1 = (-breadth - oy) * iy, (breadth - oy) * iy
            enter = max(min(x0, x1), min(y0, y1))
            leave = min(max(x0, x1), max(y0, y1))
            if enter <= leave and leave > ZERO and enter < ranges[r]:
                ranges[r] = max(enter, ZERO)
                if closing.shape[0] > 0:
                    # The box moves along its heading, its x axis.
                    closing[r] = velocity[0] * fan[0, r] + velocity[1] * fan[1, r] - world[j, SPEED] * ux


@leaf
def cast_lines(network, fan, reach, seconds, x, y, cosine, sine, ranges, closing):
    """Shorten ranges (m) to stop lines whose light is not green, for rays that cross them in the direction of traffic.

    Args as in `cast_boxes`; reach, m; `seconds`, the time on the lights' clock. Such a ray's closing speed is set to 0.
    """
    for k in range(network.lines.shape[0]):
        line = network.lines[k]
        dx, dy = wrapped(line[0] - x, network.width), wrapped(line[1] - y, network.height)
        ahead, aside = dx * line[2] + dy * line[3], dy * line[2] - dx * line[3]
        if ahead <= ZERO or ahead > reach or light(network, k, seconds) == GO:
            continue
        along, across = cosine * line[2] + sine * line[3], sine * line[2] - cosine * line[3]  # the heading
        for r in range(ranges.shape[0]):
            over = along * fan[0, r] - across * fan[1, r]
            if over > ZERO and ahead < ranges[r] * over:
                at = ahead / over
                if abs(at * (across * fan[0, r] + along * fan[1, r]) - aside) <= line[4]:
                    ranges[r] = at
                    if closing.shape[0] > 0:
                        closing[r] = ZERO
