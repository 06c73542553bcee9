"""Lane marks: dashes between neighbouring lanes, computed from the lanes; none in junctions.

A lane's neighbour is a parallel lane, in either direction, about a lane's width to its left.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gridsim.jit import freeze
from gridsim.maps.map import Map

BESIDE, SLACK = 3.4, 1.2  # m between the centre lines of neighbours, and by how much it may differ
PARALLEL = 0.985  # cosine of the angle within which neighbours are parallel: 10 degrees
PERIOD, DASH = 6.0, 2.5  # m from dash to dash, and length of a dash


def lane_marks(road_map: Map) -> np.ndarray:
    """Dashes float32 [n, 6]: centre x, y (m), direction (cosine, sine), half length (m), 1 between opposite lanes."""
    lanes, mileage, size = road_map.network, road_map.mileage, road_map.size
    if not len(lanes.steps):
        return freeze(np.zeros((0, 6), dtype=np.float32))
    points = lanes.points.astype(np.float64)
    step = np.diff(points, axis=0, append=points[-1:])
    step[lanes.offsets[1:] - 1] = step[lanes.offsets[1:] - 2]
    direction = step / np.hypot(*step.T)[:, None]
    lane = np.repeat(np.arange(len(lanes.steps)), np.diff(lanes.offsets))
    road = (np.diff(lanes.crossing_offsets) == 0)[lane]  # no junction
    tree = cKDTree(_within(points, size), boxsize=size)
    at = np.arange(PERIOD / 2, mileage[-1], PERIOD)
    k = np.searchsorted(mileage, at, side="right") - 1
    here, ahead = points[k] + direction[k] * (at - mileage[k])[:, None], direction[k]
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    away, other = tree.query(_within(here + BESIDE * left, size), distance_upper_bound=SLACK)
    beside = np.isfinite(away) & road[k]
    k, other, here, ahead, left = k[beside], other[beside], here[beside], ahead[beside], left[beside]
    cosine = (ahead * direction[other]).sum(axis=1)
    across = (road_map.shortest(points[other] - here) * left).sum(axis=1)
    centre = _within(here + 0.5 * across[:, None] * left, size)
    dashes = np.column_stack([centre, ahead, np.full(len(centre), DASH / 2), cosine < 0.0])
    once = (cosine > 0.0) | (lane[k] < lane[other])  # opposite lanes are each other's neighbours: one dash for both
    return freeze(dashes[once & road[other] & (abs(cosine) > PARALLEL)].astype(np.float32))


def _within(points: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Points [n, 2] wrapped into a torus, below `size`."""
    wrapped = np.mod(points, size)
    return np.where(wrapped < size, wrapped, 0.0)
