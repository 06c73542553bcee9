"""The occupancy grid against geometry, cell by cell, and against the exact edges of real roads."""

import math

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from gridsim.config import SensorConfig, SimConfig
from gridsim.sensing.grid import (
    CELLS,
    fill_grid,
    grid_table,
    grids,
    push_frames,
)

F = np.float32
CONFIG = SimConfig()
TABLE = grid_table(CONFIG)


def cell_by_cell(config, ranges):
    """The textbook, float64: each cell on its own, from its centre's angle and distance."""
    sensors = config.sensors
    rays = np.radians(np.linspace(-sensors.field_of_view / 2, sensors.field_of_view / 2, sensors.rays))
    grid = np.zeros((80, 80), dtype=np.uint8)
    near_an_edge = np.zeros((80, 80), dtype=bool)  # where float32 may decide otherwise
    for row in range(80):
        for column in range(80):
            ahead, left = 40.0 - 0.5 * row - 0.25, 20.0 - 0.5 * column - 0.25
            angle, distance = math.atan2(left, ahead), math.hypot(ahead, left)
            if abs(angle) > math.radians(sensors.field_of_view / 2):
                continue
            hit = float(ranges[np.abs(rays - angle).argmin()])
            h = math.hypot(0.25, 0.25)
            if hit >= sensors.range:
                grid[row, column] = 127 if distance < sensors.range else 0
                edges = [sensors.range]
            else:
                grid[row, column] = 127 if distance < hit - h else 255 if distance <= hit + h else 0
                edges = [hit - h, hit + h]
            near_an_edge[row, column] = min(abs(distance - edge) for edge in edges) < 1e-4
    return grid, near_an_edge


SHARES = st.floats(0.0, 1.0, width=32) | st.just(1.0)
OTHERS = [SensorConfig(rays=61), SensorConfig(rays=7, field_of_view=60.0, range=30.0)]


@settings(max_examples=40, derandomize=True, deadline=None)
@example(sensors=CONFIG.sensors, shares=np.zeros(61, dtype=F))
@example(sensors=CONFIG.sensors, shares=np.ones(61, dtype=F))
@example(sensors=CONFIG.sensors, shares=np.where(np.arange(61) % 2, 0.2, 1.0).astype(F))
@given(sensors=st.sampled_from([CONFIG.sensors, *OTHERS]), shares=arrays.arrays(F, 61, elements=SHARES))
def test_every_cell_is_what_geometry_says(sensors, shares):
    """Of ranges that are shares of the sensor's."""
    config, ranges = SimConfig(sensors=sensors), shares[: sensors.rays] * F(sensors.range)
    expected, unsure = cell_by_cell(config, ranges)
    assert (grids(grid_table(config), ranges[None])[0] == expected)[~unsure].all()
    assert unsure.mean() < 0.1


def test_a_batch_is_its_cars():
    ranges = np.random.default_rng(2).uniform(0, 50, (20, 31)).astype(F)
    alone = np.full((20, CELLS * CELLS), 77, dtype=np.uint8)
    for row, grid in zip(ranges, alone, strict=True):
        fill_grid(TABLE, row, grid)
    assert (grids(TABLE, ranges).reshape(20, -1) == alone).all()
    assert (grids(TABLE, ranges[::2]).reshape(10, -1) == alone[::2]).all()
    assert grids(TABLE, ranges[:0]).shape == (0, 80, 80)


@settings(max_examples=20, derandomize=True, deadline=None)
@given(frames=st.integers(1, 5), begins=st.lists(st.booleans(), min_size=1, max_size=12))
def test_a_stack_holds_the_last_frames_newest_last(frames, begins):
    stack = np.zeros((2, frames, 80, 80), dtype=np.uint8)
    past: list[np.ndarray] = []
    rng = np.random.default_rng(4)
    for step, begin in enumerate(begins):
        new = rng.integers(0, 256, (2, 80, 80)).astype(np.uint8)
        begun = np.array([begin or step == 0, step == 0])
        push_frames(stack, new, begun)
        past.append(new)
        for car in range(2):
            first = max(k for k in range(step + 1) if k == 0 or (car == 0 and begins[k]))
            wanted = [past[max(k, first)][car] for k in range(step - frames + 1, step + 1)]
            assert (stack[car] == np.array(wanted)).all()
