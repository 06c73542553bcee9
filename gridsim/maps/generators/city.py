"""The city: narrow irregular blocks on a torus, plain crossings with tight corners, parked cars in bays at the kerb.

Streets run along the axes at irregular distances. Each street lacks one piece, which makes T junctions and bends. A bay
widens the road on one side of a street; the cars parked in it are blocks that do not reach into the lanes. With
`traffic.city_lights` two pieces of street have traffic lights in their middle, as where people cross.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial

import numpy as np

from gridsim.maps.lanes import Path, Plan, Scenario
from gridsim.maps.squares import DIRECTIONS, PHASES, Layout, components

SIDE = 256.0  # m, of the torus
LANE_WIDTH = 3.0  # m
HALF_ROAD = (3.4, 3.6)  # m, centre line to the kerb, drawn for each map
CORNER = (8.0, 10.0)  # m, radius of the roads' centre lines round a corner, drawn for each crossing
# Each map draws one of these: for x and for y, the number of streets and the least distance between them (m). The way
# round the smallest block, corners cut, is longer than 200 m, the default of `episode.revisit`: each lap is new ground.
GRIDS = (((4, 60.5), (4, 60.5)), ((3, 72.0), (4, 54.0)), ((4, 54.0), (3, 72.0)))
BAY_SHARE = 0.6  # share of street sides with a bay, of those that are long enough
BAY_DEPTH = 2.0  # m
BAY_LENGTH = 12.0  # m, at least, without its rounded ends
BAY_AWAY = 5.5  # m from the ends of a piece of street to a bay without its rounded ends, at least
CAR = (2.0, 0.9)  # m, half length and half width of a parked car
CAR_PITCH = (5.2, 7.0)  # m from one parking place to the next
CAR_SHARE = 0.7  # share of parking places that are taken
CAR_SKEW = 0.05  # rad, at most, either way
CAR_OUT = 0.25  # m towards the lane from the middle of the bay, at most
LIT = 2  # pieces of street with traffic lights, with `traffic.city_lights`
LINE_OUT = 0.25  # m by which stop lines reach beyond the bays on either side


def _positions(rng: np.random.Generator, count: int, least: float) -> np.ndarray:
    """Positions (m), along one axis of the torus, of the streets that cross it, `least` m or more apart."""
    gaps = least + (SIDE - count * least) * rng.dirichlet(np.full(count, 2.0))
    return rng.uniform(0.0, SIDE) + np.concatenate([[0.0], np.cumsum(gaps[:-1])])


def street_graph(rng: np.random.Generator, columns: int, rows: int) -> np.ndarray:
    """Open edges bool [rows, columns, 4] (east, north, west, south): connected, and two or more at each node.

    Each street lacks one piece: a car that does not steer meets a wall.
    """
    while True:
        edges = np.ones((rows, columns, 4), dtype=bool)
        j, i = np.arange(rows), rng.integers(columns, size=rows)
        edges[j, i, 0] = edges[j, (i + 1) % columns, 2] = False
        j, i = rng.integers(rows, size=columns), np.arange(columns)
        edges[j, i, 1] = edges[(j + 1) % rows, i, 3] = False
        if not components(edges).any():  # all are in part 0
            return edges


def _parked(rng: np.random.Generator, first: float, last: float) -> Iterator[tuple[float, float, float]]:
    """Parked cars of a bay: (m along the street, m from the bay's middle towards the lane, rad of skew)."""
    along = first + CAR[0] + rng.uniform(0.0, 1.0)
    while along + CAR[0] <= last:
        if rng.random() < CAR_SHARE:
            yield along, rng.uniform(0.0, CAR_OUT), rng.uniform(-CAR_SKEW, CAR_SKEW)
        along += rng.uniform(*CAR_PITCH)


def city_layout(rng: np.random.Generator, lit: int = 0) -> Plan:
    """The strips and lanes of a random city; `lit`, the number of pieces of street with traffic lights."""
    (columns, apart_x), (rows, apart_y) = GRIDS[rng.integers(len(GRIDS))]
    xs, ys = _positions(rng, columns, apart_x), _positions(rng, rows, apart_y)
    edges = street_graph(rng, columns, rows)
    corner = rng.uniform(*CORNER, (rows, columns))
    half_road = rng.uniform(*HALF_ROAD)
    bay_half = half_road + BAY_DEPTH / 2  # the strip of a bay also covers the road
    layout = Layout(half_road, LANE_WIDTH)
    streets: list[int] = []  # for each piece of street, the number of the first of its two lanes

    def street(x: float, y: float, d: int, length: float) -> None:
        """A piece of street from (x, y), with its lanes, bays and parked cars."""
        (ux, uy), heading = DIRECTIONS[d], d * math.pi / 2

        def place(along: float, left: float) -> tuple[float, float]:
            return x + along * ux - left * uy, y + along * uy + left * ux

        layout.line(*place(0.0, 0.0), *place(length, 0.0))
        streets.append(len(layout.paths))
        right, left = place(0.0, -LANE_WIDTH / 2), place(length, LANE_WIDTH / 2)
        layout.paths.append(Path(*right, heading, ((length, 0.0),)))
        layout.paths.append(Path(*left, heading + math.pi, ((length, 0.0),)))
        for side in (1.0, -1.0):
            spare = length - 2 * BAY_AWAY - BAY_LENGTH
            if rng.random() >= BAY_SHARE or spare < 0.0:
                continue
            before, after = np.sort(rng.uniform(0.0, spare, 2))
            first, last = BAY_AWAY + before, length - BAY_AWAY - (spare - after)
            shift = side * BAY_DEPTH / 2
            layout.lines.append([*place(first, shift), *place(last, shift), bay_half])
            for along, out, skew in _parked(rng, first, last):
                layout.blocks.append([*place(along, side * (bay_half - out)), heading + skew, *CAR])

    for j in range(rows):
        for i in range(columns):
            x, y, half = float(xs[i]), float(ys[j]), float(corner[j, i])
            arms = [int(d) for d in np.flatnonzero(edges[j, i])]
            layout.join(x, y, half, arms)
            layout.connect(x, y, half, arms)
            if edges[j, i, 0]:
                gap = (xs[(i + 1) % columns] - x) % SIDE
                street(x + half, y, 0, gap - half - corner[j, (i + 1) % columns])
            if edges[j, i, 1]:
                gap = (ys[(j + 1) % rows] - y) % SIDE
                street(x, y + half, 1, gap - half - corner[(j + 1) % rows, i])
    for first in rng.choice(streets, lit, replace=False):
        layout.signal(first, half_road + BAY_DEPTH + LINE_OUT, int(rng.integers(len(PHASES))))
    return layout.finish(SIDE)


SCENARIO = Scenario(city_layout, (3.0, 10.0), traffic=6, thinnest=1.0, lit=partial(city_layout, lit=LIT))
