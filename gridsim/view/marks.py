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
JUNCTION = 3.0  # m from a mark within which a lane that is not parallel makes a junction
PERIOD, DASH = 6.0, 2.5  # m from dash to dash, and length of a dash
CLAIM = 0.5  # m, side of the cells that record which lines are marked
SHORTEST = 5  # least points of a marked line


def _samples(road_map: Map) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [n, 2] on all lanes every STEP m, on the torus, their directions [n, 2], and lane numbers [n]."""
    lanes, mileage = road_map.lanes, road_map.mileage
    at = np.arange(STEP / 2, mileage[-1], STEP)
    segment = np.clip(np.searchsorted(mileage, at, side="right") - 1, 0, len(mileage) - 2)
    points = lanes.points.astype(np.float64)
    along = points[segment + 1] - points[segment]
    length = np.hypot(along[:, 0], along[:, 1])
    direction = along / np.maximum(length, 1e-9)[:, None]
    found = points[segment] + direction * (at - mileage[segment])[:, None]
    lane = np.searchsorted(lanes.offsets, segment, side="right") - 1
    return found, direction, lane


def lane_marks(road_map: Map) -> np.ndarray:
    """Dashes float32 [n, 6]: centre x, y (m), direction (cosine, sine), half length (m), 1 between opposite lanes."""
    if not len(road_map.lanes) or road_map.mileage[-1] < STEP:
        return freeze(np.zeros((0, 6), dtype=np.float32))
    size = np.array([road_map.road.width, road_map.road.height], dtype=np.float64)
    points, direction, lane = _samples(road_map)
    wrapped = np.mod(points, size)
    # Lanes often overlap, for example at the entrance of a junction. Each place and direction is searched once.
    key = np.concatenate([np.round(wrapped), np.round(direction * 8)], axis=1)
    _, one = np.unique(key, axis=0, return_index=True)
    tree = cKDTree(wrapped[one], boxsize=size if road_map.torus else None)
    left = np.stack([-direction[:, 1], direction[:, 0]], axis=1)

    middle, reach = (NEAREST + FARTHEST) / 2, (FARTHEST - NEAREST) / 2 + STEP / 2
    _, near = tree.query(np.mod(wrapped + middle * left, size), k=8, distance_upper_bound=reach)
    there = near < len(one)
    other = one[np.minimum(near, len(one) - 1)]  # [n, k]
    offset = wrapped[other] - wrapped[:, None]
    if road_map.torus:
        offset -= np.round(offset / size) * size
    across = (offset * left[:, None]).sum(axis=2)
    ahead = np.abs((offset * direction[:, None]).sum(axis=2))
    cosine = (direction[other] * direction[:, None]).sum(axis=2)
    there &= (np.abs(cosine) > PARALLEL) & (ahead < STEP) & (across > NEAREST) & (across < FARTHEST)
    rank = np.where(there, across + ahead, np.inf)
    best = rank.argmin(axis=1)
    row = np.arange(len(points))
    marked = np.flatnonzero(there[row, best])
    across, opposite = across[marked, best[marked]], cosine[marked, best[marked]] < 0
    centre = np.mod(wrapped[marked] + 0.5 * across[:, None] * left[marked], size)

    _, near = tree.query(centre, k=24, distance_upper_bound=JUNCTION)
    crossing = (direction[one[np.minimum(near, len(one) - 1)]] * direction[marked][:, None]).sum(axis=2)
    free = ~((near < len(one)) & (np.abs(crossing) < PARALLEL - 0.06)).any(axis=1)
    marked, centre, opposite = marked[free], centre[free], opposite[free]
    return freeze(_dashes(centre, direction[marked], opposite, marked, lane[marked], size))


def _dashes(
    centre: np.ndarray,
    direction: np.ndarray,
    opposite: np.ndarray,
    sample: np.ndarray,
    lane: np.ndarray,
    size: np.ndarray,
) -> np.ndarray:
    """Dashes [n, 6] along runs of marked points, in whole periods; a line is marked once, for its first lane."""
    if not len(sample):
        return np.zeros((0, 6), dtype=np.float32)
    columns, rows = np.ceil(size / CLAIM).astype(int)
    claimed = np.zeros((rows, columns), dtype=bool)
    around = np.arange(-1, 2)
    cell = (centre / CLAIM).astype(int)
    found = []
    for part in np.split(np.arange(len(sample)), np.flatnonzero((np.diff(sample) != 1) | (np.diff(lane) != 0)) + 1):
        new = part[~claimed[cell[part, 1] % rows, cell[part, 0] % columns]]
        for run in np.split(new, np.flatnonzero(np.diff(new) != 1) + 1):
            if len(run) < SHORTEST:
                continue
            x, y = cell[run, 0, None, None] + around, cell[run, 1, None, None] + around[:, None]
            claimed[y % rows, x % columns] = True
            periods = max(1, round(len(run) * STEP / PERIOD))
            at = run[((np.arange(periods) + 0.5) * len(run) / periods).astype(int)]
            half = np.full(periods, DASH / 2)
            found.append(np.column_stack([centre[at], direction[at], half, opposite[at]]))
    return np.concatenate(found).astype(np.float32) if found else np.zeros((0, 6), dtype=np.float32)
