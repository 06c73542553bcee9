"""Experience as arrays: fixed point, cells in two bits, frames stacked from the rows before, bytes there and back."""

import numpy as np
import pytest
from driving import to_bytes
from hypothesis import given
from hypothesis import strategies as st

from evolution.dqn.experience import (
    NO_ACTION,
    OLDEST,
    UNITS,
    Experience,
    ages,
    empty,
    join,
    observation_dtype_and_width,
    store_grid,
    store_rays,
    to_fixed_point,
    unpack,
)
from evolution.networks import convnet
from evolution.networks.policy import SPEED_SCALE, CnnSpec, MlpSpec, PolicySpec
from gridsim.jit import njit
from gridsim.sensing.grid import CELLS, FREE, OCCUPIED, UNKNOWN

F = np.float32
AREA = CELLS * CELLS
SPECS = [MlpSpec((5,)), MlpSpec((5,), motion=True), MlpSpec((5,), steering=True), CnnSpec((8, 8, 8), frames=3)]


@njit
def _keep_rays(inputs, row):
    store_rays(inputs, row)


@njit
def _keep_grid(grid, speed, row):
    store_grid(grid, speed, row)


@njit
def _fixed(value):
    return to_fixed_point(value)


def made(spec: PolicySpec, lengths: list[int], seed: int = 0) -> Experience:
    """Episodes of so many steps, of random bits."""
    rng = np.random.default_rng(seed)
    parts = []
    for steps in lengths:
        x = empty(spec, steps + 1)
        x.observations[:] = rng.integers(0, 256, x.observations.shape)
        x.actions[:] = rng.integers(0, 8, steps + 1)
        x.actions[-1] = NO_ACTION
        x.rewards[:] = rng.normal(size=steps + 1)
        x.ends[:] = 0
        x.ends[:-1][-1:] = 1 + steps % 4
        parts.append(x)
    return join(spec, parts)


@pytest.mark.parametrize(
    ("spec", "dtype", "width"),
    [(SPECS[0], "<i2", 32), (SPECS[1], "<i2", 63), (SPECS[2], "<i2", 33), (SPECS[3], "u1", 1602)],
)
def test_what_a_row_is(spec: PolicySpec, dtype: str, width: int) -> None:
    assert observation_dtype_and_width(spec) == (np.dtype(dtype), width)
    x = empty(spec, 7)
    assert x.observations.shape == (7, width)
    assert [array.dtype for array in x] == [np.dtype(dtype), np.uint8, np.float32, np.uint8]


@given(st.floats(-20.0, 20.0, width=32))
def test_fixed_point_is_the_nearest_and_clipped(value: float) -> None:
    code = int(_fixed(F(value)))
    assert -32768 <= code <= 32767
    assert abs(code / 4096 - min(max(value, -8.0), 32767 / 4096)) <= 0.5 / 4096 + 1e-6


def test_rays_come_back_as_the_network_saw_them() -> None:
    spec = SPECS[0]
    inputs = np.random.default_rng(1).uniform(-1.0, 2.0, (50, spec.inputs + 3)).astype(F)
    x = empty(spec, 50)
    for seen, row in zip(inputs, x.observations, strict=True):
        _keep_rays(seen, row)
    rows = np.array([3, 49, 0, 3])
    back = unpack(spec, x.observations, rows)
    assert back.dtype == np.float32
    assert np.abs(back - inputs[rows, : spec.inputs]).max() <= 0.5 / UNITS + 1e-7
    assert (back == x.observations[rows] / 4096.0).all()


def test_a_frame_is_two_bits_a_cell_and_the_speed() -> None:
    """By the layout's description, cell by cell."""
    rng = np.random.default_rng(2)
    row = np.empty(1602, dtype=np.uint8)
    for speed in (-3.0, 0.0, 9.9, 10.0, 30.0):
        grid = rng.choice(np.array([UNKNOWN, FREE, OCCUPIED]), AREA)
        _keep_grid(grid, F(speed), row)
        codes = [int(row[k // 4]) >> 2 * (k % 4) & 3 for k in range(AREA)]
        assert codes == np.searchsorted([UNKNOWN, FREE, OCCUPIED], grid).tolist()
        kept = int.from_bytes(row[1600:].tobytes(), "little", signed=True)
        assert kept == round((speed / float(SPEED_SCALE) - 1.0) * 4096)


@njit
def _push(grid, begun, room):
    convnet.push(grid, begun, room)


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
            _keep_grid(grid, speeds[row], x.observations[row])
            _push(grid, k == 0, room)
            wanted.append(room.frames.copy())
            row += 1
    ring = np.roll(x.observations, turn, axis=0)
    rows = rng.permutation(row)
    seen = unpack(spec, ring, (rows + turn) % row, ages(x)[rows])
    assert seen.shape == (12, frames * AREA + 1)
    assert (seen[:, :-1] == np.array(wanted)[rows]).all()
    assert np.abs(seen[:, -1] - (speeds[rows] / SPEED_SCALE - 1)).max() <= 0.5 / UNITS + 1e-6


def test_where_a_ring_has_lost_an_episodes_beginning_the_oldest_left_is_repeated() -> None:
    spec = CnnSpec((8, 8, 8), frames=4)
    x = made(spec, [9])
    seen = unpack(spec, x.observations, np.array([5]), np.array([1])).reshape(-1)[:-1].reshape(4, AREA)
    assert (seen[0] == seen[1]).all()
    assert (seen[1] == seen[2]).all()
    assert (seen[2] != seen[3]).any()
    assert (seen[3] == unpack(CnnSpec((8, 8, 8), frames=1), x.observations, np.array([5]), np.array([0]))[0, :-1]).all()


def test_unpacking_into_a_given_array_and_none_at_all() -> None:
    for spec in SPECS:
        x = made(spec, [4, 2])
        out = np.empty((3, spec.inputs), dtype=F)
        rows = np.array([1, 7, 4])
        assert unpack(spec, x.observations, rows, ages(x)[rows], out) is out
        assert (out == unpack(spec, x.observations, rows, ages(x)[rows])).all()
        assert unpack(spec, x.observations, rows[:0], ages(x)[:0]).shape == (0, spec.inputs)


@given(st.lists(st.integers(0, 300), max_size=6))
def test_ages_count_from_each_episodes_first_row(lengths: list[int]) -> None:
    wanted = [min(k, OLDEST) for steps in lengths for k in range(steps + 1)]
    assert ages(made(SPECS[0], lengths)).tolist() == wanted


def test_parts_are_joined_in_their_order() -> None:
    spec = SPECS[0]
    whole = made(spec, [2, 5, 1])
    parts = [Experience(*(array[a:b] for array in whole)) for a, b in ((0, 3), (3, 9), (9, 11))]
    assert to_bytes(join(spec, parts)) == to_bytes(whole)
    assert len(join(spec, []).actions) == 0


def test_what_does_not_fit_is_refused() -> None:
    x, grids = made(SPECS[0], [3]), made(SPECS[3], [3])
    with pytest.raises(ValueError, match=r"kept as int16 \[rows, 32\], not uint8 \(4, 1602\)"):
        unpack(SPECS[0], grids.observations, np.array([0]))
    with pytest.raises(ValueError, match="give as many as rows"):
        unpack(SPECS[3], grids.observations, np.array([0]))
    with pytest.raises(ValueError, match=r"written to float32 \[1, 32\], not float64"):
        unpack(SPECS[0], x.observations, np.array([0]), out=np.empty((1, 32)))
