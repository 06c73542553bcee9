"""The range sensor: rays over the forward field of view, marched through the signed clearance field.

A ray ends at the root of the clearance along it. It starts at the lower bound given by the ray start table of `roads`,
takes long steps while the road is wide, and Newton steps near the edge, with slopes of the bilinear field.

A step is longer than the clearance at its beginning, so it may skip a wall. On maps with walls thinner than such a
step, steps are shorter and checked afterwards: the part of a step that neither the clearance at its beginning nor that
at its end covers is blind. If the blind part is longer than _GAP, the ray goes back. So no ray passes a wall of 1 m or
more.
"""

from __future__ import annotations

import math

import numpy as np

from gridsim.jit import leaf
from gridsim.maps.roads import CELLS_PER_M, HEADING_BINS, HEADING_WRAP, START_CELLS_PER_M, START_UNITS
from gridsim.sensing.simd import AMONG_THIN_WALLS, PLAIN, SIMD_RAYS, vector_march

_F, _I, _U = np.float32, np.int32, np.uint32
_SCALE = _F(CELLS_PER_M)
_BINS_PER_RADIAN = _F(HEADING_BINS / (2.0 * math.pi))
_PER_START = _U(CELLS_PER_M // START_CELLS_PER_M)
_STRIDE = _I(HEADING_BINS + HEADING_WRAP)
_march, _march_among_thin_walls = vector_march(PLAIN), vector_march(AMONG_THIN_WALLS)


def fan(count: int, first: float | np.float32, step: float | np.float32) -> np.ndarray:
    """Directions of the rays from the heading: float32 [3, lanes] of cosine, sine, and bins from the first ray's.

    `lanes` is count rounded up to a multiple of SIMD_RAYS; the extra ones repeat the last ray.
    """
    ray = np.minimum(np.arange(-(-count // SIMD_RAYS) * SIMD_RAYS), count - 1)
    angle = first + step * ray
    bins = step * ray * HEADING_BINS / (2.0 * math.pi)
    table = np.stack([np.cos(angle), np.sin(angle), bins]).astype(np.float32)
    table.setflags(write=False)
    return table


@leaf
def sense(road, fan, first, reach, x, y, cosine, sine, ranges):
    """Ranges of all rays from a point, in m.

    Args: fan of `fan()`, first ray's angle from the heading (rad), reach m, position m, heading as cosine and sine.
    Writes: ranges float32 [rays], in [0, reach].
    """
    px0, py0 = x * _SCALE, y * _SCALE
    columns = road.columns
    mask_x, mask_y = _U(columns - _U(1)), _U(road.rows - _U(1))
    cell_x = (_U(_I(math.floor(px0))) & mask_x) // _PER_START
    cell_y = (_U(_I(math.floor(py0))) & mask_y) // _PER_START
    row = road.start_row[_U(cell_y * (columns // _PER_START) + cell_x)]
    angle = math.atan2(sine, cosine) + first
    bin0 = angle * _BINS_PER_RADIAN
    bin0 -= math.floor(bin0 * _F(1.0 / HEADING_BINS)) * _F(HEADING_BINS)
    base = max(row, _I(0)) * _STRIDE
    known = _F(1.0 / START_UNITS) if row >= 0 else _F(0.0)
    for block in range(0, fan.shape[1], SIMD_RAYS):
        # fmt: off
        if road.thin:  # two calls, because a variable that holds either function would not be inlined
            _march_among_thin_walls(road.field, columns, road.rows, px0, py0, reach, cosine, sine,
                                    fan, block, road.start, base, bin0, known, ranges)
        else:
            _march(road.field, columns, road.rows, px0, py0, reach, cosine, sine,
                   fan, block, road.start, base, bin0, known, ranges)
        # fmt: on
