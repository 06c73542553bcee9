"""Experience as arrays: fixed point, cells in two bits, frames stacked from the rows before."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evolution.dqn.experience import (
    NO_ACTION,
    UNITS,
    Experience,
    ages,
    empty,
    store_grid,
    to_fixed_point,
    unpack,
)
from evolution.networks import convnet
from evolution.networks.policy import SPEED_SCALE, CnnSpec, MlpSpec, PolicySpec
from gridsim.sensing.grid import CELLS, FREE, OCCUPIED, UNKNOWN

F = np.float32
AREA = CELLS * CELLS


def made(spec: PolicySpec, lengths: list[int]) -> Experience:
    """Episodes of so many steps; only their actions say anything."""
    rows = np.array(lengths) + 1
    x = empty(spec, rows.sum())
    x.actions[:] = 0
    x.actions[np.cumsum(rows) - 1] = NO_ACTION
    return x


@given(st.floats(-20.0, 20.0, width=32))
def test_fixed_point_is_the_nearest_and_clipped(value: float) -> None:
    code = int(to_fixed_point(F(value)))
    assert -32768 <= code <= 32767
    assert abs(code / 4096 - min(max(value, -8.0), 32767 / 4096)) <= 0.5 / 4096 + 1e-6


@pytest.mark.parametrize("frames", [1, 4])
@pytest.mark.parametrize("turn", [0, 4])
def test_frames_are_stacked_as_the_network_stacks_them(frames: int, turn: int) -> None:
    """Against `convnet.push`, over three episodes; also in a ring that begins within the last of them."""
    spec = CnnSpec((8, 8, 8), frames=frames)
    rng = np.random.default_rng(3)
    lengths, speeds = [5, 1, 3], rng.uniform(0.0, 25.0, 12).astype(F)
    x, wanted, row = made(spec, lengths), [], 0
    room = convnet.scratch(spec)
    for steps in lengths:
        for k in range(steps + 1):
            grid = rng.choice(np.array([UNKNOWN, FREE, OCCUPIED]), AREA)
            store_grid(grid, speeds[row], x.observations[row])
            convnet.push(grid, k == 0, room)
            wanted.append(room.frames.copy())
            row += 1
    ring = np.roll(x.observations, turn, axis=0)
    rows = rng.permutation(row)
    seen = unpack(spec, ring, (rows + turn) % row, ages(x)[rows])
    assert seen.shape == (12, frames * AREA + 1)
    assert (seen[:, :-1] == np.array(wanted)[rows]).all()
    assert np.abs(seen[:, -1] - (speeds[rows] / SPEED_SCALE - 1)).max() <= 0.5 / UNITS + 1e-6


@given(st.lists(st.integers(0, 300), min_size=1, max_size=6))
def test_ages_count_from_each_episodes_first_row(lengths: list[int]) -> None:
    wanted = [k for steps in lengths for k in range(steps + 1)]
    assert ages(made(MlpSpec((5,)), lengths)).tolist() == wanted
