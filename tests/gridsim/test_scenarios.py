"""What holds of every map of every scenario, over many seeds; and what makes each scenario what it is."""

import hashlib
import math
import pickle
from types import SimpleNamespace

import numpy as np
import oracle
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pictures import crashes
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from gridsim.car.vehicle import Action
from gridsim.config import CROSSING_GAP
from gridsim.jit import freeze
from gridsim.maps.generators import curved, highway, roundabout
from gridsim.maps.map import sample_starts
from gridsim.maps.roads import CELLS_PER_UNIT, FIELD_FLOOR, FIELD_STEPS, Strips, clearance_nodes, clearances
from gridsim.maps.scenarios import REGISTRY, build
from gridsim.simulator import Simulator
from gridsim.state import SPEED, End

F = np.float32
ROUND = 215.0  # m, of the shortest loop: more than the 200 m within which ground driven again counts nothing
MEMORY = 8 * 2**20  # bytes of a map


def lay(name, seed):
    """Strips and lanes, of each lane the points float64 [n, 2] and the length (m), and the torus's sides (m)."""
    strips, lanes = REGISTRY[name].layout(np.random.default_rng(seed))
    points = np.split(lanes.points.astype(float), lanes.offsets[1:-1])
    lengths, sides = lanes.steps * (np.diff(lanes.offsets) - 1), np.array([lanes.width, lanes.height], dtype=float)
    return SimpleNamespace(strips=strips, lanes=lanes, points=points, lengths=lengths, sides=sides)


@pytest.fixture(scope="module", params=REGISTRY)
def name(request):
    return request.param


@pytest.fixture(scope="module")
def laid(name):
    return [lay(name, seed) for seed in range(16)]


@pytest.fixture(scope="module")
def built(name, maps):
    return maps[name]


def parts(scenario):
    return scenario.road, scenario.strips, scenario.network


def wrapped(away, sides):
    return away - np.round(away / sides) * sides


def headings(lane):
    """Tangents (rad) at the points [n, 2] of a lane: between those of the pieces on either side."""
    step = np.diff(lane, axis=0)
    angle = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    if len(angle) == 1:
        return np.repeat(angle, 2)
    inner = (angle[1:] + angle[:-1]) / 2
    return np.concatenate([[1.5 * angle[0] - 0.5 * angle[1]], inner, [1.5 * angle[-1] - 0.5 * angle[-2]]])


# --- Lanes -----------------------------------------------------------------------------------------------------------


def test_every_lane_goes_on_where_it_ends(laid):
    for m in laid:
        assert (m.lanes.successors[:, 0] >= 0).all()
        angles = [headings(points) for points in m.points]
        for i, successors in enumerate(m.lanes.successors):
            following = successors[successors >= 0].tolist()
            assert len(set(following)) == len(following)
            for j in following:
                assert np.abs(wrapped(m.points[j][0] - m.points[i][-1], m.sides)).max() < 1e-3
                turn = math.remainder(angles[j][0] - angles[i][-1], 2 * math.pi)
                assert abs(turn) < 0.06  # two flares of 8 m radius behind 0.3 m of straight, seen in steps of 1 m


def test_every_lane_is_found_by_a_predecessor_and_leads_back_to_itself(name, laid):
    """Each direction of the loop is a network of its own, and each lane of the highway: changes are no successors."""
    for m in laid:
        parts, _ = connected_components(lane_graph(m), connection="strong")
        assert parts == {"highway": highway.LANE_COUNT, "curved": 2}.get(name, 1)
        assert set(m.lanes.successors[m.lanes.successors >= 0].tolist()) == set(range(len(m.lanes.steps)))


def test_neighbours_are_each_others(name, laid):
    for m in laid:
        lanes = m.lanes
        for one, other in ((lanes.left, lanes.right), (lanes.right, lanes.left)):
            has = np.flatnonzero(one >= 0)
            assert (other[one[has]] == has).all()
        beside_another = (lanes.left >= 0) | (lanes.right >= 0)
        assert beside_another.all() if name == "highway" else not beside_another.any()
        for i in np.flatnonzero(lanes.left >= 0):
            angle = headings(m.points[i])
            to_left = 3.75 * np.stack([-np.sin(angle), np.cos(angle)], axis=1)
            assert m.points[lanes.left[i]] - m.points[i] == pytest.approx(to_left, abs=0.02)


def least_distance(one, other, sides):
    """From the points [n, 2] of one lane to the segments of another."""
    a = wrapped(other[None, :-1] - one[:, None], sides)
    d = np.diff(other, axis=0)
    t = np.clip(-(a * d).sum(axis=2) / (d * d).sum(axis=1), 0.0, 1.0)
    return float(np.linalg.norm(a + t[..., None] * d, axis=2).min())


def test_crossings_are_the_lanes_that_come_close(name, laid):
    """Against all pairs whose circles meet, in NumPy."""
    for m in laid[:2]:
        lanes, points = m.lanes, m.points
        crossings = [set(part.tolist()) for part in np.split(lanes.crossings, lanes.crossing_offsets[1:-1])]
        middle = np.array([p[len(p) // 2] for p in points])
        size = np.array([np.linalg.norm(p - c, axis=1).max() for p, c in zip(points, middle, strict=True)])
        for i, mine in enumerate(crossings):
            away = np.linalg.norm(wrapped(middle - middle[i], m.sides), axis=1) - size - size[i]
            near = np.flatnonzero(away < CROSSING_GAP).tolist()
            assert mine <= set(near)
            assert bool(mine) <= (name not in ("highway", "curved"))
            for j in near:
                fork = np.abs(wrapped(points[i][0] - points[j][0], m.sides)).max() < 0.1
                follows = j in lanes.successors[i] or i in lanes.successors[j]
                parallel = j in (lanes.left[i], lanes.right[i])
                assert (j in mine) == (i in crossings[j])
                if i == j or fork or follows or parallel:
                    assert j not in mine
                    continue
                distance = least_distance(points[i], points[j], m.sides)
                if abs(distance - CROSSING_GAP) > 0.01:
                    assert (j in mine) == (distance < CROSSING_GAP)


def lane_graph(m):
    one, k = np.nonzero(m.lanes.successors >= 0)
    return csr_array((m.lengths[one], (one, m.lanes.successors[one, k])), shape=(len(m.lengths), len(m.lengths)))


def test_no_loop_is_so_short_that_driving_it_counts_nothing(laid):
    for m in laid:
        graph = lane_graph(m)
        reach = dijkstra(graph, limit=1.5 * ROUND)  # from a lane's beginning to another's
        one, other = graph.nonzero()
        assert (m.lengths[one] + reach[other, one]).min() >= ROUND


# --- Roads -----------------------------------------------------------------------------------------------------------


def test_a_car_on_rails_touches_nothing(laid):
    """A car of 4 m x 2 m, its middle on the centre line, heading along it: its outline stays on the exact road."""
    for m in laid[:4]:
        exact = oracle.ExactRoad(m.strips, *m.sides)
        poses = [np.column_stack([points, headings(points)]) for points in m.points]
        assert exact.outline_on_road(np.concatenate(poses), 2.0, 1.0).all()


SIDE = 64.0  # m, of the maps of any strips and blocks
inside, half_width = st.floats(0, SIDE), st.floats(0.5, 6.0)
lines = st.tuples(inside, inside, inside, inside, half_width)
arcs = st.tuples(inside, inside, st.floats(1.0, 25.0), st.floats(-7, 7), st.floats(-6.2, 6.2), half_width)
blocks = st.tuples(inside, inside, st.floats(-7, 7), st.floats(0.5, 3.0), st.floats(0.5, 3.0))


@settings(max_examples=100, derandomize=True)
@given(st.lists(lines, max_size=3), st.lists(arcs, min_size=1, max_size=3), st.lists(blocks, max_size=2))
def test_nodes_are_exact_for_any_strips_and_blocks(lines, arcs, blocks):
    strips = Strips.of(lines, arcs, blocks)
    nodes = clearance_nodes(strips, SIDE, SIDE)
    j, i = np.meshgrid(*[np.arange(0, round(SIDE * CELLS_PER_UNIT), 3)] * 2, indexing="ij")
    expected = oracle.ExactRoad(strips, SIDE, SIDE).clearance(np.column_stack([i.ravel(), j.ravel()]) / CELLS_PER_UNIT)
    assert nodes[j, i].ravel() == pytest.approx(np.maximum(expected, FIELD_FLOOR), abs=1e-4)


def test_the_field_is_the_exact_road(built):
    for scenario in built:
        exact = oracle.ExactRoad(scenario.strips, float(scenario.road.width), float(scenario.road.height))
        rng = np.random.default_rng(scenario.seed)
        lanes = scenario.network.points[rng.integers(len(scenario.network.points), size=6000)]
        points = (lanes + rng.uniform(-9.0, 9.0, lanes.shape)).astype(F)
        true = exact.clearance(points)
        error = clearances(scenario.road, freeze(points))
        error -= np.clip(true, FIELD_FLOOR, FIELD_FLOOR + 255 / FIELD_STEPS)
        near = np.abs(true) < 0.5
        assert near.sum() > 300
        assert np.abs(error).max() < 0.4  # where a block's corner or two strips' edges meet in a point
        assert np.quantile(np.abs(error[near]), 0.9) < 0.5 / FIELD_STEPS + 0.005
        assert abs(error[near].mean()) < 0.01


def test_starts_are_at_rest_all_over_the_road_and_not_in_a_wall(built):
    for scenario in built:
        starts = sample_starts(scenario, 2000, np.random.default_rng(scenario.seed))
        assert not crashes(scenario.road, starts).any()
        assert (starts[:, 3:] == 0.0).all()
        sides = [scenario.road.width, scenario.road.height]
        tiles, roads = (len(np.unique(at[:, :2] % sides // 32, axis=0)) for at in (starts, scenario.network.points))
        assert tiles >= 0.85 * roads  # points lie on the sides of tiles, too


def test_a_map_is_small_and_survives_pickling(built):
    for scenario in built:
        assert scenario.nbytes <= MEMORY
        again = pickle.loads(pickle.dumps(scenario))
        assert (again.name, again.seed, again.torus) == (scenario.name, scenario.seed, True)
        for mine, other in ((scenario.road, again.road), (scenario.network, again.network)):
            assert [type(part) for part in mine] == [type(part) for part in other]
            assert not any(part.flags.writeable for part in other)
        np.testing.assert_equal(parts(again), parts(scenario))


def test_the_same_seed_is_the_same_map_and_another_is_another(name, built):
    again = build(name, built[0].seed)
    np.testing.assert_equal(parts(again), parts(built[0]))
    assert again.road.field.tobytes() != built[1].road.field.tobytes()


def test_no_road_can_be_driven_without_steering(name):
    """64 drives on each of eight maps that accelerate up to a speed and never steer."""
    eight = [build(name, seed) for seed in range(8)]
    starts = np.concatenate([sample_starts(scenario, 64, np.random.default_rng(scenario.seed)) for scenario in eight])
    simulator = Simulator(512)
    for pace in (5.5, 7.0, 12.0):
        simulator.reset([scenario for scenario in eight for _ in range(64)], starts)
        while (simulator.ends == End.RUNNING).any():
            simulator.step(np.where(simulator.cars[:, SPEED] < pace, Action.ACCELERATE, Action.NONE))
        assert (simulator.ends == End.SUCCESS).mean() <= 0.02


# --- Each of them ----------------------------------------------------------------------------------------------------

# Of field and strips. Since the shipped champion was trained, a T junction has one strip more, and the field more
# clearance in its middle; seed 0 had a straight road round the torus and was drawn again; all else is as it was.
SEAMLESS = {0: "3cd0fb77519132c6", 7: "b23c0c627ab8ed64", 2_000_000: "6214ddc76ecd3133"}


@pytest.mark.parametrize("seed", SEAMLESS)
def test_seamless_maps_are_what_they_were(seed):
    scenario = build("seamless", seed)
    digest = hashlib.sha256()
    for part in (scenario.road.field, scenario.strips.lines, scenario.strips.arcs, scenario.network.successors):
        digest.update(part.tobytes())
    assert digest.hexdigest()[:16] == SEAMLESS[seed]


def test_curved_loops_wind_both_ways_and_keep_apart():
    for seed in range(40):
        m = lay("curved", seed)
        n = len(m.lengths) // 2
        assert m.lengths[:n].sum() >= 450.0 - 2 * math.pi * 1.75
        sweeps = m.strips.arcs[:, 4]
        assert min((sweeps > 0.3).sum(), (sweeps < -0.3).sum()) >= 2
        assert m.strips.arcs[:, 2].min() >= curved.RADIUS[0] - 1e-9
        points = np.concatenate(m.points[:n])  # one direction, all the way round
        at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        apart = np.abs(at[:, None] - at)
        apart = np.minimum(apart, at[-1] - apart)
        away = np.linalg.norm(points[:, None] - points[None], axis=2)
        # The lane is 1.75 m beside the middle of either road.
        assert away[apart > 30.0].min() > 2 * curved.HALF_ROAD + curved.GAP - 2 * 1.75


def test_roundabouts_are_many_and_nothing_else_is_a_junction():
    for seed in range(40):
        m = lay("roundabout", seed)
        rings = m.strips.arcs[np.abs(m.strips.arcs[:, 4]) > 6.0]
        assert len(rings) >= roundabout.FEWEST
        for i in np.flatnonzero((m.lanes.successors >= 0).sum(axis=1) > 1):
            for j in m.lanes.successors[i][m.lanes.successors[i] >= 0]:
                away = wrapped(m.points[j].mean(axis=0) - rings[:, :2], m.sides)
                assert np.linalg.norm(away, axis=1).min() < 16.0


def test_parked_cars_stand_beside_the_lanes():
    for seed in range(40):
        m = lay("city", seed)
        blocks = m.strips.blocks
        assert len(blocks) >= 10
        assert {tuple(size) for size in blocks[:, 3:]} == {(2.0, 0.9)}
        away = wrapped(np.concatenate(m.points)[:, None] - blocks[:, :2], m.sides)
        c, s = np.cos(blocks[:, 2]), np.sin(blocks[:, 2])
        u, v = np.abs(away[..., 0] * c + away[..., 1] * s), np.abs(away[..., 1] * c - away[..., 0] * s)
        gap = np.hypot(np.maximum(u - 2.0, 0), np.maximum(v - 0.9, 0)).min(axis=0)
        assert 1.5 <= gap.min() <= gap.max() < 3.0
        # Their middles are a metre or more inside a bay.
        lines = m.strips.lines
        along, away = lines[:, 2:4] - lines[:, :2], wrapped(blocks[:, None, :2] - lines[:, :2], m.sides)
        share = np.clip((away * along).sum(axis=2) / (along * along).sum(axis=1), 0.0, 1.0)
        inside = lines[:, 4] - np.linalg.norm(away - share[..., None] * along, axis=2)
        assert inside.max(axis=1).min() >= 1.0 - 1e-9
        # No two overlap: centres along and across the street.
        apart = np.abs(wrapped(blocks[:, None, :2] - blocks[:, :2], m.sides)).max(axis=2)
        assert apart[~np.eye(len(blocks), dtype=bool)].min() > 4.1
