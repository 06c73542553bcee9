"""The drivable area: the fields that kernels read, against the exact geometry of the strips."""

import numpy as np
import oracle
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pictures import read, small_map

from gridsim.maps.roads import CELLS_PER_M, FIELD_FLOOR, FIELD_UNITS, Strips, clearance_nodes

SIDE = 64.0  # m, of the small maps
CEILING = FIELD_FLOOR + 255 / FIELD_UNITS  # m, the greatest clearance a field can hold


@pytest.fixture(scope="module")
def scenario(maps):
    return maps["seamless"][0]


inside, half_width = st.floats(0, SIDE), st.floats(0.5, 6.0)
lines = st.tuples(inside, inside, inside, inside, half_width)
arcs = st.tuples(inside, inside, st.floats(1.0, 25.0), st.floats(-7, 7), st.floats(-6.2, 6.2), half_width)
blocks = st.tuples(inside, inside, st.floats(-7, 7), st.floats(0.5, 3.0), st.floats(0.5, 3.0))


@settings(max_examples=100, derandomize=True)
@given(st.lists(lines, max_size=3), st.lists(arcs, min_size=1, max_size=3), st.lists(blocks, max_size=2))
def test_nodes_are_exact_for_any_strips_and_blocks(lines, arcs, blocks):
    strips = Strips.of(lines, arcs, blocks)
    nodes = clearance_nodes(strips, SIDE, SIDE)
    j, i = np.meshgrid(*[np.arange(0, round(SIDE * CELLS_PER_M), 3)] * 2, indexing="ij")
    expected = oracle.ExactRoad(strips, SIDE, SIDE).clearance(np.column_stack([i.ravel(), j.ravel()]) / CELLS_PER_M)
    assert nodes[j, i].ravel() == pytest.approx(np.maximum(expected, FIELD_FLOOR), abs=1e-4)


@settings(derandomize=True)
@given(st.integers(0, 256 * 64 - 1), st.integers(0, 256 * 64 - 1), st.integers(-3, 2), st.integers(-2, 1))
def test_the_world_is_a_torus(scenario, x, y, i, j):
    x, y = x / 64, y / 64  # so that no bit is lost further out
    here, there = read(scenario.road, [[x, y], [x + 256 * i, y + 256 * j]])
    assert here == there


def test_clearance_on_a_straight_edge_is_exact_to_rounding_and_saturates():
    road_map, exact = small_map(lines=[[0, 30.3, 64, 30.3, 8.0]])
    y = np.concatenate([np.linspace(37.0, 39.9, 200), [30.3, 2.0]])  # from 1.3 m inside to 1.6 m outside; far off
    points = np.stack([np.linspace(0, 64, len(y)), y], axis=1)
    expected = np.clip(exact.clearance(points), FIELD_FLOOR, CEILING)
    assert read(road_map.road, points) == pytest.approx(expected, abs=0.5 / FIELD_UNITS + 2e-4)
    assert expected[-2:].tolist() == [CEILING, FIELD_FLOOR]
