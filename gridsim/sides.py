"""Whose side of the road it is: where lanes run, and which way, as a table that kernels read.

A two-lane road looks the same to a range sensor from its middle as from the oncoming lane. Who is to learn to keep to
its own side among traffic has to be told when it does not.
"""

from __future__ import annotations

import math

import numpy as np

from gridsim.jit import leaf, njit
from gridsim.roads import Lanes, freeze

REACH = 1.6  # m to either side of a lane's middle that are the lane's
OCTANTS = 8  # directions that are told apart

_F, _I = np.float32, np.int32
_PER_TURN = _F(OCTANTS / (2.0 * math.pi))


@njit
def _stamp(points, offsets, columns, rows, reach, sides):
    for lane in range(offsets.shape[0] - 1):
        for p in range(offsets[lane], offsets[lane + 1] - 1):
            dx, dy = points[p + 1, 0] - points[p, 0], points[p + 1, 1] - points[p, 1]
            octant = int(math.floor(math.atan2(dy, dx) * _PER_TURN)) % OCTANTS
            # The octant itself and the ones beside it: whatever is within 45 degrees, and nothing beyond 90.
            bits = (1 << octant) | (1 << (octant + 1) % OCTANTS) | (1 << (octant - 1) % OCTANTS)
            mx, my = points[p, 0] + 0.5 * dx, points[p, 1] + 0.5 * dy
            for j in range(int(math.floor(my - reach)), int(math.floor(my + reach)) + 1):
                for i in range(int(math.floor(mx - reach)), int(math.floor(mx + reach)) + 1):
                    if (i + 0.5 - mx) ** 2 + (j + 0.5 - my) ** 2 <= reach * reach:
                        sides[(j % rows) * columns + i % columns] |= np.uint8(bits)


def make_sides(lanes: Lanes, width: float, height: float) -> np.ndarray:
    """For each square metre of a map, the directions in which lanes run there: uint8 [rows * columns], a bit each.

    Bit k stands for headings from k to k + 1 eighths of a turn; those within 45 degrees of a lane's are set.
    """
    columns, rows = round(width), round(height)
    sides = np.zeros(columns * rows, dtype=np.uint8)
    _stamp(freeze(lanes.points), freeze(lanes.offsets), columns, rows, REACH, sides)
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
    columns = _I(width)
    cell = min(_I(y) * columns + min(_I(x), columns - _I(1)), _I(sides.shape[0] - 1))
    return (sides[cell] >> octant) & 1 == 1
