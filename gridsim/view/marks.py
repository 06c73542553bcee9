"""Lane marks: dashes between neighbouring lanes, computed from the lanes; none in junctions.

A lane's neighbour is a parallel lane, in either direction, about a lane's width to its left. Where a lane that is not
parallel passes close by, there is a junction, and no mark is drawn.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gridsim.maps.map import Map
from gridsim.maps.roads import freeze

STEP = 1.0  # m between sampled points of a lane
NEAREST, FARTHEST = 2.2, 4.6  # m between the centre lines of neighbours
PARALLEL = 0.985  # cosine of the angle within which lanes are parallel: 10 degrees
JUNCTION = 4.0  # m from a mark within which a lane that is not parallel makes a junction
PERIOD, DASH = 6, 2.5  # m from dash to dash, and length of a dash
APART = 3.1  # m within which there is no second dash: lanes overlap, and opposite lanes have the same line


def lane_marks(road_map: Map) -> np.ndarray:
    """Dashes float32 [n, 6]: centre x, y (m), direction (cosine, sine), half length (m), 1 between opposite lanes."""
    lanes, mileage = road_map.lanes, road_map.mileage
    if not len(lanes) or mileage[-1] < STEP:
        return freeze(np.zeros((0, 6), dtype=np.float32))
    size = np.array([road_map.road.width, road_map.road.height], dtype=np.float64)
    at = np.arange(STEP / 2, mileage[-1], STEP)
    segment = np.clip(np.searchsorted(mileage, at, side="right") - 1, 0, len(mileage) - 2)
    begin = lanes.points[segment].astype(np.float64)
    along = lanes.points[segment + 1] - begin
    direction = along / np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    points = np.mod(begin + direction * (at - mileage[segment])[:, None], size)
    tree = cKDTree(points, boxsize=size if road_map.torus else None)
    left = np.stack([-direction[:, 1], direction[:, 0]], axis=1)

    def beside(of: np.ndarray, centre: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pairs of samples `of` [k] and samples within `reach` m of `centre` [k, 2], and the cosine between them."""
        near = tree.query_ball_point(np.mod(centre, size), reach)
        row = np.repeat(np.arange(len(of)), [len(found) for found in near])
        other = np.concatenate([*near, []]).astype(np.intp)
        return row, other, (direction[of[row]] * direction[other]).sum(axis=1)

    dashes = np.arange(0, len(points), PERIOD)
    middle, reach = (NEAREST + FARTHEST) / 2, (FARTHEST - NEAREST) / 2 + STEP / 2
    row, other, cosine = beside(dashes, points[dashes] + middle * left[dashes], reach)
    offset = points[other] - points[dashes[row]]
    if road_map.torus:
        offset -= np.round(offset / size) * size
    across, ahead = (offset * left[dashes[row]]).sum(axis=1), np.abs((offset * direction[dashes[row]]).sum(axis=1))
    fits = (np.abs(cosine) > PARALLEL) & (ahead < STEP) & (across > NEAREST) & (across < FARTHEST)
    row, across, ahead, opposite = row[fits], across[fits], ahead[fits], cosine[fits] < 0
    best = np.lexsort((across + ahead, row))
    best = best[np.unique(row[best], return_index=True)[1]]  # the nearest neighbour of each dash
    marked, across, opposite = dashes[row[best]], across[best], opposite[best]
    centre = np.mod(points[marked] + 0.5 * across[:, None] * left[marked], size)

    row, _, cosine = beside(marked, centre, JUNCTION)
    free = np.ones(len(marked), dtype=np.bool_)
    free[row[np.abs(cosine) < PARALLEL - 0.06]] = False
    centre, marked, opposite = centre[free], marked[free], opposite[free]
    single = np.ones(len(marked), dtype=np.bool_)
    for first, second in sorted(cKDTree(centre, boxsize=size if road_map.torus else None).query_pairs(APART)):
        single[second] &= not single[first]
    half = np.full(len(marked), DASH / 2)
    return freeze(np.column_stack([centre, direction[marked], half, opposite])[single].astype(np.float32))
