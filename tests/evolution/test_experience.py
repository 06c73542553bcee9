"""Experience as arrays: fixed point, cells in two bits, frames stacked from the rows before."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evolution.dqn.experience import NO_ACTION, UNITS, ages, empty, store_grid, to_fixed_point, unpack
from evolution.networks import convnet
from evolution.networks.policy import SPEED_SCALE, CnnSpec
from gridsim.sensing.grid import CELLS, FREE, OCCUPIED, UNKNOWN

F = np.float32
AREA = CELLS * CELLS


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
    speeds = rng.uniform(0.0, 25.0, 12).astype(F)
    x, wanted, room = empty(spec, 12), [], convnet.scratch(spec)
    begun = True
    for row, speed in enumerate(speeds):
        grid = rng.choice(np.array([UNKNOWN, FREE, OCCUPIED]), AREA)
        store_grid(grid, speed, x.observations[row])
        convnet.push(grid, begun, room)
        wanted.append(room.frames.copy())
        begun = row in (5, 7, 11)  # it was an episode's last
        x.actions[row] = NO_ACTION if begun else 0
    rows = rng.permutation(12)
    seen = unpack(spec, np.roll(x.observations, turn, axis=0), (rows + turn) % 12, ages(x)[rows])
    assert seen.shape == (12, frames * AREA + 1)
    assert (seen[:, :-1] == np.array(wanted)[rows]).all()
    assert np.abs(seen[:, -1] - (speeds[rows] / SPEED_SCALE - 1)).max() <= 0.5 / UNITS + 1e-6
