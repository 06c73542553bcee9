"""Roads: strips with exact geometry, and the fields that kernels read.

The drivable area is the union of strips (lines and arcs with a half width) without the blocks (oriented rectangles,
such as parked cars). The signed clearance of a point is the maximum over the strips of (half width - distance to the
centre line), but at most the signed distance to the nearest block. It is positive on the road and zero on its edge,
exact near the edges, and elsewhere on the road a lower bound. Kernels interpolate it from a field of bytes; tests
compare it with the strips.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from gridsim.jit import F, freeze, leaf, njit

# In units (`SimConfig.unit`): metres, or less for small cars, whose roads are the same fields on a smaller scale.
CELLS_PER_UNIT = 2  # nodes of the clearance field per unit
FIELD_FLOOR = -2.0  # clearance of byte 0, also of places deeper inside a wall
FIELD_STEPS = 32.0  # steps of the byte per unit; byte 255 is a clearance of 5.97 or more
VISIT_CELL = 4  # side of the cells in which new ground is counted
THICK_WALL = 3.0  # if no wall of a road is thinner, rays and collisions need no checks for thin walls


class Road(NamedTuple):
    """A map as kernels read it; all arrays flat, read-only and C-contiguous. Sides are powers of two."""

    # uint32 [rows * columns], for each cell the clearance at its corners (0,0), (1,0), (0,1), (1,1) in (x, y), a byte
    # each, the lowest byte first
    field: np.ndarray
    columns: np.uint32  # nodes along x
    rows: np.uint32  # nodes along y
    width: np.float32  # m along x
    height: np.float32  # m along y
    speed_low: np.float32  # m/s, the speed interval
    speed_high: np.float32  # m/s
    thinnest: np.float32  # units; rays hit every wall that is at least this thick
    unit: np.float32  # m, a power of two
    per_m: np.float32  # units in a metre
    ways: np.float32  # 2: driving back over the same ground counts as new distance; 1: it does not


class Strips(NamedTuple):
    """Centre lines with half widths, in metres: the exact drivable area. Arrays float64, read-only."""

    lines: np.ndarray  # [n, 5]: x0, y0, x1, y1, half width
    arcs: np.ndarray  # [m, 6]: centre x, y, radius, start angle, sweep (rad, counter-clockwise), half width
    blocks: np.ndarray  # [k, 5]: centre x, y, heading (rad), half length, half width; not drivable

    @classmethod
    def of(cls, lines: ArrayLike = (), arcs: ArrayLike = (), blocks: ArrayLike = ()) -> Strips:
        """Strips from rows of numbers, as the attributes have them."""
        rows = ((lines, 5), (arcs, 6), (blocks, 5))
        return cls(*(freeze(np.asarray(part, dtype=np.float64).reshape(-1, width)) for part, width in rows))

    def scaled(self, factor: float) -> Strips:
        """All lengths multiplied by a factor."""
        if factor == 1.0:
            return self
        arcs, blocks = [factor, factor, factor, 1.0, 1.0, factor], [factor, factor, 1.0, factor, factor]
        return Strips.of(self.lines * factor, self.arcs * arcs, self.blocks * blocks)


@njit(nogil=True)
def _cut_blocks(field, blocks, widest):
    """Lower the clearance at nodes around each block; `widest` is the largest half width of a road."""
    rows, columns = field.shape
    node = 1.0 / CELLS_PER_UNIT
    for k in range(blocks.shape[0]):
        x, y, heading, half_length, half_width = blocks[k]
        c, s = math.cos(heading), math.sin(heading)
        reach_x = abs(c) * half_length + abs(s) * half_width + widest
        reach_y = abs(s) * half_length + abs(c) * half_width + widest
        i0, i1 = int(math.floor((x - reach_x) / node)), int(math.ceil((x + reach_x) / node))
        j0, j1 = int(math.floor((y - reach_y) / node)), int(math.ceil((y + reach_y) / node))
        for j in range(j0, j1 + 1):
            for i in range(i0, i1 + 1):
                dx, dy = i * node - x, j * node - y
                along = abs(dx * c + dy * s) - half_length
                across = abs(dy * c - dx * s) - half_width
                outside = math.sqrt(max(along, 0.0) ** 2 + max(across, 0.0) ** 2)
                distance = F(max(outside + min(max(along, across), 0.0), FIELD_FLOOR))
                row, column = j % rows, i % columns
                if distance < field[row, column]:
                    field[row, column] = distance


@njit(nogil=True)
def _clearance_nodes(lines, arcs, columns, rows):
    """Maximum of (half width - distance) at each node, at least FIELD_FLOOR; visits only the nodes near each strip."""
    field = np.full((rows, columns), F(FIELD_FLOOR), dtype=np.float32)
    node = 1.0 / CELLS_PER_UNIT
    for k in range(lines.shape[0] + arcs.shape[0]):
        is_line = k < lines.shape[0]
        if is_line:
            ax, ay, bx, by, w = lines[k]
            dx, dy = bx - ax, by - ay
            inverse = 1.0 / max(dx * dx + dy * dy, 1e-12)
            x_low, x_high, y_low, y_high = min(ax, bx), max(ax, bx), min(ay, by), max(ay, by)
        else:
            ax, ay, radius, first, sweep, w = arcs[k - lines.shape[0]]
            middle, half = first + 0.5 * sweep, 0.5 * abs(sweep)
            mx, my, cos_half = math.cos(middle), math.sin(middle), math.cos(half)
            e0x, e0y = ax + radius * math.cos(first), ay + radius * math.sin(first)
            e1x, e1y = ax + radius * math.cos(first + sweep), ay + radius * math.sin(first + sweep)
            px, py = ax + radius * mx, ay + radius * my
            size = 2.0 * radius * math.sin(0.5 * half)  # from the arc's middle to its ends
            x_low, x_high, y_low, y_high = px - size, px + size, py - size, py + size
        band = w - FIELD_FLOOR
        i0, i1 = int(math.floor((x_low - band) / node)), int(math.ceil((x_high + band) / node))
        j0, j1 = int(math.floor((y_low - band) / node)), int(math.ceil((y_high + band) / node))
        for j in range(j0, j1 + 1):
            y = j * node
            for i in range(i0, i1 + 1):
                x = i * node
                if is_line:
                    t = min(max(((x - ax) * dx + (y - ay) * dy) * inverse, 0.0), 1.0)
                    distance = math.sqrt((x - ax - t * dx) ** 2 + (y - ay - t * dy) ** 2)
                else:
                    ux, uy = x - ax, y - ay
                    norm = math.sqrt(ux * ux + uy * uy)
                    if half >= math.pi - 1e-9 or ux * mx + uy * my >= norm * cos_half:
                        distance = abs(norm - radius)
                    else:
                        distance = math.sqrt(min((x - e0x) ** 2 + (y - e0y) ** 2, (x - e1x) ** 2 + (y - e1y) ** 2))
                clearance = F(w - distance)
                row, column = j % rows, i % columns
                if clearance > field[row, column]:
                    field[row, column] = clearance
    return field


def pack_field(nodes: np.ndarray) -> np.ndarray:
    """`Road.field` of the clearance (units) at the nodes [rows, columns]."""
    steps = (nodes - F(FIELD_FLOOR)) * F(FIELD_STEPS) + F(0.5)
    here = np.clip(steps, 0.0, 255.0).astype(np.uint8)
    right, above = np.roll(here, -1, axis=1), np.roll(here, -1, axis=0)
    return freeze(np.stack([here, right, above, np.roll(right, -1, axis=0)], axis=-1).view("<u4").ravel())


def node_clearance(road: Road) -> np.ndarray:
    """Clearance (units) at the nodes of a road's field: float32 [rows, columns]."""
    steps = (road.field & np.uint32(255)).reshape(int(road.rows), int(road.columns))
    return steps.astype(np.float32) / F(FIELD_STEPS) + F(FIELD_FLOOR)


@leaf
def clearance(road, x, y):
    """Signed distance (m) from a point to the road's edge, positive on the road; x, y in m, also beyond the sides.

    It is limited to what a byte of the field holds: -2 to 5.97 units.
    """
    nodes_per_m = F(CELLS_PER_UNIT) * road.per_m
    px, py = x * nodes_per_m, y * nodes_per_m
    fx, fy = np.floor(px), np.floor(py)  # NumPy's floor returns float32 here, that of `math` int64
    ux, uy = px - fx, py - fy
    i = np.uint32(np.int32(fx)) & np.uint32(road.columns - np.uint32(1))
    j = np.uint32(np.int32(fy)) & np.uint32(road.rows - np.uint32(1))
    word = road.field[np.uint32(j * road.columns + i)]
    q00 = F(np.int32(word & np.uint32(255)))
    q10 = F(np.int32((word >> np.uint32(8)) & np.uint32(255)))
    q01 = F(np.int32((word >> np.uint32(16)) & np.uint32(255)))
    q11 = F(np.int32(word >> np.uint32(24)))
    low = q00 + ux * (q10 - q00)
    high = q01 + ux * (q11 - q01)
    return (low + uy * (high - low)) * (F(1.0 / FIELD_STEPS) * road.unit) + F(FIELD_FLOOR) * road.unit


@njit
def clearances(road, points):
    """`clearance` (m) of points [n, 2]: float32 [n]."""
    found = np.empty(points.shape[0], dtype=np.float32)
    for k in range(points.shape[0]):
        found[k] = clearance(road, points[k, 0], points[k, 1])
    return found


def clearance_nodes(strips: Strips, width: float, height: float) -> np.ndarray:
    """Clearance float32 [rows, columns] of strips at the nodes of the field. The sides must be powers of two.

    All lengths, also those of the strips, are in units.
    """
    columns, rows = round(width * CELLS_PER_UNIT), round(height * CELLS_PER_UNIT)
    if columns.bit_count() != 1 or rows.bit_count() != 1:
        raise ValueError(f"a field's sides must be powers of two, not {columns} x {rows}")
    nodes = _clearance_nodes(strips.lines, strips.arcs, columns, rows)
    widest = max(strips.lines[:, 4].max(initial=0.0), strips.arcs[:, 5].max(initial=0.0))
    _cut_blocks(nodes, strips.blocks, widest)
    return nodes


def make_road(
    nodes: np.ndarray, speed_interval: tuple[float, float], thinnest: float, unit: float = 1.0, ways: int = 1
) -> Road:
    """The Road of a clearance field [rows, columns], in units of `unit` m as `thinnest` is; speeds in m/s."""
    rows, columns = nodes.shape
    return Road(
        field=pack_field(nodes),
        columns=np.uint32(columns),
        rows=np.uint32(rows),
        width=F(columns * unit / CELLS_PER_UNIT),
        height=F(rows * unit / CELLS_PER_UNIT),
        speed_low=F(speed_interval[0]),
        speed_high=F(speed_interval[1]),
        thinnest=F(thinnest),
        unit=F(unit),
        per_m=F(1.0 / unit),
        ways=F(ways),
    )
