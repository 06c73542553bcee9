"""The occupancy grid against geometry, cell by cell, and against the exact edges of real roads."""

import math

import numpy as np
import oracle
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from gridsim.car.ego import COS, SIN, X, Y
from gridsim.config import SensorConfig, SimConfig
from gridsim.envs.simulator import Simulator
from gridsim.maps.map import sample_starts
from gridsim.maps.scenarios import build
from gridsim.sensing.grid import (
    CELL,
    CELLS,
    FREE,
    OCCUPIED,
    UNKNOWN,
    centres,
    fill_grid,
    grid_table,
    grids,
    push_frames,
)

F = np.float32
CONFIG = SimConfig()
TABLE = grid_table(CONFIG)
REACH = CONFIG.sensors.range


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


def one(ranges, table=TABLE):
    return grids(table, np.asarray(ranges, dtype=F)[None])[0]


@settings(max_examples=40, derandomize=True, deadline=None)
@example(ranges=np.zeros(31, dtype=F))
@example(ranges=np.full(31, REACH, dtype=F))
@example(ranges=np.where(np.arange(31) % 2, 10.0, REACH).astype(F))
@given(ranges=arrays.arrays(F, 31, elements=st.one_of(st.floats(0, 50, width=32), st.just(50.0))))
def test_every_cell_is_what_geometry_says(ranges):
    expected, unsure = cell_by_cell(CONFIG, ranges)
    assert (one(ranges) == expected)[~unsure].all()
    assert unsure.mean() < 0.1


@pytest.mark.parametrize("sensors", [SensorConfig(rays=61), SensorConfig(rays=7, field_of_view=60.0, range=30.0)])
def test_other_sensors(sensors):
    config = SimConfig(sensors=sensors)
    table = grid_table(config)
    rng = np.random.default_rng(1)
    for _ in range(5):
        ranges = np.minimum(rng.uniform(0, 1.3 * sensors.range, sensors.rays), sensors.range).astype(F)
        expected, unsure = cell_by_cell(config, ranges)
        assert (one(ranges, table) == expected)[~unsure].all()


def test_ahead_is_up_and_left_is_left():
    ranges = np.full(31, 2.0, dtype=F)
    ranges[15:17] = 30.0  # straight ahead, and 4 degrees to the left
    grid = one(ranges)
    assert grid[79 - 30, 39] == FREE  # 15 m ahead
    assert grid[79 - 59, 39] == OCCUPIED  # 30 m ahead
    assert grid[79 - 64, 39] == UNKNOWN
    far = np.argwhere(grid[:70] == FREE)
    assert far[:, 1].min() < 39  # the second ray is left of the middle: lower columns
    assert far[:, 1].max() <= 41  # half a step of 4 degrees to the right, 15 m away
    ahead, left = centres()
    assert ahead[0, 0] == 39.75
    assert ahead[79, 79] == 0.25
    assert left[0, 0] == 19.75
    assert left[79, 79] == -19.75
    assert (CELLS, CELL) == (80, 0.5)


def test_a_batch_is_its_cars():
    ranges = np.random.default_rng(2).uniform(0, 50, (20, 31)).astype(F)
    alone = np.full((20, CELLS * CELLS), 77, dtype=np.uint8)
    for row, grid in zip(ranges, alone, strict=True):
        fill_grid(TABLE, row, grid)
    assert (grids(TABLE, ranges).reshape(20, -1) == alone).all()
    assert (grids(TABLE, ranges[::2]).reshape(10, -1) == alone[::2]).all()
    assert grids(TABLE, ranges[:0]).shape == (0, 80, 80)


# --- Real roads ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scenes():
    """Grids [n, 80, 80] seen on a road, how far each cell's centre is from the road's edge [n, 80, 80] (m, positive on
    the road), and whether a straight line leads there on the road."""
    scenario = build("seamless", 5)
    exact = oracle.ExactRoad(scenario.strips, 256.0, 256.0)
    rng = np.random.default_rng(3)
    simulator = Simulator([scenario], 40)
    ranges, _ = simulator.reset(sample_starts(scenario, 40, rng))
    cars = simulator.state.cars
    ahead, left = centres()
    axle = CONFIG.vehicle.wheelbase - CONFIG.vehicle.rear_axle
    clearances, visible = [], []
    for car in cars.astype(float):
        x = car[X] + (axle + ahead) * car[COS] - left * car[SIN]
        y = car[Y] + (axle + ahead) * car[SIN] + left * car[COS]
        clearances.append(exact.clearance(np.stack([x.ravel(), y.ravel()], axis=1)).reshape(80, 80))
        heading = math.atan2(car[SIN], car[COS])
        origin = np.array([[car[X] + axle * car[COS], car[Y] + axle * car[SIN]]])
        free_way = exact.cast(origin, heading + np.arctan2(left, ahead).reshape(1, -1), 50.0).reshape(80, 80)
        visible.append(np.hypot(ahead, left) < free_way)
    return grids(TABLE, ranges), np.array(clearances), np.array(visible)


def test_free_cells_are_on_the_road(scenes):
    seen, clearance, visible = scenes
    free = seen == FREE
    assert 0.05 < free.mean() < 0.5
    # Rays are 4 degrees apart: at 30 m a cell is up to 1 m beside the ray that speaks for it.
    assert (clearance[free] > 0.0).mean() > 0.98
    assert visible[free].mean() > 0.96
    assert (clearance[free] > -0.5).mean() > 0.99


def test_occupied_cells_are_at_the_edge_of_the_road(scenes):
    seen, clearance, _ = scenes
    occupied = seen == OCCUPIED
    assert 20 < occupied.sum(axis=(1, 2)).mean() < 200
    assert np.quantile(np.abs(clearance[occupied]), 0.9) < 0.8
    assert np.median(np.abs(clearance[occupied])) < 0.35


def test_what_can_be_seen_is_seldom_unknown(scenes):
    seen, _, visible = scenes
    ahead, left = centres()
    inside = np.abs(left) <= math.tan(math.radians(60.0)) * ahead
    assert (seen == UNKNOWN)[visible & inside].mean() < 0.05
    assert (seen[:, ~inside] == UNKNOWN).all()


# --- Frames ----------------------------------------------------------------------------------------------------------


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
