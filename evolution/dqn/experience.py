"""Experience of the DQN as arrays, and the compact format of observations.

Episodes are concatenated. An episode of T steps has T + 1 rows. Row t < T has the observation before step t, and the
step's action and reward; `ends` is 0 except in row T - 1, where it is the `gridsim.state.End` of the episode. Row T has
the observation after the last step, the action NO_ACTION, reward 0 and `ends` 0. After an end that truncates, the value
of what follows is estimated from row T.

Observations are the network's inputs in a format small enough to keep a million of them:

* rays: int16 [inputs], what `observation.normalise` writes, in units of 1/4096 and clipped to [-8, 8);
* grid: uint8 [1602], one frame, then the speed input as little-endian int16 in the same units. A cell takes two bits:
  0, 1 and 2 for unknown, free and occupied. Cell k is in byte k // 4, in bit 2 (k mod 4) and the bit above it. The
  earlier frames of a stack are those of the rows before; frames before the episode's first row are copies of that row's
  frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evolution.networks.policy import CnnSpec, PolicySpec
from gridsim.jit import F, freeze, leaf, njit
from gridsim.sensing.grid import CELLS, FREE, OCCUPIED, UNKNOWN
from gridsim.sensing.observation import SPEED_SCALE

NO_ACTION = 255  # the action in an episode's last row, which has none
UNITS = F(4096.0)  # the fixed-point number that stands for 1
_AREA = CELLS * CELLS
_FRAME = _AREA // 4  # bytes of a stored frame
_LEAST, _GREATEST = F(-32768.0), F(32767.0)
# `_CELLS_OF`, float32 [256, 4]: a network's inputs for the four cells that a byte of each value holds. The unused code
# 3 means occupied.
_SEEN = np.array([UNKNOWN, FREE, OCCUPIED, OCCUPIED]).astype(np.float32) * F(1.0 / 255.0)
_CELLS_OF = freeze(_SEEN[np.arange(256)[:, None] >> np.arange(0, 8, 2) & 3])


class Experience(NamedTuple):
    """Concatenated episodes as arrays, with a row for each step and one more for each episode (see the module)."""

    observations: np.ndarray  # int16 [rows, inputs] of rays, uint8 [rows, 1602] of grids
    actions: np.ndarray  # uint8 [rows]
    rewards: np.ndarray  # float32 [rows]
    ends: np.ndarray  # uint8 [rows], End


def empty(spec: PolicySpec, *shape: int) -> Experience:
    """Uninitialised experience of shape [rows] or [episodes, rows]; untouched pages cost no memory (np.empty)."""
    grids = isinstance(spec, CnnSpec)
    return Experience(
        np.empty((*shape, _FRAME + 2 if grids else spec.inputs), dtype=np.uint8 if grids else np.int16),
        np.empty(shape, dtype=np.uint8),
        np.empty(shape, dtype=np.float32),
        np.empty(shape, dtype=np.uint8),
    )


def join(parts: Sequence[Experience]) -> Experience:
    """Concatenate one or more parts in their order."""
    return Experience(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def ages(experience: Experience) -> np.ndarray:
    """Number of rows before each row in its episode: int64 [rows]."""
    row = np.arange(len(experience.actions))
    begins = np.zeros(len(row), dtype=np.intp)
    begins[1:] = np.where(experience.actions[:-1] == NO_ACTION, row[1:], 0)
    return row - np.maximum.accumulate(begins)


@leaf
def to_fixed_point(value):
    """Convert a network's input to fixed point: the nearest int16, clipped."""
    return np.int16(min(max(math.floor(value * UNITS + F(0.5)), _LEAST), _GREATEST))


@leaf
def store_rays(inputs, row):
    """Store `inputs` float32 [inputs or more], of a network that sees rays, in `row` int16 [inputs]."""
    for i in range(row.shape[0]):
        row[i] = to_fixed_point(inputs[i])


@leaf
def store_grid(grid, speed, row):
    """Store a grid uint8 [6400] and a speed (m/s) in `row` uint8 [1602]."""
    for i in range(_FRAME):
        byte = 0
        for j in range(4):  # the codes 0, 127 and 255 become 0, 1 and 2
            byte |= (int(grid[4 * i + j]) + 1 >> 7) << 2 * j
        row[i] = byte
    bits = int(to_fixed_point(speed / SPEED_SCALE - F(1.0))) & 0xFFFF
    row[_FRAME], row[_FRAME + 1] = bits & 0xFF, bits >> 8


@njit(nogil=True)
def _unpack_rays(observations, rows, inputs):
    scale = F(1.0) / UNITS
    for n in range(rows.shape[0]):
        row = observations[rows[n]]
        for i in range(inputs.shape[1]):
            inputs[n, i] = row[i] * scale


@njit(nogil=True)
def _unpack_grids(observations, rows, ages, cells, frames, inputs):
    for n in range(rows.shape[0]):
        for k in range(frames):
            row = observations[(rows[n] - min(frames - 1 - k, ages[n])) % observations.shape[0]]
            at = k * _AREA
            for i in range(_FRAME):
                seen = cells[row[i]]
                for j in range(4):
                    inputs[n, at + 4 * i + j] = seen[j]
        row = observations[rows[n]]
        bits = int(row[_FRAME]) | int(row[_FRAME + 1]) << 8
        inputs[n, frames * _AREA] = F((bits ^ 0x8000) - 0x8000) / UNITS


def unpack(spec: PolicySpec, observations: np.ndarray, rows: np.ndarray, ages: np.ndarray) -> np.ndarray:
    """A network's inputs at some rows: float32 [n, spec.inputs]; for grids the frames, newest last, then the speed.

    Args:
        observations: as in `Experience`, or a ring buffer of them, in which row 0 follows the last one.
        rows: int64 [n], which are not checked.
        ages: [n], `ages` of these rows; any age above spec.frames - 1 may be given as spec.frames - 1. The rows with
            the earlier frames of these stacks must not be overwritten yet.
    """
    inputs = np.empty((len(rows), spec.inputs), dtype=np.float32)
    if isinstance(spec, CnnSpec):
        _unpack_grids(observations, rows, ages.astype(np.int64), _CELLS_OF, spec.frames, inputs)
    else:
        _unpack_rays(observations, rows, inputs)
    return inputs
