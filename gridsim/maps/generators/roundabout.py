"""Roundabouts in a network of tiles, and the scenario in which every junction is one."""

from __future__ import annotations

import math

import numpy as np

from gridsim.maps.lanes import Plan, Scenario
from gridsim.maps.squares import DIRECTIONS, Layout, Pieces, rotated
from gridsim.maps.tiles import HALF_ROAD, LANE_WIDTH, TILE, TILES, tile_graph

RADIUS = 10.5  # m, of the ring's centre line; 30 m across in all, as small rural ones are
HALF_RING = 4.5  # m, half width of the ring, wide enough for a lorry to turn
FLARE = 8.0  # m, radius of the arcs by which lanes join and leave the ring
HALF_FLARE = HALF_ROAD - LANE_WIDTH / 2  # m, half width of those arcs, whose outer edge continues the arm's
FEWEST = 6  # roundabouts on a map of this file's scenario, at least
# The arc by which the eastern arm's lane joins the ring, tangent to the lane's centre line and, from outside, to the
# ring's: x and y of its centre (m), and where on the ring it ends (rad).
FLARE_Y = LANE_WIDTH / 2 + FLARE
FLARE_X = math.sqrt((RADIUS + FLARE) ** 2 - FLARE_Y**2)
FLARE_ANGLE = math.atan2(FLARE_Y, FLARE_X)


def _around(turn: int, half: float, _offset: float) -> Pieces:
    """Pieces of the lane through a roundabout, counter-clockwise; arguments as for `squares.through_square`."""
    straight = (half - FLARE_X, 0.0)
    flare = ((math.pi / 2 - FLARE_ANGLE) * FLARE, -1.0 / FLARE)
    ring = ((turn * math.pi / 2 - 2 * FLARE_ANGLE) * RADIUS, 1.0 / RADIUS)
    return (straight, flare, ring, flare, straight)


def _roundabout(layout: Layout, x: float, y: float, arms: list[int]) -> None:
    """Add the strips of a roundabout centred on (x, y)."""
    layout.arcs.append([x, y, RADIUS, 0.0, 2 * math.pi, HALF_RING])
    for arm in arms:
        dx, dy = DIRECTIONS[arm]
        inner = RADIUS - HALF_RING + HALF_ROAD + 0.25  # the arm ends in a half circle, which must not cover the island
        layout.line(dx * TILE / 2 + x, dy * TILE / 2 + y, dx * inner + x, dy * inner + y)
        for side in (1.0, -1.0):  # way in, way out
            (cx, cy), first = rotated(FLARE_X, side * FLARE_Y, arm), arm * math.pi / 2 - side * math.pi / 2
            layout.arcs.append([cx + x, cy + y, FLARE, first, side * (FLARE_ANGLE - math.pi / 2), HALF_FLARE])


def roundabout_layout(rng: np.random.Generator) -> Plan:
    """The strips and lanes of a random network in which each T and crossing is a roundabout."""
    while True:
        edges = tile_graph(rng)
        if (edges.sum(axis=1) > 2).sum() >= FEWEST:
            return lay_tiles(rng, edges, 1.0)


def lay_tiles(rng: np.random.Generator, edges: np.ndarray, share: float) -> Plan:
    """The strips and lanes of a `tile_graph`; each T or crossing is a roundabout with probability `share`."""
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


SCENARIO = Scenario(roundabout_layout, (5.0, 10.0), traffic=4, thinnest=1.0)
