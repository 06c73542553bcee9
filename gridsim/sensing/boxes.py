"""Other cars as oriented boxes that rays hit."""

from __future__ import annotations

import math

import numpy as np

from gridsim.jit import leaf
from gridsim.maps.network import wrapped
from gridsim.state import COS, LANE, SIN, SPEED, X, Y

_F, _I = np.float32, np.int32
_ZERO, _ONE = _F(0.0), _F(1.0)


@leaf
def cast_boxes(constants, fan, width, height, x, y, cosine, sine, velocity, world, ranges, closing):
    """Shorten ranges (m) to the first box of a world that each ray hits: slab test (Kay and Kajiya 1986).

    Args: fan of `rays.fan`; sides of the torus, m; the sensor's position (m), heading, and velocity (m/s) along the
    heading and to the left; world as in `traffic.world`.
    Writes: ranges float32 [rays] and, if not None, closing float32 [rays]: the closing speed (m/s), along the ray, of
    the sensor and the car that the ray hits, as a radar measures it; 0 where the ray hits the road's edge.
    """
    if closing is not None:
        closing[:] = _ZERO
    length, breadth = constants.half_length, constants.half_width
    radius = math.sqrt(length * length + breadth * breadth)
    last_ray = _I(ranges.shape[0] - 1)
    # A field of view below 180 degrees is the intersection of two half planes, along the first and the last ray. Boxes
    # outside it are skipped without computing an angle.
    narrow = fan[0, 0] > _ZERO
    margin, reach = _F(-1.01) * radius, constants.ray_range + radius
    for j in range(world.shape[0]):
        if world[j, LANE] < _ZERO:
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
        first, last = _I(0), last_ray
        if squared > _F(4.0) * radius * radius:
            # Only the rays that may hit the box's circle; here the arc sine is at most 1.05 times its argument.
            half = _F(1.06) * radius / math.sqrt(squared)
            angle = math.atan2(aside, forward)
            low, high = (angle - half - constants.ray_first), (angle + half - constants.ray_first)
            if high < _ZERO or low > constants.ray_step * _F(last_ray):
                continue
            first = max(_I(low / constants.ray_step), _I(0))
            last = min(_I(high / constants.ray_step) + _I(1), last_ray)
        bc, bs = world[j, COS], world[j, SIN]
        ox, oy = -(dx * bc + dy * bs), -(dy * bc - dx * bs)  # the sensor's position in the box's frame
        rc, rs = cosine * bc + sine * bs, sine * bc - cosine * bs
        for r in range(first, last + 1):
            ux, uy = rc * fan[0, r] - rs * fan[1, r], rs * fan[0, r] + rc * fan[1, r]
            ix, iy = _ONE / ux, _ONE / uy
            x0, x1 = (-length - ox) * ix, (length - ox) * ix
            y0, y1 = (-breadth - oy) * iy, (breadth - oy) * iy
            enter = max(min(x0, x1), min(y0, y1))
            leave = min(max(x0, x1), max(y0, y1))
            if enter <= leave and leave > _ZERO and enter < ranges[r]:
                ranges[r] = max(enter, _ZERO)
                if closing is not None:
                    # The box moves along its heading, its x axis.
                    closing[r] = velocity[0] * fan[0, r] + velocity[1] * fan[1, r] - world[j, SPEED] * ux
