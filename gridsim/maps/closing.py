"""Close parts of a picture's road with walls: the surroundings of a drawing, dead ends, and narrow places.

All lengths are in units (`SimConfig.unit`), also those of each `vehicle`.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from gridsim.config import VehicleConfig
from gridsim.maps.roads import CELLS_PER_UNIT, FIELD_FLOOR, FIELD_STEPS

NODE = 1.0 / CELLS_PER_UNIT
DEEPEST = 255 / FIELD_STEPS + FIELD_FLOOR  # the largest clearance that the field holds
MARGIN = 0.3  # free space that a car needs on each side; less is enough at starts given in a file
# Least extent of a road. If all of a road is a dead end, a car must be able to drive this far from each start found.
FAR = 30.0

_CORNERS_TOO = np.ones((3, 3))  # a node's neighbours include those across its corners
_LEAST_DRAWING = 0.05  # if a drawing encloses less than this share of the road, its surroundings are not closed

_SIDE = 2  # nodes along a side of the cells in which dead ends are looked for
_MOST_CELLS = 1 << 19  # of road; if there are more, dead ends stay open, as the search would take too much memory
_TURNS = 16  # headings of a car at a cell
_TURN = 2 * math.pi / _TURNS
_STRIDE = 1.5  # between two places of an arc that are checked to be free, at most: no wall fits between them
_SLACK = 0.5  # road within a car's room plus this of kept cells stays: cells are coarse, and edges must stay as drawn
# For easy and for hard driving: room (in units) on each side of a car; radius of its arcs, as a multiple of its least.
_EASY, _HARD = (1.25, 2.0), (MARGIN, 1.1)


def needed(vehicle: VehicleConfig) -> float:
    """The clearance that a car needs at its middle."""
    return vehicle.width / 2 + MARGIN


def _distance(region: np.ndarray) -> np.ndarray:
    """Distance of each node from a region (bool [rows, columns]); infinite if the region is empty."""
    return ndimage.distance_transform_edt(~region) * NODE if region.any() else np.full(region.shape, math.inf)


def without_surroundings(nodes: np.ndarray, vehicle: VehicleConfig) -> np.ndarray:
    """Close what surrounds the drawing, in the field of a picture that has road along its border.

    The surroundings are what a disc of radius DEEPEST can reach from outside the drawing; it is too large to slip
    through gaps in an outline. Enclosed regions that share no wall with the surroundings are closed, too, such as the
    infield of a race track that is drawn as two lines. If hardly any road is enclosed, nothing is closed.
    """
    room = needed(vehicle)
    reach = math.ceil(DEEPEST / NODE) + 1
    (box,) = ndimage.find_objects((nodes > 0.0).astype(int))
    drawn = np.zeros(np.add(nodes.shape, 2 * reach), dtype=bool)
    drawn[reach:-reach, reach:-reach][box] = nodes[box] <= 0.0
    parts, _ = ndimage.label(_distance(drawn) >= DEEPEST)
    outside = (parts == parts[0, 0])[reach:-reach, reach:-reach]
    inside = np.minimum(nodes, _distance(outside) - DEEPEST)
    if np.count_nonzero(inside >= room) < _LEAST_DRAWING * np.count_nonzero(nodes >= room):
        return nodes
    walls, _ = ndimage.label(inside < room, _CORNERS_TOO)
    beside = ndimage.binary_dilation(walls == walls[0, 0], _CORNERS_TOO)
    parts, _ = ndimage.label(inside >= room)
    return np.minimum(inside, _distance((parts > 0) & ~np.isin(parts, parts[beside])) - room)


def _bends(cells: np.ndarray, radius: float) -> csr_matrix:
    """Graph of a car's moves: vertex h * n + k is heading h at free cell k of n, and each edge an arc over free cells.

    An arc turns by one heading to the right, leads straight on, or turns by one heading to the left.
    Args: `cells`, bool [cells y, cells x], whether each cell is free; `radius` of the arcs.
    """
    arc, side = radius * _TURN, _SIDE * NODE
    shares = np.linspace(0.0, 1.0, math.ceil(arc / _STRIDE) + 1)[1:]
    reach = math.ceil(arc / side)
    row, column = np.nonzero(np.pad(cells, reach))
    number = np.full(np.add(cells.shape, 2 * reach), -1, dtype=np.int32)
    number[row, column] = np.arange(len(row))
    tails, heads = [], []
    for heading in range(_TURNS):
        for turn in (-1, 0, 1):
            angle = _TURN * (heading + turn * shares / 2)
            away = np.rint(arc * shares / side * [np.sin(angle), np.cos(angle)]).astype(int)
            passed = number[row[:, None] + away[0], column[:, None] + away[1]]
            clear = np.flatnonzero((passed >= 0).all(axis=1)).astype(np.int32)
            tails.append(np.int32(heading * len(row)) + clear)
            heads.append(np.int32((heading + turn) % _TURNS * len(row)) + passed[clear, -1])
    tail, head = np.concatenate(tails), np.concatenate(heads)
    size = _TURNS * len(row)
    return csr_matrix((np.ones(len(tail), dtype=bool), (tail, head)), (size, size))


def without_dead_ends(nodes: np.ndarray, vehicle: VehicleConfig) -> tuple[np.ndarray, np.ndarray]:
    """Close narrow places, dead ends, and road that is not joined to the rest.

    What stays is the largest part of the road on which a car can drive forwards from anywhere to anywhere (strongly
    connected). The car is taken to need wide bends and much room (_EASY), unless more than twice as much road stays
    with tight bends and little room (_HARD). Nothing is closed if all road is a dead end, or if it has more than
    _MOST_CELLS cells.
    Returns: the field; and bool [headings, cells y, cells x], whether a car at a cell with a heading can drive on:
    without end within what stays, or for FAR if all road is a dead end. If there are too many cells, all are True.
    """
    # A cell's clearance is the largest of its nodes.
    clearance = ndimage.maximum_filter(nodes, _SIDE, origin=-1)[::_SIDE, ::_SIDE]
    if np.count_nonzero(clearance >= needed(vehicle)) > _MOST_CELLS:
        return nodes, np.ones((_TURNS, *clearance.shape), dtype=bool)
    tightest = math.hypot(vehicle.wheelbase / math.tan(math.radians(vehicle.steering_limit)), vehicle.rear_axle)
    found = []
    for margin, ease in (_EASY, _HARD):
        room = vehicle.width / 2 + margin
        cells, ways = clearance >= room, np.zeros((_TURNS, *clearance.shape), dtype=bool)
        bends = _bends(cells, ease * tightest)
        _, part = connected_components(bends, connection="strong")
        largest = (part == np.bincount(part, minlength=1).argmax()).reshape(_TURNS, -1)
        ways[:, cells] = largest | np.roll(largest, _TURNS // 2, axis=0)  # also in the opposite direction
        core = ways.any(axis=0)
        holes, _ = ndimage.label(~core)
        core |= ~np.isin(holes, holes[~cells])  # keep holes without walls, such as the middle of a hall
        found.append((np.count_nonzero(core), room, core, ways))
    _, room, core, ways = found[0] if found[0][0] >= found[1][0] / 2 else found[1]
    (box,) = ndimage.find_objects(core.astype(int)) or [(slice(0, 0), slice(0, 0))]
    if math.hypot(*(side.stop - side.start for side in box)) * _SIDE * NODE < FAR:
        on = np.ones(bends.shape[0], dtype=bool)
        for _ in range(math.ceil(FAR / (ease * tightest * _TURN - NODE))):
            on = bends @ on
        ways[:, cells] = on.reshape(_TURNS, -1)
        return nodes, ways
    core = core.repeat(_SIDE, axis=0).repeat(_SIDE, axis=1)[: nodes.shape[0], : nodes.shape[1]]
    beyond = room + _SLACK - _distance(core)
    return np.minimum(nodes, np.maximum(beyond, _distance(beyond <= 0.0) - NODE)), ways


def drives_on(ways: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Whether a car can drive on from each of poses [n, 3]: bool [n]; see `without_dead_ends`."""
    heading = np.rint(poses[:, 2] / _TURN).astype(int) % _TURNS
    column, row = np.floor((poses[:, :2].T + NODE / 2) / (_SIDE * NODE)).astype(int)
    return ways[heading, row, column]
