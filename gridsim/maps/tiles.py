"""A network of square tiles on a torus, laid from a random graph, so that the road never ends.

The edges of a node decide its tile: two opposite edges make a straight, two others a curve, three a T, four a crossing.
No node has a single edge, so every lane has a successor. Each block of the network is surrounded by ten tiles or more:
the way round it, corners cut, is longer than 200 m, the default of `episode.revisit`, so that each lap is new ground.
"""

from __future__ import annotations

import numpy as np

from gridsim.maps.squares import DIRECTIONS, components

TILE = 32.0  # m, side of a tile
TILES = 8  # along each side of the torus
LANE_WIDTH = 3.5  # m
SHOULDER = 0.5  # m of paved road beyond each of the two lanes
HALF_ROAD = LANE_WIDTH + SHOULDER  # m, centre line to the road's edge
EDGE_SHARE = 0.9  # share of the graph's edges that are tried; each becomes a road unless that closes too short a block
SHORTEST_BLOCK = 10  # tiles around each block of the network, at least


def _closes_short_block(edges: list[list[bool]], tile: int, direction: int) -> bool:
    """Whether opening this edge of a tile would close a block with fewer than SHORTEST_BLOCK tiles around it.

    The search is on the unrolled plane, since a way round the whole torus encloses no block.
    """
    x0, y0 = tile % TILES, tile // TILES
    goal = DIRECTIONS[direction]
    frontier, seen = {(0, 0)}, {(0, 0)}
    for _ in range(SHORTEST_BLOCK - 2):
        frontier = {
            (x + DIRECTIONS[d][0], y + DIRECTIONS[d][1])
            for x, y in frontier
            for d in range(4)
            if edges[(y0 + y) % TILES * TILES + (x0 + x) % TILES][d]
        } - seen
        seen |= frontier
        if goal in frontier:
            return True
    return False


def _neighbour(tile: int, direction: int) -> int:
    dx, dy = DIRECTIONS[direction]
    return (tile // TILES + dy) % TILES * TILES + (tile % TILES + dx) % TILES


def tile_graph(rng: np.random.Generator) -> np.ndarray:
    """Open edges bool [tiles, 4] (east, north, west, south) of a connected network without dead ends.

    No straight road closes round the torus, so that a car that does not steer leaves the road. Tiles outside the
    network have no open edge.
    """
    while True:
        opened = [[False] * 4 for _ in range(TILES * TILES)]
        pairs = [(tile, d) for tile in range(TILES * TILES) for d in (0, 1)]
        for k in rng.permutation(len(pairs))[: round(EDGE_SHARE * len(pairs))]:
            tile, d = pairs[k]
            other = _neighbour(tile, d)
            if not _closes_short_block(opened, tile, d):
                opened[tile][d] = opened[other][(d + 2) % 4] = True
        edges = np.array(opened)
        while (ends := np.flatnonzero(edges.sum(axis=1) == 1)).size:
            for tile in ends:
                for d in np.flatnonzero(edges[tile]):
                    edges[tile, d] = edges[_neighbour(int(tile), int(d)), (d + 2) % 4] = False
        squares = edges.reshape(TILES, TILES, 4)
        part = components(squares)
        largest = part == np.bincount(part).argmax()
        edges[~largest] = False
        # Whether each row, and each column, is one straight road round the torus.
        round_x, round_y = squares[..., 0].all(axis=1), squares[..., 1].all(axis=0)
        if largest.sum() >= TILES * TILES // 2 and not (round_x.any() or round_y.any()):
            return edges
