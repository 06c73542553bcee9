"""The graphs of tiles of the seamless road, and its roundabouts, over hundreds of seeds."""

import math
from collections import Counter, deque

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gridsim.maps.generators.seamless import LANE_WIDTH, SHORTEST_BLOCK, TILE, TILES, seamless_layout, tile_graph
from gridsim.maps.generators.squares import DIRECTIONS

GRAPHS, LAID = 300, 60  # seeds of which graphs are looked at, and lanes and strips
TILE_NUMBERS = np.arange(TILES * TILES)
NEIGHBOURS = np.stack(
    [(TILE_NUMBERS // TILES + dy) % TILES * TILES + (TILE_NUMBERS % TILES + dx) % TILES for dx, dy in DIRECTIONS], 1
)


@pytest.fixture(scope="module")
def graphs():
    return [tile_graph(np.random.default_rng(seed)) for seed in range(GRAPHS)]


@pytest.fixture(scope="module")
def laid():
    return [seamless_layout(np.random.default_rng(seed)) for seed in range(LAID)]


def shortest_block(edges):
    """Tiles around the smallest block, on the plane that the torus is rolled from (a way round the torus is none).

    For each edge: the way from its tile to the other end without that edge, found on unrolled coordinates.
    """
    best = math.inf
    for tile, d in np.argwhere(edges[:, :2]):
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
                    queue.append((place, NEIGHBOURS[here, e]))
        best = min(best, seen.get(goal, math.inf) + 1)
    return best


def test_networks_are_connected_large_and_without_dead_ends(graphs):
    for edges in graphs:
        assert (edges == edges[NEIGHBOURS, [2, 3, 0, 1]]).all()  # every open edge meets one
        assert set(edges.sum(axis=1)) <= {0, 2, 3, 4}
        used = edges.any(axis=1)
        assert used.sum() >= TILES * TILES // 2
        tile, d = np.nonzero(edges)
        joined = coo_array((np.ones(len(tile)), (tile, NEIGHBOURS[tile, d])), shape=(len(edges),) * 2)
        assert len(set(connected_components(joined)[1][used])) == 1
    assert len({edges.tobytes() for edges in graphs}) == len(graphs)


def test_no_block_is_shorter_than_ten_tiles(graphs):
    assert min(map(shortest_block, graphs)) == SHORTEST_BLOCK == 10


def test_all_kinds_of_tiles_appear_turned_all_ways(graphs):
    seen = Counter(tuple(map(bool, row)) for edges in graphs for row in edges)
    assert len(seen) == 12  # none; 2 straights, 4 curves, 4 Ts, 1 crossing
    assert min(seen.values()) > 0.005 * seen.total()


def test_lanes_keep_to_the_right(laid):
    """On a tile's edge a lane enters and leaves half a lane's width to the right of the road's centre line."""
    for _, lanes, _, _ in laid[:10]:
        for i in range(len(lanes)):
            points = lanes.points[lanes.offsets[i] : lanes.offsets[i + 1]].astype(float)
            for point, (dx, dy) in ((points[0], points[1] - points[0]), (points[-1], points[-1] - points[-2])):
                angle = round(math.atan2(dy, dx) / (math.pi / 2)) * math.pi / 2
                middle = (np.floor(point / TILE + 1e-6) + 0.5) * TILE
                across = math.remainder((point - middle) @ [math.sin(angle), -math.cos(angle)], TILE)
                assert across == pytest.approx(LANE_WIDTH / 2, abs=1e-3)


def test_roundabouts_appear_and_only_at_junctions(graphs, laid):
    rings = 0
    for edges, (strips, _, _, _) in zip(graphs, laid, strict=False):
        for x, y, *_ in strips.arcs[np.abs(strips.arcs[:, 4]) > 6.0]:
            rings += 1
            assert edges[int(y // TILE) * TILES + int(x // TILE)].sum() > 2
    junctions = sum(int((edges.sum(axis=1) > 2).sum()) for edges in graphs[:LAID])
    assert 0.02 < rings / junctions < 0.09
