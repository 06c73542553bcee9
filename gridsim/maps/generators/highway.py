"""The highway: four lanes one way, straights and S-bends, round the torus in x.

Each S-bend is a pair of arcs that shifts the road sideways and keeps its heading. The shifts add up to 0 and the
straights fill the length, so that the road closes exactly. The road's y is a function of x, so it never meets itself.
"""

from __future__ import annotations

import numpy as np

from gridsim.maps.lanes import Path, Plan, Scenario, beside, lay_lanes, strips_along

WIDTH, HEIGHT = 1024.0, 128.0  # m, of the torus
LANE_COUNT = 4
LANE_WIDTH = 3.75  # m
SHOULDER = 0.5  # m of paved road outside the outer lanes
HALF_ROAD = LANE_COUNT / 2 * LANE_WIDTH + SHOULDER  # m, centre line to the road's edge
RADIUS = (150.0, 500.0)  # m, of the bends
BENDS = 4  # S-bends
SHIFT = (12.0, 60.0)  # m to the side, of an S-bend
STEEPEST = 0.6  # rad, of the heading from the x axis
STRAIGHT = 20.0  # m between S-bends, at least


def highway_layout(rng: np.random.Generator) -> Plan:
    """The strips and lanes of a random highway."""
    while True:
        radii = rng.uniform(*RADIUS, (BENDS, 2))
        shifts = rng.uniform(*SHIFT, BENDS) * rng.choice([-1.0, 1.0], BENDS)
        shifts[-1] = -shifts[:-1].sum()
        total = radii.sum(axis=1)
        angles = np.arccos(np.maximum(1.0 - np.abs(shifts) / total, 0.0))
        lengths = total * np.sin(angles)  # along x
        rest = WIDTH - lengths.sum() - BENDS * STRAIGHT
        if SHIFT[0] <= abs(shifts[-1]) <= SHIFT[1] and angles.max() <= STEEPEST and rest >= 0.0:
            break
    straights = STRAIGHT + rest * rng.dirichlet(np.ones(BENDS))
    pieces: list[tuple[float, float]] = []
    for straight, (one, other), angle, side in zip(straights, radii, angles, np.sign(shifts), strict=True):
        pieces += [(straight, 0.0), (one * angle, side / one), (other * angle, -side / other)]
    middle = Path(0.0, rng.uniform(0.0, HEIGHT), 0.0, tuple(pieces))
    offsets = LANE_WIDTH * (np.arange(LANE_COUNT)[::-1] - (LANE_COUNT - 1) / 2)  # from left to right
    lanes = [beside(middle, offset) for offset in offsets]
    abreast = [lane[k] for k in range(len(pieces)) for lane in lanes]
    return strips_along(middle, HALF_ROAD), lay_lanes(abreast, WIDTH, HEIGHT, LANE_COUNT)


SCENARIO = Scenario(highway_layout, (15.0, 25.0), traffic=8)
