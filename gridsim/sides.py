"""Whose side of the road it is: where lanes run, and which way, as a table that kernels read.

A two-lane road looks the same to a range sensor from its middle as from the oncoming lane. Who is to learn to keep to
its own side among traffic has to be told when it does not.
"""

from __future__ import annotations

import math

import numpy as np

from gridsim.jit import leaf, njit
from gridsim.roads import Lanes, freeze

CELLS_PER_M = 2
REACH = 3.0  # m to either side of a lane's middle that are the lane's, where no other comes the other way
APART = 1.1  # m that an oncoming lane's middle must be further away: half of it is the way to the road's middle
ON_LANE = 0.6  # m from its middle, from where on it is the lane's in any case: lanes cross in junctions
OCTANTS = 8  # directions that are told apart

_F, _I = np.float32, np.int32
_PER_TURN = _F(OCTANTS / (2.0 * math.pi))


@njit
def _distances(points, offsets, columns, rows, away):
    """Fill away [rows * columns, OCTANTS] with m to the nearest lane of each direction, where it is within reach."""
    reach = REACH + APART
    span = int(math.ceil(reach * CELLS_PER_M))
    for lane in range(offsets.shape[0] - 1):
        for p in range(offsets[lane], offsets[lane + 1] - 1):
            dx, dy = points[p + 1, 0] - points[p, 0], points[p + 1, 1] - points[p, 1]
            octant = int(math.floor(math.atan2(dy, dx) * _PER_TURN)) % OCTANTS
            inverse = 1.0 / max(dx * dx + dy * dy, 1e-9)
            column, row = int(math.floor(points[p, 0] * CELLS_PER_M)), int(math.floor(points[p, 1] * CELLS_PER_M))
            for j in range(row - span, row + span + 1):
                for i in range(column - span, column + span + 1):
                    x, y = (i + 0.5) / CELLS_PER_M - points[p, 0], (j + 0.5) / CELLS_PER_M - points[p, 1]
                    t = min(max((x * dx + y * dy) * inverse, 0.0), 1.0)
                    distance = math.sqrt((x - t * dx) ** 2 + (y - t * dy) ** 2)
                    cell = (j % rows) * columns + i % columns
                    if distance < away[cell, octant]:
                        away[cell, octant] = distance


@njit
def _allowed(away, sides):
    for cell in range(away.shape[0]):
        for k in range(OCTANTS):
            own = min(away[cell, k], away[cell, (k + 1) % OCTANTS], away[cell, (k + 7) % OCTANTS])
            if own > REACH:
                continue
            oncoming = min(away[cell, (k + 3) % OCTANTS], away[cell, (k + 4) % OCTANTS], away[cell, (k + 5) % OCTANTS])
            if own < ON_LANE or oncoming > own + APART:
                sides[cell] |= np.uint8(1 << k)


def make_sides(lanes: Lanes, width: float, height: float) -> np.ndarray:
    """For each cell of a map, the directions in which one may drive there: uint8 [rows * columns], a bit each.

    Bit k stands for headings from k to k + 1 eighths of a turn: those of a lane nearby, and 45 degrees to either side.
    """
    columns, rows = round(width * CELLS_PER_M), round(height * CELLS_PER_M)
    sides = np.zeros(columns * rows, dtype=np.uint8)
    if len(lanes):
        away = np.full((columns * rows, OCTANTS), np.inf, dtype=np.float32)
        _distances(freeze(lanes.points), freeze(lanes.offsets), columns, rows, away)
        _allowed(away, sides)
    return freeze(sides)


@leaf
def keeps_side(sides, width, x, y, cosine, sine):
    """Whether a car at (x, y) on the map, with this heading, is on a lane that runs its way."""
    # The octant without an arc tangent: turn by halves and quarters into the first two.
    octant = _I(0)
    if sine < _F(0.0):
        octant, cosine, sine = _I(4), -cosine, -sine
    if cosine <= _F(0.0):
        octant, cosine, sine = octant + _I(2), sine, -cosine
    if sine >= cosine:
        octant += _I(1)
    columns = _I(width * _F(CELLS_PER_M))
    cell = _I(y * _F(CELLS_PER_M)) * columns + min(_I(x * _F(CELLS_PER_M)), columns - _I(1))
    return (sides[min(cell, _I(sides.shape[0] - 1))] >> octant) & 1 == 1
