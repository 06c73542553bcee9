"""The curved road: one winding two-lane loop without a junction.

Random corners are joined by a short closed tour and rounded with arcs. A loop that is too short, does not bend both
ways, comes too close to itself or has too tight or too short a bend is drawn again.
"""

from __future__ import annotations

import math

import numpy as np

from gridsim.jit import njit
from gridsim.maps.lanes import Path, Plan, Scenario, backwards, beside, lay_lanes, sample, strips_along

SIDE = 256.0  # m, of the torus
MARGIN = 20.0  # m from a corner to the torus's sides, at least, so that the road does not cross those
LANE_WIDTH = 3.5  # m
HALF_ROAD = 4.0  # m, centre line to the road's edge
RADIUS = (16.0, 60.0)  # m, of the bends
CORNERS = (8, 15)  # a loop has 8 to 14, if so many fit
SPACING = 42.0  # m between corners, at least
DRAWS = 60  # points from which corners are taken
STRAIGHT = 5.0  # m between bends, at least
SHORTEST_BEND = 5.0  # m, arc length
SHORTEST_LOOP = 450.0  # m
BENDS_EACH_WAY = 2  # bends of more than 0.3 rad to the left, and as many to the right, at least
GAP = 3.0  # m between two parts of the road, edge to edge, at least
NEIGHBOURS = 24.0  # m along the road within which two points may be close to each other


@njit
def _tour(corners):
    """Order corners [n, 2], in place, as a closed tour by 2-opt, which leaves no crossing edges."""
    n = len(corners)
    better = True
    while better:
        better = False
        for i in range(n - 1):
            for j in range(i + 2, n):
                a, b, c, d = corners[i], corners[i + 1], corners[j], corners[(j + 1) % n]
                old = math.hypot(a[0] - b[0], a[1] - b[1]) + math.hypot(c[0] - d[0], c[1] - d[1])
                new = math.hypot(a[0] - c[0], a[1] - c[1]) + math.hypot(b[0] - d[0], b[1] - d[1])
                if new < old - 1e-9:
                    corners[i + 1 : j + 1] = corners[i + 1 : j + 1][::-1].copy()
                    better = True


@njit
def _meets_itself(points, step):
    """Whether a closed line of points [n, 2], `step` m apart, comes closer to itself than two roads may."""
    n, near = len(points), int(NEIGHBOURS / step)
    for i in range(n):
        for j in range(i + near, min(n, n + i - near + 1)):
            dx, dy = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1]
            if dx * dx + dy * dy < (2.0 * HALF_ROAD + GAP + step) ** 2:
                return True
    return False


def _corners(rng: np.random.Generator) -> np.ndarray:
    """Corners [n, 2], SPACING or more apart, in the order of a tour."""
    count = rng.integers(*CORNERS)
    corners: list[np.ndarray] = []
    for point in rng.uniform(MARGIN, SIDE - MARGIN, (DRAWS, 2)):
        if len(corners) < count and all(math.hypot(*(point - other)) >= SPACING for other in corners):
            corners.append(point)
    tour = np.array(corners)
    _tour(tour)
    return tour


def _rounded(corners: np.ndarray, rng: np.random.Generator) -> Path | None:
    """The closed path round corners [n, 2], beginning with a straight; None if bends do not fit, or are too few."""
    edges = np.roll(corners, -1, axis=0) - corners
    lengths, headings = np.hypot(*edges.T), np.arctan2(edges[:, 1], edges[:, 0])
    turns = (headings - np.roll(headings, 1) + math.pi) % (2 * math.pi) - math.pi  # at each corner
    room = (np.minimum(lengths, np.roll(lengths, 1)) - STRAIGHT) / 2  # m that a bend may take of either straight
    tangent = np.tan(np.abs(turns) / 2)
    radii = np.minimum(rng.uniform(*RADIUS, len(turns)), room / tangent)
    if radii.min() < RADIUS[0] or (radii * np.abs(turns)).min() < SHORTEST_BEND:
        return None
    if min((turns > 0.3).sum(), (turns < -0.3).sum()) < BENDS_EACH_WAY:
        return None
    cut = radii * tangent
    straights = lengths - cut - np.roll(cut, -1)
    pieces: list[tuple[float, float]] = []
    for k in range(len(turns)):
        pieces.append((straights[k - 1], 0.0))
        pieces.append((radii[k] * abs(turns[k]), math.copysign(1.0 / radii[k], turns[k])))
    x, y = corners[-1] + edges[-1] / lengths[-1] * cut[-1]
    return Path(x, y, headings[-1], tuple(pieces))


def curved_layout(rng: np.random.Generator) -> Plan:
    """The strips and lanes of a random closed road."""
    while True:
        middle = _rounded(_corners(rng), rng)
        if middle is None or sum(length for length, _ in middle.pieces) < SHORTEST_LOOP:
            continue
        points, step = sample(middle, 2.0)
        if not _meets_itself(points, step):
            break
    paths = beside(middle, -LANE_WIDTH / 2) + beside(backwards(middle), -LANE_WIDTH / 2)
    return strips_along(middle, HALF_ROAD), lay_lanes(paths, SIDE, SIDE)


SCENARIO = Scenario(curved_layout, (6.0, 15.0))
