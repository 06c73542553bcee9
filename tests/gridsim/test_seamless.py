"""The graphs of tiles of the seamless road, and its roundabouts, over hundreds of seeds."""

from collections import Counter

import numpy as np
import pytest

from gridsim.maps.generators.seamless import seamless_layout
from gridsim.maps.generators.tiles import TILE, TILES, tile_graph

GRAPHS, LAID = 300, 60  # seeds of which graphs are looked at, and lanes and strips


@pytest.fixture(scope="module")
def graphs():
    return [tile_graph(np.random.default_rng(seed)) for seed in range(GRAPHS)]


@pytest.fixture(scope="module")
def laid():
    return [seamless_layout(np.random.default_rng(seed)) for seed in range(LAID)]


def test_all_kinds_of_tiles_appear_turned_all_ways(graphs):
    seen = Counter(tuple(map(bool, row)) for edges in graphs for row in edges)
    assert min(edges.any(axis=1).sum() for edges in graphs) >= TILES * TILES // 2
    assert len(seen) == 12  # none; 2 straights, 4 curves, 4 Ts, 1 crossing
    assert min(seen.values()) > 0.005 * seen.total()


def test_roundabouts_appear_and_only_at_junctions(graphs, laid):
    rings = 0
    for edges, (strips, _, _, _) in zip(graphs, laid, strict=False):
        for x, y, *_ in strips.arcs[np.abs(strips.arcs[:, 4]) > 6.0]:
            rings += 1
            assert edges[int(y // TILE) * TILES + int(x // TILE)].sum() > 2
    junctions = sum(int((edges.sum(axis=1) > 2).sum()) for edges in graphs[:LAID])
    assert 0.02 < rings / junctions < 0.09
