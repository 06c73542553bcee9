"""The drivable area: the fields that kernels read, against the exact geometry of the strips."""

import math

import numpy as np
import oracle
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gridsim.maps.map import ROAD_FIELDS, Map
from gridsim.maps.roads import (
    CELLS_PER_M,
    FIELD_FLOOR,
    FIELD_UNITS,
    HEADING_BINS,
    START_CELLS_PER_M,
    START_UNITS,
    Strips,
    clearance,
    clearance_nodes,
    freeze,
    make_road,
    power_of_two,
)
from gridsim.maps.scenarios import build

F = np.float32
SIDE = 64.0  # m, of the small maps
CEILING = FIELD_FLOOR + 255 / FIELD_UNITS  # m, the greatest clearance a field can hold


@pytest.fixture(scope="module")
def scenario():
    return build("seamless", 7)


@pytest.fixture(scope="module")
def exact(scenario):
    return oracle.ExactRoad(scenario.strips, float(scenario.road.width), float(scenario.road.height))


def small_road(lines=(), arcs=(), side=SIDE):
    strips = Strips(np.array(lines, dtype=float).reshape(-1, 5), np.array(arcs, dtype=float).reshape(-1, 6))
    return make_road(clearance_nodes(strips, side, side), (5.0, 12.0), 50.0), oracle.ExactRoad(strips, side, side)


def read(road, points):
    return np.array([clearance(road, F(x), F(y)) for x, y in points])


# --- The oracle itself -----------------------------------------------------------------------------------------------


def test_the_oracles_two_halves_agree(exact):
    """Rays are intersections, clearance is distances: walk along rays in steps of 2 cm and look where they leave."""
    rng = np.random.default_rng(0)
    points = rng.uniform(0.0, 256.0, (2000, 2))
    points = points[exact.clearance(points) > 0.05][:60]
    angles = rng.uniform(-math.pi, math.pi, (len(points), 2))
    ranges = exact.cast(points, angles, 50.0)
    t = np.arange(0.0, 50.0, 0.02)
    grazing = 0
    for (x, y), angle, reach in zip(np.repeat(points, 2, axis=0), angles.ravel(), ranges.ravel(), strict=True):
        along = np.stack([x + t * math.cos(angle), y + t * math.sin(angle)], axis=1)
        inside = exact.clearance(along) >= 0.0
        left = t[np.argmin(inside)] if not inside.all() else 50.0
        if abs(left - reach) > 0.02 + 1e-9:
            # A chord of less than a step off the road may be stepped over; nothing else may differ.
            assert left > reach
            assert exact.clearance(along[t <= left]).min() < 0.02
            grazing += 1
    assert grazing <= 2


def test_the_oracle_knows_a_ring_and_a_strip():
    _, ring = small_road(arcs=[[32, 32, 10, 1.0, 2 * math.pi, 3]])
    points = [[42, 32], [45, 32], [46, 32], [32, 39], [32, 38], [32, 24.5]]
    assert ring.clearance(np.array(points, dtype=float)) == pytest.approx([3, 0, -1, 0, -1, 0.5])
    # From the middle of the ring outwards, inwards, and along the tangent to the outer edge.
    ranges = ring.cast(np.array([[42.0, 32.0]]), np.array([[0.0, math.pi, math.pi / 2]]), 50.0)
    assert ranges[0] == pytest.approx([3.0, 3.0, math.sqrt(13**2 - 10**2)])
    _, strip = small_road(lines=[[0, 32, 64, 32, 4]])  # goes round the torus
    ranges = strip.cast(np.array([[60.0, 33.0]]), np.array([[0.0, math.pi / 2, -math.pi / 6]]), 50.0)
    assert ranges[0] == pytest.approx([50.0, 3.0, 10.0])
    poses = [[60, 32, 0], [60, 35, 0], [60, 35.01, 0], [60, 33.9, math.pi / 2], [60, 34.1, math.pi / 2]]
    on_road = strip.outline_on_road(np.array(poses, dtype=float), 2.0, 1.0)
    assert on_road.tolist() == [True, True, False, True, False]


# --- The field -------------------------------------------------------------------------------------------------------


strips_of_any_kind = st.builds(
    lambda lines, arcs: (lines, arcs),
    st.lists(st.tuples(*[st.floats(0, SIDE)] * 4, st.floats(0.5, 6.0)), max_size=3),
    st.lists(
        st.tuples(
            *[st.floats(0, SIDE)] * 2, st.floats(1.0, 25.0), st.floats(-7, 7), st.floats(-6.2, 6.2), st.floats(0.5, 6.0)
        ),
        max_size=3,
    ),
)


@settings(max_examples=60, derandomize=True)
@given(strips=strips_of_any_kind)
def test_nodes_are_exact_for_any_strips(strips):
    lines, arcs = (np.array(s, dtype=float).reshape(-1, n) for s, n in zip(strips, (5, 6), strict=True))
    nodes = clearance_nodes(Strips(lines, arcs), SIDE, SIDE)
    n = round(SIDE * CELLS_PER_M)
    assert nodes.shape == (n, n)
    x, y = np.meshgrid(np.arange(0, n, 3) / CELLS_PER_M, np.arange(0, n, 3) / CELLS_PER_M)
    expected = oracle.ExactRoad(Strips(lines, arcs), SIDE, SIDE).clearance(np.stack([x.ravel(), y.ravel()], axis=1))
    assert nodes[::3, ::3].ravel() == pytest.approx(np.maximum(expected, FIELD_FLOOR), abs=1e-4)


@pytest.mark.parametrize("sweep", [-90.0, -45.0, 30.0, 60.0, 90.0, 100.0])
def test_nodes_are_exact_for_arcs_turned_any_way(sweep):
    """The band of nodes that an arc is written to has to hold its bulge between its ends and its middle."""
    for first in np.arange(0.0, 360.0, 11.25):
        arc = np.array([[32.3, 31.8, 24.0, math.radians(first), math.radians(sweep), 1.0]])
        nodes = clearance_nodes(Strips(np.zeros((0, 5)), arc), SIDE, SIDE)
        n = np.arange(0, round(SIDE * CELLS_PER_M), 2)
        x, y = np.meshgrid(n / CELLS_PER_M, n / CELLS_PER_M)
        exact = oracle.ExactRoad(Strips(np.zeros((0, 5)), arc), SIDE, SIDE)
        expected = exact.clearance(np.stack([x.ravel(), y.ravel()], axis=1), deepest=-FIELD_FLOOR)
        assert nodes[::2, ::2].ravel() == pytest.approx(expected, abs=1e-4)


def test_without_a_torus_the_sides_are_not_joined():
    strips = Strips(np.array([[2.0, 32.0, 20.0, 32.0, 4.0]]), np.zeros((0, 6)))
    joined, apart = clearance_nodes(strips, SIDE, SIDE), clearance_nodes(strips, SIDE, SIDE, torus=False)
    assert joined[64, -2] > 0.0  # x = 63: the strip's round end reaches over the side
    assert apart[64, -2] == FIELD_FLOOR
    assert (apart[:, :60] == joined[:, :60]).all()


def test_clearance_at_the_nodes_is_the_field_to_half_a_unit():
    rng = np.random.default_rng(1)
    strips = Strips(np.array([[0, 20, 64, 20, 4.0]]), np.array([[32, 40, 12, 0.3, 4.0, 3.0]]))
    nodes = clearance_nodes(strips, SIDE, SIDE)
    road = make_road(nodes, (5.0, 12.0), 50.0)
    i, j = rng.integers(128, size=(2, 500))
    got = read(road, np.stack([i, j], axis=1) / CELLS_PER_M)
    assert got == pytest.approx(nodes[j, i], abs=0.5 / FIELD_UNITS + 1e-5)


def test_clearance_against_the_oracle(scenario, exact):
    rng = np.random.default_rng(2)
    points = rng.uniform(0.0, 256.0, (20_000, 2)).astype(F)
    error = read(scenario.road, points) - np.clip(exact.clearance(points), FIELD_FLOOR, CEILING)
    # A clearance changes by 1 m a metre at most, a cell is half a metre: worst where two strips meet in a point.
    assert np.abs(error).max() < 0.26
    near = np.abs(exact.clearance(points)) < 0.5
    assert near.sum() > 1000
    print(f"clearance within 0.5 m of an edge: p50 {np.median(np.abs(error[near])):.4f} m, ", end="")
    print(f"p99 {np.quantile(np.abs(error[near]), 0.99):.4f} m, worst {np.abs(error[near]).max():.4f} m")
    assert np.quantile(np.abs(error[near]), 0.98) < 0.5 / FIELD_UNITS + 0.005
    assert abs(error[near].mean()) < 0.002


def test_clearance_on_a_straight_edge_is_exact_to_rounding():
    road, exact = small_road(lines=[[0, 30.3, 64, 30.3, 4.0]])
    y = np.linspace(33.0, 35.9, 200)  # from 1.3 m inside to 1.6 m outside
    points = np.stack([np.linspace(0, 64, 200), y], axis=1)
    assert read(road, points) == pytest.approx(exact.clearance(points), abs=0.5 / FIELD_UNITS + 2e-4)


def test_clearance_saturates():
    road, _ = small_road(lines=[[0, 32, 64, 32, 20.0]])
    assert clearance(road, F(10.0), F(32.0)) == pytest.approx(CEILING, abs=1e-5)
    assert clearance(road, F(10.0), F(2.0)) == pytest.approx(FIELD_FLOOR, abs=1e-5)


@settings(derandomize=True)
@given(
    x=st.integers(0, 256 * 64 - 1),
    y=st.integers(0, 256 * 64 - 1),
    i=st.sampled_from([-3, -1, 1, 2]),
    j=st.sampled_from([-2, 0, 1]),
)
def test_the_world_is_a_torus(scenario, x, y, i, j):
    x, y = x / 64, y / 64  # so that no bit is lost further out
    here = clearance(scenario.road, F(x), F(y))
    assert here == clearance(scenario.road, F(x + 256 * i), F(y + 256 * j))


@pytest.mark.parametrize(("width", "height"), [(96.0, 64.0), (64.0, 100.0), (0.0, 64.0), (4096.0, 4096.0)])
def test_sides_that_do_not_fit_are_refused(width, height):
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        clearance_nodes(Strips(np.zeros((0, 5)), np.zeros((0, 6))), width, height)


@given(n=st.floats(0.01, 1e6))
def test_power_of_two(n):
    power = power_of_two(n)
    assert power.bit_count() == 1
    assert power >= n
    assert power == 1 or power / 2 < n


# --- The start table -------------------------------------------------------------------------------------------------


def start_ranges(road, points, angles):
    """The table's range (m) for rays from points [n, 2] at angles [n]; nan where it has no row."""
    x, y = np.floor(points * START_CELLS_PER_M).astype(int).T
    columns, rows = int(road.width) * START_CELLS_PER_M, int(road.height) * START_CELLS_PER_M
    row = road.start_row[y % rows * columns + x % columns]
    bins = (np.floor(angles * HEADING_BINS / (2 * math.pi)) % HEADING_BINS).astype(int)
    return np.where(row >= 0, start_table(road)[row, bins] / START_UNITS, np.nan)


def start_table(road):
    return road.start.reshape(road.start_row.max() + 1, -1)


@pytest.mark.parametrize("seed", [0, 5])
def test_no_start_range_exceeds_the_true_range(seed):
    scenario = build("seamless", seed)
    exact = oracle.ExactRoad(scenario.strips, 256.0, 256.0)
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, 256.0, (40_000, 2))
    points = points[exact.clearance(points) > 0.0]
    angles = rng.uniform(-math.pi, math.pi, len(points))
    true = exact.cast(points, angles[:, None], 50.0)[:, 0]
    start = start_ranges(scenario.road, points, angles)
    assert not np.isnan(start).any()  # wherever a point is on the road, the table has a row
    assert (start - true).max() < 0.05
    # It is there to save steps: on the road's inner metres it covers most of the way.
    inner = exact.clearance(points) > 1.0
    share = start[inner].sum() / true[inner].sum()
    print(f"start table, seed {seed}: {share:.2f} of the way, worst excess {(start - true).max():.3f} m")
    assert share > 0.35


def test_no_start_range_exceeds_the_true_range_on_a_wide_road():
    road, exact = small_road(lines=[[0, 32, 64, 32, 16.0]])
    rng = np.random.default_rng(1)
    points = np.stack([rng.uniform(0.0, 64.0, 10_000), rng.uniform(16.0, 48.0, 10_000)], axis=1)
    angles = rng.uniform(-math.pi, math.pi, len(points))
    assert (start_ranges(road, points, angles) - exact.cast(points, angles[:, None], 50.0)[:, 0]).max() < 0.05


def test_the_table_repeats_its_first_bins_behind_the_last(scenario):
    table = start_table(scenario.road)
    extra = table.shape[1] - HEADING_BINS
    assert extra > 0
    assert (table[:, HEADING_BINS:] == table[:, np.arange(extra) % HEADING_BINS]).all()


def test_in_the_open_the_table_reaches_as_far_as_the_field_can_tell():
    road, _ = small_road(lines=[[0, 0, 64, 0, 40.0], [0, 32, 64, 32, 40.0]])  # road everywhere
    assert (road.start_row >= 0).all()
    assert (road.start == 50 * START_UNITS).all()


# --- Arrays and back -------------------------------------------------------------------------------------------------


def test_arrays_and_back(scenario):
    arrays = scenario.arrays()
    assert all(isinstance(a, np.ndarray) and a.dtype != object for a in arrays.values())
    again = Map.from_arrays({key: value.copy() for key, value in arrays.items()})
    assert (again.name, again.seed, again.torus) == (scenario.name, scenario.seed, scenario.torus)
    for name in scenario.road._fields:
        one, other = getattr(scenario.road, name), getattr(again.road, name)
        assert one.dtype == other.dtype
        assert np.array_equal(one, other)
    for mine, other in ((scenario.lanes, again.lanes), (scenario.strips, again.strips)):
        for name, value in vars(mine).items():
            assert value.dtype == getattr(other, name).dtype
            assert np.array_equal(value, getattr(other, name))
    assert set(ROAD_FIELDS) < set(scenario.road._fields)


def test_what_kernels_read_is_read_only(scenario):
    arrays = [a for a in scenario.road if isinstance(a, np.ndarray)]
    arrays += [scenario.lanes.points, scenario.lanes.offsets, scenario.lanes.successors]
    arrays += [scenario.strips.lines, scenario.strips.arcs]
    for array in arrays:
        assert array.flags.c_contiguous
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


def test_freeze_copies_only_what_it_must():
    whole = np.arange(12.0).reshape(3, 4)
    assert freeze(whole) is whole
    part = freeze(whole[:, ::2])
    assert part.flags.c_contiguous
    assert not np.shares_memory(part, whole)
