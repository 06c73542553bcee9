"""The generator of the seamless road: what holds of every map, over hundreds of seeds."""

import math
from collections import Counter, deque

import numpy as np
import pytest

from gridsim.car.ego import collides
from gridsim.config import SimConfig, constants
from gridsim.maps.generators.seamless import (
    DIRECTIONS,
    FLARE_HALF,
    HALF_ROAD,
    LANE_WIDTH,
    ROUNDABOUT_HALF,
    SHORTEST_BLOCK,
    TILE,
    TILES,
    seamless_layout,
    tile_graph,
)
from gridsim.maps.lanes import LANE_STEP
from gridsim.maps.map import sample_starts
from gridsim.maps.scenarios import HELD_OUT_SEED, TRAINING_SEED, VALIDATION_SEED, build

SEEDS = range(300)  # of which graphs are looked at
LAID = range(60)  # ... lanes and strips
BUILT = (0, 1, 17, VALIDATION_SEED, HELD_OUT_SEED)  # ... whole maps
SIDE = TILE * TILES  # m


def layout(seed):
    return seamless_layout(np.random.default_rng(seed))


@pytest.fixture(scope="module")
def graphs():
    return [tile_graph(np.random.default_rng(seed)) for seed in SEEDS]


@pytest.fixture(scope="module")
def laid():
    return [layout(seed) for seed in LAID]


@pytest.fixture(scope="module")
def built():
    return [build("seamless", seed) for seed in BUILT]


def neighbour(tile, d):
    dx, dy = DIRECTIONS[d]
    return (tile // TILES + dy) % TILES * TILES + (tile % TILES + dx) % TILES


def shortest_block(edges):
    """Tiles around the smallest block, on the plane that the torus is rolled from (a way round the torus is none).

    For each edge: the way from its tile to the other end without that edge, found on unrolled coordinates.
    """
    best = math.inf
    for tile in range(len(edges)):
        for d in (0, 1):
            if not edges[tile, d]:
                continue
            goal = DIRECTIONS[d]
            seen, queue = {(0, 0): 0}, deque([((0, 0), tile)])
            while queue and goal not in seen:
                (x, y), here = queue.popleft()
                if seen[x, y] + 2 > min(best, 2 * SHORTEST_BLOCK):
                    break
                for e in range(4):
                    place = (x + DIRECTIONS[e][0], y + DIRECTIONS[e][1])
                    crossed = {((x, y), place), (place, (x, y))}
                    if edges[here, e] and ((0, 0), goal) not in crossed and place not in seen:
                        seen[place] = seen[x, y] + 1
                        queue.append((place, neighbour(here, e)))
            best = min(best, seen.get(goal, math.inf) + 1)
    return best


# --- Graphs ----------------------------------------------------------------------------------------------------------


def test_every_open_edge_meets_one(graphs):
    for edges in graphs:
        for tile in range(TILES * TILES):
            for d in range(4):
                assert edges[tile, d] == edges[neighbour(tile, d), (d + 2) % 4]


def test_there_are_no_dead_ends(graphs):
    degrees = Counter(int(n) for edges in graphs for n in edges.sum(axis=1))
    assert degrees[1] == 0
    assert set(degrees) == {0, 2, 3, 4}


def test_every_network_is_connected_and_large(graphs):
    for edges in graphs:
        used = set(np.flatnonzero(edges.any(axis=1)).tolist())
        assert len(used) >= TILES * TILES // 2
        reached, stack = set(), [min(used)]
        while stack:
            tile = stack.pop()
            if tile not in reached:
                reached.add(tile)
                stack += [neighbour(tile, d) for d in range(4) if edges[tile, d]]
        assert reached == used


def test_no_block_is_shorter_than_ten_tiles(graphs):
    lengths = [shortest_block(edges) for edges in graphs]
    assert min(lengths) == SHORTEST_BLOCK == 10


def test_seeds_differ(graphs):
    assert len({edges.tobytes() for edges in graphs}) == len(graphs)


def kind(edges, tile):
    arms = np.flatnonzero(edges[tile])
    return {0: "none", 3: "T", 4: "crossing"}.get(len(arms)) or ("straight" if arms[1] - arms[0] == 2 else "curve")


def test_all_kinds_of_tiles_appear_turned_all_ways(graphs):
    seen = Counter(tuple(map(bool, row)) for edges in graphs for row in edges)
    kinds = Counter(kind(edges, tile) for edges in graphs for tile in range(TILES * TILES))
    assert set(kinds) == {"none", "straight", "curve", "T", "crossing"}
    assert len(seen) == 12  # none; 2 straights, 4 curves, 4 Ts, 1 crossing
    total = sum(kinds.values())
    assert all(kinds[k] > 0.02 * total for k in kinds)
    print({k: round(n / total, 3) for k, n in kinds.items()})


# --- Lanes -----------------------------------------------------------------------------------------------------------


def ends(lanes, i):
    """First and last point of a lane, and the directions there."""
    points = lanes.lane(i).astype(float)
    first, last = points[1] - points[0], points[-1] - points[-2]
    return points[0], points[-1], math.atan2(first[1], first[0]), math.atan2(last[1], last[0])


def test_every_lane_goes_on_where_it_ends(laid):
    """Position and heading of a lane's end are those of its successors' beginnings, round the torus."""
    for _, lanes, width, height in laid:
        assert (lanes.successors[:, 0] >= 0).all()
        assert lanes.successors.max() < len(lanes)
        at = [ends(lanes, i) for i in range(len(lanes))]
        for i in range(len(lanes)):
            following = lanes.successors[i][lanes.successors[i] >= 0]
            assert len(set(following.tolist())) == len(following)
            for j in following:
                away = at[j][0] - at[i][1]
                assert np.abs(away - np.round(away / [width, height]) * [width, height]).max() < 1e-3
                # A polyline's first and last pieces differ from its tangent by half a step of 1 m on its radius.
                assert abs(math.remainder(at[j][2] - at[i][3], 2 * math.pi)) < 1.0 / (TILE / 2 - LANE_WIDTH / 2)


def test_from_every_lane_every_other_can_be_reached(laid):
    for _, lanes, _, _ in laid:
        one, other = np.nonzero(lanes.successors >= 0)
        pairs = (one, lanes.successors[one, other])
        for start, goal in (pairs, pairs[::-1]):  # forwards all are reached from lane 0, backwards it is from all
            reached = np.zeros(len(lanes), dtype=bool)
            reached[0] = True
            for _ in range(len(lanes)):
                before = reached.sum()
                reached[goal[reached[start]]] = True
                if reached.sum() == before:
                    break
            assert reached.all()


def test_points_of_a_lane_are_a_metre_apart_at_most(laid):
    for _, lanes, _, _ in laid:
        for i in range(len(lanes)):
            step = np.linalg.norm(np.diff(lanes.lane(i).astype(float), axis=0), axis=1)
            assert step.max() <= LANE_STEP * 1.05
            assert step.min() > 0.1


def test_lanes_keep_to_the_right(laid):
    """On a tile's edge a lane enters and leaves half a lane's width to the right of the road's centre line."""
    for _, lanes, _, _ in laid[:10]:
        for i in range(len(lanes)):
            first, last, heading, leaving = ends(lanes, i)
            for point, angle in ((first, heading), (last, leaving)):
                angle = round(angle / (math.pi / 2)) * math.pi / 2
                middle = (np.floor(point / TILE + 1e-6) + 0.5) * TILE
                right = np.array([math.sin(angle), -math.cos(angle)])
                across = math.remainder((point - middle) @ right, TILE)
                assert across == pytest.approx(LANE_WIDTH / 2, abs=1e-3)


def test_roundabouts_appear_and_only_at_junctions(laid):
    rings, graphs = 0, [tile_graph(np.random.default_rng(seed)) for seed in LAID]
    for edges, (strips, _, _, _) in zip(graphs, laid, strict=True):
        for x, y, _, _, sweep, _ in strips.arcs:
            if sweep == pytest.approx(2 * math.pi):
                rings += 1
                assert kind(edges, int(y // TILE) * TILES + int(x // TILE)) in ("T", "crossing")
    junctions = sum(int((g.sum(axis=1) > 2).sum()) for g in graphs)
    assert 0.02 < rings / junctions < 0.09


def test_roads_have_their_width(laid):
    for strips, _, width, height in laid:
        assert set(strips.lines[:, 4]) == {HALF_ROAD}
        assert set(strips.arcs[:, 5]) <= {HALF_ROAD, ROUNDABOUT_HALF, FLARE_HALF}
        assert (width, height) == (SIDE, SIDE)


# --- Whole maps ------------------------------------------------------------------------------------------------------


def test_the_same_seed_is_the_same_map(built):
    for scenario in built[:2]:
        again = build("seamless", scenario.seed).arrays()
        assert {k: v.tobytes() for k, v in again.items()} == {k: v.tobytes() for k, v in scenario.arrays().items()}
    assert built[0].arrays()["field"].tobytes() != built[1].arrays()["field"].tobytes()


def test_no_start_is_in_a_wall(built):
    """Anywhere on any lane, as a start is drawn."""
    k = constants(SimConfig())
    for scenario in built:
        starts = sample_starts(scenario, 3000, np.random.default_rng(scenario.seed))
        assert starts.shape == (3000, 5)
        assert np.isfinite(starts).all()
        hit = [collides(scenario.road, k, x, y, np.cos(h), np.sin(h)) for x, y, h, _, _ in starts]
        assert not any(hit)
        assert (starts[:, 3:] == 0.0).all()
        # They are spread over the whole network: no lane of any length is left out.
        tiles = set(map(tuple, (starts[:, :2] // TILE % TILES).astype(int).tolist()))
        roads = set(map(tuple, (scenario.lanes.points // TILE % TILES).astype(int).tolist()))
        assert len(tiles) >= 0.95 * len(roads)


def test_every_lane_is_road_all_along(built):
    """The car fits at every point of every lane, along it."""
    k = constants(SimConfig())
    for scenario in built[:3]:
        for i in range(len(scenario.lanes)):
            lane = scenario.lanes.lane(i)
            heading = np.arctan2(*np.diff(lane, axis=0).T[::-1])
            assert not any(
                collides(scenario.road, k, x, y, np.cos(h), np.sin(h)) for (x, y), h in zip(lane, heading, strict=False)
            )


def test_seeds_of_training_validation_and_held_out_maps_are_apart():
    assert TRAINING_SEED < VALIDATION_SEED < HELD_OUT_SEED
    assert VALIDATION_SEED - TRAINING_SEED >= 100_000
    assert HELD_OUT_SEED - VALIDATION_SEED >= 100_000


@pytest.mark.parametrize(("name", "seed"), [("seemless", 0), ("", 0), ("seamless", -1)])
def test_what_is_not_there_is_refused_in_one_line(name, seed):
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        build(name, seed)
