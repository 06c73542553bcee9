"""Maps from pictures: the signed clearance of the road, and poses where a car can start.

All lengths are in units (`SimConfig.unit`), which are metres except for small cars: `files` converts them.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from gridsim.config import VehicleConfig
from gridsim.maps.closing import (
    DEEPEST,
    FAR,
    MARGIN,
    NODE,
    drives_on,
    needed,
    without_dead_ends,
    without_surroundings,
)  # fmt: skip
from gridsim.maps.roads import CELLS_PER_UNIT, FIELD_FLOOR

OUTSIDE = -FIELD_FLOOR  # units of wall around the road, at least, because the field wraps round at its sides
_FINE = 0.25  # units, largest pixels on which distances are measured; larger ones are subdivided
HALF_WALL = 0.4  # units, half the thickness that thin walls are given; above 0.36, a disc always covers a node
_TIP = 0.25  # units that a corner may extend beyond a disc of radius HALF_WALL without being a thin wall
_HALO = DEEPEST + 2.0  # units around a tile within which pixels can influence it
_TILE = 128  # nodes along a side of the tiles in which the field is computed

_TOUCH = 0.05  # units free around a car at a start given in the file, at least
_SMOOTH = 3.0  # units, standard deviation of the Gaussian over which a road's direction is averaged
_COHERENCE = 0.5  # least agreement of directions at a start, from 0 (an open place, a crossing) to 1 (a straight road)
_STARTS = 512  # starts that are found on a map, at most
_APART = 24  # nodes of wall around a window, which wraps: averages near one side must not see road near the other
_BACK = np.array([0.0, 0.0, math.pi])


def _depth(inside: np.ndarray, pixel: float) -> np.ndarray:
    """Distance (units) of a region's pixels to its edge, which is half a pixel before the nearest pixel outside."""
    return np.maximum(ndimage.distance_transform_edt(inside) - 0.5, 0.0) * pixel


def _signed(free: np.ndarray, pixel: float) -> np.ndarray:
    """Distance (units) of pixels' centres to the edge between road and wall, positive on the road.

    Thin walls are thickened first, so that the nodes of the field do not miss them. A wall is thin where no disc of
    radius HALF_WALL fits into it; such a disc is put on each point of its middle line.
    """
    depth = _depth(~free, pixel)
    thick = depth >= HALF_WALL
    middle = ~free & ~thick & (depth >= ndimage.maximum_filter(depth, size=3))
    if middle.any() and thick.any():
        middle &= ndimage.distance_transform_edt(~thick) * pixel > HALF_WALL + _TIP
    if middle.any():
        free = free & (ndimage.distance_transform_edt(~middle) * pixel > HALF_WALL)
        depth = _depth(~free, pixel)
    return np.where(free, _depth(free, pixel), -depth).astype(np.float32)


def signed_clearance(free: np.ndarray, resolution: float, columns: int, rows: int) -> np.ndarray:
    """Signed clearance (units) at the nodes of the field: float32 [rows, columns].

    Exact to a fifth of a pixel, up to the largest clearance of the field. It works tile by tile, to bound the memory.
    Args: `free`, bool [pixels y, pixels x], which pixels are road; `resolution`, units a pixel.
    """
    halo = math.ceil(_HALO / resolution) + 1
    cut = max(math.ceil(resolution / _FINE - 1e-9), 1)
    padded = np.pad(free, halo)
    # Road that begins at the picture's edge needs wall before it: nodes with negative indices wrap to the far end.
    used = [np.flatnonzero(free.any(axis=axis))[0] * resolution for axis in (1, 0)]
    first = [min(math.floor((edge - OUTSIDE) * CELLS_PER_UNIT), 0) for edge in used]
    nodes = np.full((rows, columns), FIELD_FLOOR, dtype=np.float32)
    for j in range(0, rows, _TILE):
        for i in range(0, columns, _TILE):
            index, window, at = [], [], []
            for k, (start, side) in enumerate(((j, rows), (i, columns))):
                node = first[k] + np.arange(start, min(start + _TILE, side))
                pixel = node * (NODE / resolution)  # from the picture's lower left corner
                low = min(max(math.floor(pixel[0]), 0), padded.shape[k])
                high = min(max(math.ceil(pixel[-1]) + 2 * halo, 0), padded.shape[k])
                index.append(node % side)
                window.append(slice(low, high))
                at.append((pixel + halo - low) * cut - 0.5)
            part = padded[window[0], window[1]]
            if not part.any():
                continue
            distance = np.float32(DEEPEST)
            if not part.all():
                signed = _signed(part.repeat(cut, axis=0).repeat(cut, axis=1), resolution / cut)
                distance = ndimage.map_coordinates(signed, np.meshgrid(*at, indexing="ij"), order=1, mode="nearest")
            nodes[np.ix_(*index)] = np.clip(distance, FIELD_FLOOR, DEEPEST)
    return nodes


def _clearance_around(nodes: np.ndarray, poses: np.ndarray, along: np.ndarray, left: np.ndarray | float) -> np.ndarray:
    """Clearance [n, points] at points `along` and to the `left` of each of poses [n, 3]; bilinear, as in kernels."""
    x, y, heading = poses[:, :1], poses[:, 1:2], poses[:, 2:]
    c, s = np.cos(heading), np.sin(heading)
    at = [(y + along * s + left * c) * CELLS_PER_UNIT, (x + along * c - left * s) * CELLS_PER_UNIT]
    return ndimage.map_coordinates(nodes, at, order=1, mode="grid-wrap")


def _fits(nodes: np.ndarray, poses: np.ndarray, vehicle: VehicleConfig, margin: float) -> np.ndarray:
    """Whether a car with a margin (units) around it is entirely on the road at poses [n, 3]: bool [n]."""
    half = np.array([vehicle.length, vehicle.width]) / 2 + margin
    along, left = (np.linspace(-h, h, math.ceil(2 * h / NODE) + 1) for h in half)
    u, v = (points.ravel() for points in np.meshgrid(along, left))
    return np.all(_clearance_around(nodes, poses, u, v) >= 0.0, axis=1)


def _directions(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The road's axis at each node: angle (rad) float [rows, columns], and its coherence, 0 to 1.

    By the structure tensor of the clearance (Bigun and Granlund 1987): near a road's middle, gradients point across it.
    """
    gx = np.roll(nodes, -1, axis=1) - np.roll(nodes, 1, axis=1)
    gy = np.roll(nodes, -1, axis=0) - np.roll(nodes, 1, axis=0)

    def smooth(values: np.ndarray) -> np.ndarray:
        return ndimage.gaussian_filter(values, _SMOOTH * CELLS_PER_UNIT, mode="wrap", truncate=2.5)

    xx, yy, xy = smooth(gx * gx), smooth(gy * gy), smooth(gx * gy)
    across = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    return across + math.pi / 2, np.hypot(xx - yy, 2.0 * xy) / np.maximum(xx + yy, 1e-6)


def _window(nodes: np.ndarray) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """The part of a field that has road, with wall around it: its index into the field, and its corner x, y (units).

    A track may be small in a large picture. A side is kept whole where cutting it would not make it shorter.
    """
    corner, index = np.zeros(2), [np.arange(side) for side in nodes.shape]
    for axis, side in enumerate(nodes.shape):
        road = np.flatnonzero((nodes > 0.0).any(axis=1 - axis))
        if len(road) and road[-1] - road[0] + 2 * _APART < side:
            index[axis] = np.arange(road[0] - _APART, road[-1] + _APART) % side
            corner[1 - axis] = (road[0] - _APART) * NODE
    return np.ix_(*index), corner


def road_length(nodes: np.ndarray) -> float:
    """Estimated length (units) of the longest connected road: area over width. Within 10 % for a ring."""
    nodes = nodes[_window(nodes)[0]]
    road = nodes > 0.0
    labels, _ = ndimage.label(road)
    middle = road & (nodes >= ndimage.maximum_filter(nodes, size=5, mode="wrap") - 0.1)
    area = np.bincount(labels[road]) * NODE**2
    part, count = labels[middle], len(area)
    width = 2.0 * np.bincount(part, nodes[middle], count) / np.maximum(np.bincount(part, minlength=count), 1)
    return float((area / np.maximum(width, NODE)).max())


def _spread_sample(items: np.ndarray, count: int) -> np.ndarray:
    """At most `count` of the items, evenly spread over their order."""
    return items[np.linspace(0, len(items) - 1, count).round().astype(int)] if len(items) > count else items


def has_room(nodes: np.ndarray, vehicle: VehicleConfig) -> np.ndarray:
    """Where a car has room on both sides, in connected parts with an extent of FAR or more: bool [rows, columns]."""
    parts, _ = ndimage.label(nodes >= needed(vehicle))
    extent = [math.hypot(*(side.stop - side.start for side in box)) * NODE for box in ndimage.find_objects(parts)]
    return (np.array([0.0, *extent]) >= FAR)[parts]


def find_starts(
    nodes: np.ndarray, vehicle: VehicleConfig, unit: float, surrounded: bool
) -> tuple[np.ndarray, np.ndarray, float]:
    """Close parts of a picture's road (see `closing`), and find starts on what stays open.

    Args: the field, a car in units of `unit` m, and whether the road has surroundings that are drawn like road.
    Returns: the field with walls where it is closed; start poses float64 [n, 3] (x, y, heading) along the road, both
    ways, where a car has a margin around it and can drive on; the share of the road, without its surroundings, that
    `without_dead_ends` closed.
    Raises: ValueError if there are no such poses.
    """
    index, corner = _window(nodes)
    within = nodes[index]
    if not has_room(within, vehicle).any():
        raise ValueError(
            f"no room for a car: the road is nowhere {unit * 2 * needed(vehicle):.3g} m wide over "
            f"{unit * FAR:.3g} m; check the resolution and which pixels are bright"
        )
    if surrounded:
        within = without_surroundings(within, vehicle)
    part, ways = without_dead_ends(within, vehicle)
    large = has_room(part, vehicle)
    ridge = large & (part >= ndimage.maximum_filter(part, size=5, mode="wrap") - 0.25)
    angle, coherence = _directions(part)
    row, column = np.nonzero(ridge)
    along = np.column_stack([column * NODE, row * NODE, angle[row, column]])[coherence[row, column] >= _COHERENCE]
    along = _spread_sample(along, 4 * _STARTS)
    poses = np.concatenate([along, along + _BACK])
    poses = poses[_fits(part, poses, vehicle, MARGIN) & drives_on(ways, poses)]
    if not len(poses):
        raise ValueError(
            f"no room for a car of {unit * vehicle.length:g} m x {unit * vehicle.width:g} m that could drive on for "
            f"{unit * FAR:g} m; check the resolution and which pixels are bright, or give starts in a YAML"
        )
    poses[:, :2] += corner
    nodes = nodes.copy()
    nodes[index] = part
    dead = 1.0 - np.count_nonzero(part > 0.0) / np.count_nonzero(within > 0.0)
    return nodes, _spread_sample(poses, _STARTS), dead


def check_starts(nodes: np.ndarray, poses: np.ndarray, vehicle: VehicleConfig, unit: float = 1.0) -> None:
    """Raises: ValueError if at one of the poses [n, 3] (x, y, heading) a car with _TOUCH around it is not on the road.

    The poses are in units, of `unit` m; only the message is in m.
    """
    inside = ((poses[:, :2] >= 0.0) & (poses[:, :2] < np.array(nodes.shape[::-1]) * NODE)).all(axis=1)
    wrong = poses[~(inside & _fits(nodes, poses, vehicle, _TOUCH))]
    if len(wrong):
        x, y = wrong[0, :2] * unit
        raise ValueError(f"starts: at {x:g} m, {y:g} m from the lower left corner a car is not entirely on the road")
