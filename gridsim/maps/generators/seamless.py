"""The seamless road network: square tiles on a torus, laid from a random graph, so that the road never ends.

The edges of a node decide its tile: two opposite edges make a straight, two others a curve, three a T, four a crossing;
some Ts and crossings are built as roundabouts. No node has a single edge, so every lane has a successor. Each block of
the network is surrounded by ten tiles or more: the way round it, corners cut, is longer than the 200 m within which the
same ground does not count again.
"""

from __future__ import annotations

import math

import numpy as np

from gridsim.maps.generators.squares import DIRECTIONS, Layout, Pieces, components, goes_round, rotated
from gridsim.maps.roads import Lanes, Strips

TILE = 32.0  # m, side of a tile
TILES = 8  # along each side of the torus
LANE_WIDTH = 3.5  # m
SHOULDER = 0.5  # m of paved road outside the outer lane
HALF_ROAD = LANE_WIDTH + SHOULDER  # m, centre line to the road's edge
ROUNDABOUT_RADIUS = 10.5  # m, of the ring's centre line; 30 m across in all, as small rural ones are
ROUNDABOUT_HALF = 4.5  # m, half width of the ring, wide enough for a lorry to turn
ROUNDABOUT_FLARE = 8.0  # m, radius of the arcs by which lanes join and leave the ring
FLARE_HALF = HALF_ROAD - LANE_WIDTH / 2  # m, half width of those arcs, whose outer edge continues the arm's
ROUNDABOUT_SHARE = 0.05  # of the T and crossing tiles of the seamless road
FEWEST_ROUNDABOUTS = 6  # on a map of the roundabout scenario
EDGE_SHARE = 0.9  # share of the graph's edges that are kept where SHORTEST_BLOCK allows
SHORTEST_BLOCK = 10  # tiles around the smallest block of the network


def _closes_short_block(edges: np.ndarray, tile: int, direction: int) -> bool:
    """Whether opening this edge of a tile would close a block of fewer than SHORTEST_BLOCK tiles.

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
            if edges[(y0 + y) % TILES * TILES + (x0 + x) % TILES, d]
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

    No straight road closes round the torus: a car that does not steer leaves it.
    """
    while True:
        edges = np.zeros((TILES * TILES, 4), dtype=bool)
        pairs = [(tile, d) for tile in range(TILES * TILES) for d in (0, 1)]
        for k in rng.permutation(len(pairs))[: round(EDGE_SHARE * len(pairs))]:
            tile, d = pairs[k]
            other = _neighbour(tile, d)
            if not _closes_short_block(edges, tile, d):
                edges[tile, d] = edges[other, (d + 2) % 4] = True
        while (ends := np.flatnonzero(edges.sum(axis=1) == 1)).size:
            for tile in ends:
                for d in np.flatnonzero(edges[tile]):
                    edges[tile, d] = edges[_neighbour(int(tile), int(d)), (d + 2) % 4] = False
        squares = edges.reshape(TILES, TILES, 4)
        part = components(squares)
        largest = part == np.bincount(part).argmax()
        edges[~largest] = False
        if largest.sum() >= TILES * TILES // 2 and not goes_round(squares):
            return edges


def _flare() -> tuple[float, float, float]:
    """The arc by which an arm's lane joins the ring: (x, y of its centre for the eastern arm, ring angle in rad).

    It is tangent to the lane's centre line and, from outside, to the ring's.
    """
    y = LANE_WIDTH / 2 + ROUNDABOUT_FLARE
    x = math.sqrt((ROUNDABOUT_RADIUS + ROUNDABOUT_FLARE) ** 2 - y**2)
    return x, y, math.atan2(y, x)


def _around(turn: int, half: float, _offset: float) -> Pieces:
    """Pieces of the lane through a roundabout, counter-clockwise; arguments as of `squares.through_square`."""
    x, _, angle = _flare()
    straight = (half - x, 0.0)
    flare = ((math.pi / 2 - angle) * ROUNDABOUT_FLARE, -1.0 / ROUNDABOUT_FLARE)
    ring = ((turn * math.pi / 2 - 2 * angle) * ROUNDABOUT_RADIUS, 1.0 / ROUNDABOUT_RADIUS)
    return (straight, flare, ring, flare, straight)


def _roundabout(layout: Layout, x: float, y: float, arms: list[int]) -> None:
    """The strips of a roundabout centred on (x, y)."""
    flare_x, flare_y, angle = _flare()
    layout.arcs.append([x, y, ROUNDABOUT_RADIUS, 0.0, 2 * math.pi, ROUNDABOUT_HALF])
    for arm in arms:
        dx, dy = DIRECTIONS[arm]
        inner = ROUNDABOUT_RADIUS - ROUNDABOUT_HALF + HALF_ROAD + 0.25  # its round end must not cover the island
        layout.line(dx * TILE / 2 + x, dy * TILE / 2 + y, dx * inner + x, dy * inner + y)
        for side in (1.0, -1.0):  # way in, way out
            (cx, cy), first = rotated(flare_x, side * flare_y, arm), arm * math.pi / 2 - side * math.pi / 2
            layout.arcs.append([cx + x, cy + y, ROUNDABOUT_FLARE, first, side * (angle - math.pi / 2), FLARE_HALF])


def seamless_layout(rng: np.random.Generator) -> tuple[Strips, Lanes, float, float]:
    """A network: (strips, lanes, width m, height m)."""
    return _layout(rng, tile_graph(rng), ROUNDABOUT_SHARE)


def roundabout_layout(rng: np.random.Generator) -> tuple[Strips, Lanes, float, float]:
    """A network in which each T and crossing is a roundabout: (strips, lanes, width m, height m)."""
    while True:
        edges = tile_graph(rng)
        if (edges.sum(axis=1) > 2).sum() >= FEWEST_ROUNDABOUTS:
            return _layout(rng, edges, 1.0)


def _layout(rng: np.random.Generator, edges: np.ndarray, share: float) -> tuple[Strips, Lanes, float, float]:
    """The map of a graph; `share` of the T and crossing tiles are roundabouts."""
    layout = Layout(HALF_ROAD, LANE_WIDTH)
    for tile in range(len(edges)):
        arms = [int(d) for d in np.flatnonzero(edges[tile])]
        x, y = (tile % TILES + 0.5) * TILE, (tile // TILES + 0.5) * TILE
        if rng.random() < share and len(arms) > 2:
            _roundabout(layout, x, y, arms)
            layout.connect(x, y, TILE / 2, arms, _around)
        else:
            layout.join(x, y, TILE / 2, arms)
            layout.connect(x, y, TILE / 2, arms)
    return layout.finish(TILE * TILES)
