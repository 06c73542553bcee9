"""The occupancy grid: the ground ahead, cell by cell, computed from the range sensor's rays.

80 x 80 cells of 0.5 m, from the front axle to 40 m ahead of it and 20 m to either side (for small cars, read units
(`SimConfig.unit`) instead of m). Row 0 is the farthest ahead and column 0 the leftmost, as in a picture that looks
ahead. Each cell within the field of view belongs to the ray whose direction is nearest to that of the cell's centre.
With r the centre's distance from the middle of the front axle, R the ray's range and h half the diagonal of a cell,
the cell is

* free if r < R - h, before the ray's hit;
* occupied if R - h <= r <= R + h, at the hit;
* unknown if r > R + h, behind the hit, or if it is outside the field of view.

A ray whose range is the sensor's full range hit nothing: its cells are free up to that range, and unknown beyond.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from gridsim.config import SimConfig, constants
from gridsim.jit import F, U, freeze, leaf, njit

CELLS = 80  # along each side
CELL = 0.5  # side of a cell, in units (`SimConfig.unit`)
MAX_FRAMES = 8  # most grids in an observation
#: Codes of a cell, as grey levels of a picture; networks see them divided by 255.
UNKNOWN, FREE, OCCUPIED = np.uint8(0), np.uint8(127), np.uint8(255)
HALF_DIAGONAL = F(CELL * math.sqrt(0.5))  # of a cell, in units


class GridTable(NamedTuple):
    """The cells within the field of view, sorted by ray, then by distance; computed once for each SimConfig."""

    first: np.ndarray  # int32 [rays + 1]: where each ray's part of `cells` begins; the last is the end of `cells`
    cells: np.ndarray  # uint16 [cells in view]: index into a grid, row by row
    radii: np.ndarray  # float32 [cells in view + 1]: m, of the centres from the front axle; the last is infinite
    reach: np.float32  # m, the rays' full range
    half: np.float32  # m, half the diagonal of a cell


@cache
def grid_table(config: SimConfig) -> GridTable:
    """The table for a configuration's rays. Raises: ValueError as `config.constants`."""
    k, sensors = constants(config), config.sensors
    cell = CELL * config.unit
    at = (np.arange(CELLS) + 0.5) * cell
    # Centres of the cells, float64 [80, 80]: m ahead of the front axle, and m to the left.
    ahead, left = np.meshgrid(CELLS * cell - at, CELLS * cell / 2 - at, indexing="ij")
    angle, radius = np.arctan2(left, ahead), np.hypot(left, ahead)
    view = math.radians(sensors.field_of_view)
    ray = np.rint((angle + view / 2) / (view / (sensors.rays - 1))).astype(np.int64)
    seen = np.flatnonzero(np.abs(angle) <= view / 2)
    order = seen[np.lexsort((radius.ravel()[seen], ray.ravel()[seen]))]
    first = np.searchsorted(ray.ravel()[order], np.arange(sensors.rays + 1))
    return GridTable(
        freeze(first.astype(np.int32)),
        freeze(order.astype(np.uint16)),
        freeze(np.append(radius.ravel()[order], np.inf).astype(np.float32)),
        k.ray_range,
        HALF_DIAGONAL * k.unit,
    )


@leaf
def fill_grid(table, ranges, grid):
    """One car's grid from its ranges float32 [rays] in m; writes grid uint8 [6400], row by row."""
    for i in range(grid.shape[0]):
        grid[i] = UNKNOWN
    # Unsigned indices, because Numba checks whether signed ones are negative.
    for ray in range(ranges.shape[0]):
        hit = ranges[ray]
        near, far = hit - table.half, hit + table.half
        if hit >= table.reach:
            near = far = table.reach
        k, last = U(table.first[ray]), U(table.first[ray + 1])
        while k < last and table.radii[k] < near:
            grid[U(table.cells[k])] = FREE
            k += U(1)
        if hit >= table.reach:
            continue
        while k < last and table.radii[k] <= far:
            grid[U(table.cells[k])] = OCCUPIED
            k += U(1)


@njit(nogil=True)
def grids(table, ranges):
    """Grids uint8 [n, 80, 80] of ranges float32 [n, rays] in m."""
    made = np.empty((ranges.shape[0], CELLS * CELLS), dtype=np.uint8)
    for n in range(ranges.shape[0]):
        fill_grid(table, ranges[n], made[n])
    return made.reshape((ranges.shape[0], CELLS, CELLS))
