"""The forward pass of `cnn` policies in our own kernels: one car at a time, each sum in a fixed order.

So a car's actions depend only on its genome and observations, not on the members and episodes in the same chunk, and
workers need not load PyTorch.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from evolution.networks.dense import tile
from evolution.networks.policy import (
    ACTIONS,
    KERNEL_1,
    KERNEL_2,
    SIDE_1,
    SIDE_2,
    STRIDE_1,
    STRIDE_2,
    UNIT_MULTIPLE,
    CnnSpec,
    choose,
)
from gridsim.jit import F, freeze, leaf, njit
from gridsim.sensing.grid import CELLS
from gridsim.sensing.observation import SPEED_SCALE

_CODE = F(1.0 / 255.0)
_AREA = CELLS * CELLS
_HALF_ROW = (SIDE_1 + 1) // 2  # two tiles cover a row of 19 and overlap in its middle
_WIDE, _WIDEST = 2 * UNIT_MULTIPLE, 4 * UNIT_MULTIPLE

_convolve_1, _convolve_1_wide = tile(_HALF_ROW, UNIT_MULTIPLE, True), tile(_HALF_ROW, _WIDE, True)
_convolve_2, _convolve_2_wide = tile(SIDE_2, UNIT_MULTIPLE, True), tile(SIDE_2, _WIDE, True)
_dense, _dense_wide = tile(1, UNIT_MULTIPLE, True), tile(1, _WIDEST, True)
_linear, _pair = tile(1, ACTIONS, False), tile(1, 2, False)


class Scratch(NamedTuple):
    """Buffers of a forward pass for one car: float32."""

    frames: np.ndarray  # [frames * 6400] cells of the frames, the newest last, in [0, 1]
    first: np.ndarray  # [19 * 19 * channels], outputs of the first convolution
    second: np.ndarray  # [8 * 8 * channels + 1], outputs of the second convolution, then the speed / SPEED_SCALE - 1
    dense: np.ndarray  # [units], outputs of the dense layer
    outputs: np.ndarray  # [outputs]


def scratch(spec: CnnSpec) -> Scratch:
    """Allocate the buffers of a forward pass."""
    first, second, dense = spec.hidden
    sizes = (spec.frames * _AREA, SIDE_1 * SIDE_1 * first, SIDE_2 * SIDE_2 * second + 1, dense, spec.outputs)
    return Scratch(*(np.zeros(n, dtype=np.float32) for n in sizes))


@leaf
def push(grid, begun, scratch):
    """Add a grid uint8 [6400] as newest frame and drop the oldest one.

    If the episode has just `begun`, fill all frames with the grid.
    """
    frames = scratch.frames
    older = frames.shape[0] - _AREA
    for i in range(older):
        frames[i] = frames[i + _AREA]
    for i in range(_AREA):
        frames[older + i] = F(grid[i]) * _CODE
    if begun:
        for i in range(older):
            frames[i] = frames[older + i % _AREA]


@leaf
def forward(genome, layers, speed, scratch):
    """Write the network's outputs for the frames in `scratch` and a speed in m/s to `scratch.outputs`.

    Args: genome float32 [genes]; layers of `CnnSpec.layers`. A NaN anywhere reaches the outputs.
    """
    frames, one, two, units, outputs = int(layers[0]), int(layers[1]), int(layers[2]), int(layers[3]), int(layers[4])
    bias = frames * KERNEL_1 * KERNEL_1 * one
    for y in range(SIDE_1):
        for x in (0, SIDE_1 - _HALF_ROW):
            at, to = STRIDE_1 * (y * CELLS + x), (y * SIDE_1 + x) * one
            c = 0
            while one - c >= _WIDE:
                _convolve_1_wide(
                    scratch.frames, at, STRIDE_1, frames, _AREA, KERNEL_1, CELLS, KERNEL_1,
                    genome, c, one, bias + c, scratch.first, to + c, one,
                )  # fmt: skip
                c += _WIDE
            if c < one:
                _convolve_1(
                    scratch.frames, at, STRIDE_1, frames, _AREA, KERNEL_1, CELLS, KERNEL_1,
                    genome, c, one, bias + c, scratch.first, to + c, one,
                )  # fmt: skip
    start = bias + one
    bias = start + KERNEL_2 * KERNEL_2 * one * two
    for y in range(SIDE_2):
        at, to = STRIDE_2 * y * SIDE_1 * one, y * SIDE_2 * two
        c = 0
        while two - c >= _WIDE:
            _convolve_2_wide(
                scratch.first, at, STRIDE_2 * one, 1, 0, KERNEL_2, SIDE_1 * one, KERNEL_2 * one,
                genome, start + c, two, bias + c, scratch.second, to + c, two,
            )  # fmt: skip
            c += _WIDE
        if c < two:
            _convolve_2(
                scratch.first, at, STRIDE_2 * one, 1, 0, KERNEL_2, SIDE_1 * one, KERNEL_2 * one,
                genome, start + c, two, bias + c, scratch.second, to + c, two,
            )  # fmt: skip
    start = bias + two
    inputs = SIDE_2 * SIDE_2 * two + 1
    scratch.second[inputs - 1] = speed / SPEED_SCALE - F(1.0)
    bias = start + inputs * units
    c = 0
    while units - c >= _WIDEST:
        _dense_wide(scratch.second, 0, 0, 1, 0, 1, 0, inputs, genome, start + c, units, bias + c, scratch.dense, c, 0)
        c += _WIDEST
    while c < units:
        _dense(scratch.second, 0, 0, 1, 0, 1, 0, inputs, genome, start + c, units, bias + c, scratch.dense, c, 0)
        c += UNIT_MULTIPLE
    start = bias + units
    if outputs == ACTIONS:
        bias = start + units * ACTIONS
        _linear(scratch.dense, 0, 0, 1, 0, 1, 0, units, genome, start, ACTIONS, bias, scratch.outputs, 0, 0)
    else:
        _pair(scratch.dense, 0, 0, 1, 0, 1, 0, units, genome, start, 2, start + units * 2, scratch.outputs, 0, 0)


@leaf
def decide(genome, layers, speed, scratch, command):
    """Choose an action for the frames in `scratch` and a speed in m/s; `command` and result as in `policy.choose`."""
    forward(genome, layers, speed, scratch)
    return choose(scratch.outputs, 0, scratch.outputs.shape[0], command)


@njit
def _act_on(genome, layers, frames, speeds, scratch, actions):
    for n in range(frames.shape[0]):
        for k in range(frames.shape[1]):
            push(frames[n, k], False, scratch)
        if actions.ndim == 1:
            actions[n] = decide(genome, layers, speeds[n], scratch, None)
        else:
            decide(genome, layers, speeds[n], scratch, actions[n])


def act_on(spec: CnnSpec, genome: np.ndarray, observation: np.ndarray, speed: float | np.ndarray) -> Any:
    """Actions of a genome for grids.

    Args: observation uint8 [frames, 80, 80], newest last, or [n, frames, 80, 80]; speed m/s, a number or [n].
    Returns: as `policy.act_on`.
    Raises: ValueError if the observation's shape or type is wrong.
    """
    grids = np.asarray(observation)
    many, frames = grids.ndim == 4, f"{spec.frames}, {CELLS}, {CELLS}"
    if grids.shape[many:] != (spec.frames, CELLS, CELLS) or grids.dtype != np.uint8:
        raise ValueError(f"{spec} sees grids uint8 [{frames}] or [n, {frames}], not {grids.dtype} {grids.shape}")
    grids = np.ascontiguousarray(grids).reshape(-1, spec.frames, CELLS * CELLS)
    speeds = np.ascontiguousarray(np.broadcast_to(np.asarray(speed, dtype=np.float32), len(grids)))
    discrete = spec.actions == "discrete"
    actions = np.empty(len(grids), dtype=np.int64) if discrete else np.empty((len(grids), 2), dtype=np.float32)
    _act_on(freeze(np.ascontiguousarray(genome)), spec.layers, grids, speeds, scratch(spec), actions)
    return actions if many else int(actions[0]) if discrete else actions[0]
