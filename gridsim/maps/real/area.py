"""The drivable area of real lanes as a signed distance field."""

from __future__ import annotations

import math

import numpy as np
from PIL import Image, ImageDraw
from scipy import ndimage

from gridsim.jit import njit
from gridsim.maps.real.description import Lane
from gridsim.maps.roads import CELLS_PER_UNIT, FIELD_FLOOR, FIELD_STEPS

FINE = 2  # pixels per node of the field, along each axis
PIXEL = 1.0 / (CELLS_PER_UNIT * FINE)  # m, side of a pixel; the middle of every second pixel is a node
SLIT = 2  # pixels by which the road is grown, then shrunk: this fills gaps in the data up to twice as wide
ISLAND = 30.0  # m2; smaller pieces of wall, such as those inside junctions, become road, too
_REACH = math.ceil((255 / FIELD_STEPS + FIELD_FLOOR) / PIXEL) + 1  # pixels: beyond the largest clearance of a field

AIR = 0.3  # m; lanes are at least `gap` + 2 * AIR wide, because cars' ends swing out in bends and lane changes
SHARP = 0.1  # rad; where a lane turns by more than this at a point, the bend is sharp
SWEPT = 2.5  # m around a sharp bend that become road, because a car's corners may sweep them
_CIRCLE = np.stack([f(np.linspace(0.0, 2 * math.pi, 16, endpoint=False)) for f in (np.cos, np.sin)], axis=1)
_OUTSIDE = math.ceil(-FIELD_FLOOR / PIXEL) + 1  # pixels: deeper inside a wall than a field's lowest clearance


def clearance_of(lanes: dict[str, Lane], outlines: list[np.ndarray], size: np.ndarray, gap: float) -> np.ndarray:
    """Clearance float32 [rows, columns] (m) at the nodes of a torus of this size (m).

    Every lane has room for its cars: lanes narrower than `gap` (m, `load.gap_of`) plus twice AIR are widened to that
    width. `outlines` are the areas [n, 2] (m) of junctions, which are road, too.
    """
    columns, rows = (round(float(side) / PIXEL) for side in size)
    picture = Image.new("L", (columns, rows))
    draw = ImageDraw.Draw(picture)
    for lane in lanes.values():
        left, right = _widened(lane.left[:, :2], lane.right[:, :2], gap + 2.0 * AIR)
        for quad in np.stack([left[:-1], left[1:], right[1:], right[:-1]], axis=1):
            _fill(draw, quad, size)
        middle = (left + right) / 2
        onward = [middle[-1:] + np.diff(lanes[key].centre[:2, :2], axis=0) for key in lane.successors]
        for corner in np.concatenate([_corners(np.concatenate([middle, point])) for point in onward]):
            _fill(draw, corner + SWEPT * _CIRCLE, size)
    for outline in outlines:
        _fill(draw, outline, size)
    free = np.asarray(picture)
    # Distances are computed only in the part with road and in a margin around it, wrapped over the torus.
    index = [_window(np.asarray(free.any(axis=1 - axis))) for axis in (0, 1)]
    free = _without_gaps(free.take(index[0], axis=0, mode="wrap").take(index[1], axis=1, mode="wrap") > 0)
    part = np.empty((len(index[0]) // FINE, len(index[1]) // FINE), dtype=np.float32)
    _signed(free, PIXEL, _REACH, _OUTSIDE, FINE, part)
    nodes = np.full((rows // FINE, columns // FINE), FIELD_FLOOR, dtype=np.float32)
    node = [at[::FINE] // FINE % side for at, side in zip(index, nodes.shape, strict=True)]
    np.maximum.at(nodes, np.ix_(*node), part)
    return nodes


def _window(used: np.ndarray) -> np.ndarray:
    """Indices from the first to the last `used` pixel of a ring, with a margin on both sides; not yet wrapped.

    The first index and the number of indices are multiples of FINE.
    """
    first, last = np.flatnonzero(used)[[0, -1]]
    if last - first + 4 * _REACH > len(used):
        first, last = 0, len(used) - 1
    first = (first - 2 * _REACH) // FINE * FINE
    return np.arange(first, first + math.ceil((last + 2 * _REACH - first) / FINE) * FINE)


def _widened(left: np.ndarray, right: np.ndarray, least: float) -> tuple[np.ndarray, np.ndarray]:
    """A lane's bounds [n, 2], moved apart to `least` m where the lane is narrower."""
    middle, half = (left + right) / 2, (left - right) / 2
    half *= np.maximum(least / np.maximum(2.0 * np.hypot(*half.T), 1e-9), 1.0)[:, None]
    return middle + half, middle - half


def _corners(line: np.ndarray) -> np.ndarray:
    """The points [k, 2] of a line [n, 2] at which it bends so sharply (SHARP) that a car's ends leave the lane."""
    step = np.diff(line, axis=0)
    turn = np.diff(np.unwrap(np.arctan2(step[:, 1], step[:, 0])))
    return line[1:-1][abs(turn) > SHARP]


def _fill(draw: ImageDraw.ImageDraw, outline: np.ndarray, size: np.ndarray) -> None:
    """Draw a polygon [n, 2] (m) as road; what lies beyond a side of the torus is drawn at the opposite side."""
    low, high = np.floor(outline.min(axis=0) / size), np.floor(outline.max(axis=0) / size)
    for j in range(int(low[1]), int(high[1]) + 1):
        for i in range(int(low[0]), int(high[0]) + 1):
            draw.polygon(((outline - np.array([i, j]) * size) / PIXEL).ravel().tolist(), fill=1)


def _grown(region: np.ndarray) -> np.ndarray:
    """A region grown by SLIT pixels."""
    before, region = region, region.copy()
    for k in range(1, SLIT + 1):
        region[k:] |= before[:-k]
        region[:-k] |= before[k:]
    before, region = region, region.copy()
    for k in range(1, SLIT + 1):
        region[:, k:] |= before[:, :-k]
        region[:, :-k] |= before[:, k:]
    return region


def _without_gaps(free: np.ndarray) -> np.ndarray:
    """The road [rows, columns] with narrow slits and small islands of wall made road, too.

    No wall is left that is so thin that nodes of the field could miss it.
    """
    free = ~_grown(~_grown(free))
    wall = ~free.reshape(free.shape[0] // FINE, FINE, -1, FINE).all(axis=(1, 3))
    labels, count = ndimage.label(wall)
    small = np.bincount(labels.ravel(), minlength=count + 1) * (PIXEL * FINE) ** 2 < ISLAND
    small[0] = False
    return free | small[labels].repeat(FINE, axis=0).repeat(FINE, axis=1)


@njit(nogil=True)
def _signed(free, pixel, reach, outside, fine, nodes):
    """Write the distance (m) of each node to the edge between road and wall into `nodes`, positive on the road.

    The edge is half a pixel before the nearest pixel of the other kind, which is searched for within `reach` pixels of
    a node on the road, and within `outside` pixels of a node off it. If there is none, that limit is used.
    """
    rows, columns = free.shape
    along = np.full((rows, columns), reach, dtype=np.uint8)
    for turn in range(2):
        since = np.full(columns, reach, dtype=np.uint8)
        for step in range(1, rows):
            j, before = (step, step - 1) if turn == 0 else (rows - 1 - step, rows - step)
            for i in range(columns):
                since[i] = 1 if free[j, i] != free[before, i] else min(since[i] + 1, reach)
                along[j, i] = min(along[j, i], since[i])
    for row in range(nodes.shape[0]):
        j = fine * row
        for column in range(nodes.shape[1]):
            i = fine * column
            here = free[j, i]
            furthest = reach if here else outside
            best = min(np.int64(along[j, i]), furthest) ** 2
            for side in (-1, 1):
                for k in range(1, furthest):
                    if k * k >= best:
                        break
                    other = min(max(i + side * k, 0), columns - 1)
                    if free[j, other] != here:
                        best = min(best, k * k)
                        break
                    best = min(best, k * k + np.int64(along[j, other]) ** 2)
            distance = (math.sqrt(best) - 0.5) * pixel
            nodes[row, column] = distance if here else -distance
