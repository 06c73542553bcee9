"""The range sensor: rays over the forward field of view, marched through the signed clearance field.

A ray ends at the root of the clearance along it. It takes long steps while the road is wide, and Newton steps near the
edge, with slopes of the bilinear field.

A step is longer than the clearance at its beginning, so it may skip a wall. On maps with walls thinner than such a
step, steps are shorter and checked afterwards: the part of a step that neither the clearance at its beginning nor that
at its end covers is blind. If the blind part is about as long as the map's walls are thick, the ray goes back.
"""

from __future__ import annotations

import numpy as np

from gridsim.jit import freeze, leaf
from gridsim.maps.roads import CELLS_PER_M, THICK_WALL
from gridsim.sensing.simd import LEAP, MARGIN, SIMD_RAYS, vector_march

_SCALE = np.float32(CELLS_PER_M)
_march, _march_among_thin_walls = vector_march(16, False), vector_march(24, True)


def fan(count: int, first: float | np.float32, step: float | np.float32) -> np.ndarray:
    """Directions of the rays from the heading: float32 [2, lanes] of cosine and sine.

    `lanes` is count rounded up to a multiple of SIMD_RAYS; the extra ones repeat the last ray.
    """
    ray = np.minimum(np.arange(-(-count // SIMD_RAYS) * SIMD_RAYS), count - 1)
    angle = first + step * ray
    return freeze(np.stack([np.cos(angle), np.sin(angle)]).astype(np.float32))


@leaf
def sense(road, fan, reach, x, y, cosine, sine, ranges):
    """Ranges of all rays from a point, in m.

    Args: fan of `fan()`, reach m, position m, heading as cosine and sine.
    Writes: ranges float32 [rays], in [0, reach].
    """
    px0, py0 = x * _SCALE, y * _SCALE
    for block in range(0, fan.shape[1], SIMD_RAYS):
        # fmt: off
        if road.thinnest < THICK_WALL:  # two calls, because a variable that holds either function would not be inlined
            _march_among_thin_walls(road.field, road.columns, road.rows, px0, py0, reach, cosine, sine,
                                    fan, block, road.thinnest - MARGIN, ranges)
        else:
            _march(road.field, road.columns, road.rows, px0, py0, reach, cosine, sine,
                   fan, block, LEAP, ranges)
        # fmt: on
