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
from typing import Any

import numpy as np

from gridsim.jit import CONFIG, leaf
from gridsim.maps.roads import (
    CELLS_PER_M,
    FIELD_FLOOR,
    FIELD_UNITS,
    HEADING_BINS,
    HEADING_WRAP,
    START_CELLS_PER_M,
    START_UNITS,
)
from gridsim.sensing.simd import SIMD_RAYS, march_intrinsic

_F, _I, _U, _N = np.float32, np.int32, np.uint32, np.uint64
_SCALE = _F(CELLS_PER_M)
_UNIT = _F(1.0 / FIELD_UNITS)
_FLOOR = _F(FIELD_FLOOR)
_SLOPE = _F(CELLS_PER_M / FIELD_UNITS)
_BINS_PER_RADIAN = _F(HEADING_BINS / (2.0 * math.pi))
_PER_START = _U(CELLS_PER_M // START_CELLS_PER_M)
_STRIDE = _I(HEADING_BINS + HEADING_WRAP)
# Chosen for a small error with few steps of the slowest ray, over 4,000 poses: 99th percentile 0.06 m.
_NEAR = _F(2.0)  # m of clearance below which Newton steps are taken
_STRETCH = _F(1.5)  # length of a step above it, in clearances
_CLOSE = _F(0.04)  # m of clearance at which a ray has arrived
_SLOPE_MIN = _F(0.1)  # a Newton step is at most ten times the clearance ...
_LEAP = _F(2.0)  # ... and at most so many m longer than a stretched step, not to jump over an island
_STEPS = 16  # at most
_GAP = _F(0.95)  # m of a step that may be blind, on maps with thin walls
# How to march without and with thin walls: most steps, leap in m, whether steps are checked for blind parts. PLAIN may
# pass walls of less than 3 m.
PLAIN = (_STEPS, _LEAP, False)
AMONG_THIN_WALLS = (24, _F(0.9), True)


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
def march(field, columns, rows, px0, py0, reach, beams, how):
    """Move each of SIMD_RAYS rays from its start range to the edge of the road.

    Args: packed field with its sides; origin in cells; reach m; beams float32 [3, SIMD_RAYS]: direction x, direction y
    and range: on entry the start, on return the result, in [0, reach]; how: PLAIN or AMONG_THIN_WALLS.
    """
    steps, leap, look_back = how
    mask_x, mask_y = _U(columns - _U(1)), _U(rows - _U(1))
    for r in range(SIMD_RAYS):
        dx, dy, t = beams[0, r], beams[1, r], beams[2, r]
        safe = t  # m that are known to be free, but for blind parts of _GAP or less
        for _ in range(steps):
            px, py = px0 + t * (dx * _SCALE), py0 + t * (dy * _SCALE)
            fx, fy = math.floor(px), math.floor(py)
            ux, uy = px - fx, py - fy
            word = field[_U(_U(_U(_I(fy)) & mask_y) * columns + (_U(_I(fx)) & mask_x))]
            q00, q10 = _F(_I(word & _U(255))), _F(_I((word >> _U(8)) & _U(255)))
            q01, q11 = _F(_I((word >> _U(16)) & _U(255))), _F(_I(word >> _U(24)))
            rise_low, rise_high = q10 - q00, q11 - q01
            low, high = q00 + ux * rise_low, q01 + ux * rise_high
            clear = (low + uy * (high - low)) * _UNIT + _FLOOR
            if look_back:
                if t - abs(clear) > safe + _GAP:
                    t = safe + _GAP
                    continue
                if clear > _F(0.0):
                    safe = max(safe, t + clear)
            if t >= reach:
                break
            if clear > _NEAR:
                t += _STRETCH * clear
            else:
                slope = -(dx * (rise_low + uy * (rise_high - rise_low)) + dy * (high - low)) * _SLOPE
                t += min(clear / min(max(slope, _SLOPE_MIN), _F(1.0)), max(_STRETCH * clear, _F(0.0)) + leap)
                if look_back:
                    t = max(t, safe)
                if abs(clear) < _CLOSE:
                    break
        if look_back:
            t = min(t, safe + _GAP)
        beams[2, r] = min(max(t, _F(0.0)), reach)


def _compiled(how: tuple[int, np.float32, bool]) -> Any:
    """The vector code for `march`: it runs until the last ray has arrived."""
    steps, leap, look_back = how
    numbers = map(float, (_SCALE, _UNIT, _FLOOR, _SLOPE, _NEAR, _STRETCH, _CLOSE, _SLOPE_MIN, leap))
    arguments: list[Any] = [*numbers, float(_GAP) if look_back else None]
    return march_intrinsic(steps, *arguments)


@leaf
def _plain_march(field, columns, rows, px0, py0, reach, beams):
    march(field, columns, rows, px0, py0, reach, beams, PLAIN)


@leaf
def _plain_march_thin(field, columns, rows, px0, py0, reach, beams):
    march(field, columns, rows, px0, py0, reach, beams, AMONG_THIN_WALLS)


# `NUMBA_DISABLE_JIT=1` selects the plain kernel.
fast_march = _plain_march if CONFIG.DISABLE_JIT else _compiled(PLAIN)
fast_march_thin = _plain_march_thin if CONFIG.DISABLE_JIT else _compiled(AMONG_THIN_WALLS)


@leaf
def sense(road, fan, first, reach, x, y, cosine, sine, beams, ranges):
    """Ranges of all rays from a point, in m.

    Args: fan of `fan()`, first ray's angle from the heading (rad), reach m, position m, heading as cosine and sine;
    beams float32 [3, SIMD_RAYS], overwritten.
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
    rays = ranges.shape[0]
    # Unsigned indices: Numba's check whether signed ones are negative would prevent vectorisation.
    zero, one, two, lanes = _N(0), _N(1), _N(2), _N(SIMD_RAYS)
    for block in range(0, fan.shape[1], SIMD_RAYS):
        at = _N(block)
        for r in range(lanes):
            beams[zero, r] = cosine * fan[zero, at + r] - sine * fan[one, at + r]
        for r in range(lanes):
            beams[one, r] = sine * fan[zero, at + r] + cosine * fan[one, at + r]
        for r in range(lanes):
            beams[two, r] = _F(road.start[_N(base) + _N(_I(bin0 + fan[two, at + r]))]) * known
        if road.thin:
            fast_march_thin(road.field, columns, road.rows, px0, py0, reach, beams)
        else:
            fast_march(road.field, columns, road.rows, px0, py0, reach, beams)
        for r in range(min(rays - block, SIMD_RAYS)):
            ranges[block + r] = beams[2, r]
