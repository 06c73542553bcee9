"""The occupancy grid against geometry, cell by cell, and against the exact edges of real roads."""

import math

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from gridsim.config import SensorConfig, SimConfig
from gridsim.sensing.grid import grid_table, grids

F = np.float32
CONFIG = SimConfig()


def cell_by_cell(config, ranges):
    """The textbook, float64: each cell on its own, from its centre's angle and distance; where float32 may differ."""
    sensors, at = config.sensors, 0.5 * np.arange(80) + 0.25
    rays = np.radians(np.linspace(-sensors.field_of_view / 2, sensors.field_of_view / 2, sensors.rays))
    ahead, left = 40.0 - at[:, None], 20.0 - at
    angle, distance = np.arctan2(left, ahead), np.hypot(left, ahead)
    hit = ranges[np.abs(rays - angle[..., None]).argmin(axis=2)].astype(float)
    free = hit >= sensors.range
    near, far = (np.where(free, sensors.range, hit + h) for h in (-math.hypot(0.25, 0.25), math.hypot(0.25, 0.25)))
    seen = np.abs(angle) <= math.radians(sensors.field_of_view / 2)
    grid = np.where(distance < near, 127, np.where(~free & (distance <= far), 255, 0))
    near_an_edge = np.minimum(np.abs(distance - near), np.abs(distance - far)) < 1e-4
    return np.where(seen, grid, 0), seen & near_an_edge


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
