"""Painting into pictures: the ground from the clearance field, rounded boxes, the shapes of a car, and all colours.

Coordinates are pixels; `render` computes them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import minimum_filter

from gridsim.jit import leaf, njit
from gridsim.maps.map import Map
from gridsim.maps.roads import CELLS_PER_M, FIELD_FLOOR, FIELD_UNITS, freeze

GROUND = (226, 231, 218)
GROUND_OTHER = (220, 226, 211)  # of every other square, so that motion is visible
VERGE = (190, 197, 178)
ASPHALT = (66, 70, 79)
EDGE_LINE = (236, 238, 240)
MARK, MARK_OPPOSITE = (214, 217, 222), (240, 205, 112)
EGO, OTHER, PARKED = (255, 92, 43), (96, 168, 232), (152, 160, 171)
GLASS, TYRE, LIGHT = (28, 32, 40), (24, 25, 29), (255, 246, 214)
RAY, PATH = (92, 225, 200), (233, 172, 86)
FREE, OCCUPIED, UNKNOWN = (92, 225, 200), (255, 70, 90), (16, 18, 24)
HUD = (20, 22, 28)

BLOCK = 8  # pixels, side of the blocks that are tested together
SQUARE = 32  # cells of the field, side of the ground's squares
EDGE_AT, EDGE_HALF = 0.3, 0.08  # m from the road's edge to its white line, and half that line's width
VERGE_WIDTH = 0.7  # m
DIP = 1.0  # m from the edge beyond which dips of the clearance are removed

_F, _I, _U = np.float32, np.int32, np.uint32
SHAPE = 11  # numbers of a shape: centre, direction, half length, half width, corner radius, red, green, blue, opacity


@leaf
def _clear(field, columns, rows, wrap, turn, x, y):
    """Clearance (m) at a place in cells of the field, counted from `turn` tiles before the first; off the map, wall."""
    ix, iy = _I(x), _I(y)
    mask_x, mask_y = _U(columns - _U(1)), _U(rows - _U(1))
    if not wrap and (_U(ix - _I(turn) * _I(columns)) > mask_x or _U(iy - _I(turn) * _I(rows)) > mask_y):
        return _F(FIELD_FLOOR)
    ux, uy = x - _F(ix), y - _F(iy)
    word = field[_U((_U(iy) & mask_y) * _U(columns) + (_U(ix) & mask_x))]
    q00, q10 = _F(_I(word & _U(255))), _F(_I((word >> _U(8)) & _U(255)))
    q01, q11 = _F(_I((word >> _U(16)) & _U(255))), _F(_I(word >> _U(24)))
    low, high = q00 + ux * (q10 - q00), q01 + ux * (q11 - q01)
    return (low + uy * (high - low)) * _F(1.0 / FIELD_UNITS) + _F(FIELD_FLOOR)


@njit(nogil=True)
def draw_ground(field, columns, rows, wrap, turn, origin, step_x, step_y, pixels_per_m, colours, image):
    """Ground and road.

    Args: packed field with its sides; whether it repeats; position of the first pixel's centre and the steps to the
    next pixel to the right and below, float64 [2], in cells of the field from `turn` tiles before the first, so that
    none is below 0; pixels_per_m; colours float32 [5, 3]: ground, its other squares, verge, asphalt, edge line.
    Writes: image uint8 [h, w, 3].
    """
    zero, half, one = _F(0.0), _F(0.5), _F(1.0)
    scale = _F(pixels_per_m)
    line_half = _F(EDGE_HALF) * scale
    inner = _F(EDGE_AT + EDGE_HALF) + one / scale  # m from the edge beyond which there is only asphalt
    outer = -max(_F(VERGE_WIDTH), one / scale)  # ... and only ground
    reach = _F(0.75 * BLOCK) / scale  # m from a block's middle to its corners; clearance changes no faster than that
    ax, ay, bx, by = _F(step_x[0]), _F(step_x[1]), _F(step_y[0]), _F(step_y[1])
    for top in range(0, image.shape[0], BLOCK):
        for left in range(0, image.shape[1], BLOCK):
            x0 = _F(origin[0] + left * step_x[0] + top * step_y[0])
            y0 = _F(origin[1] + left * step_x[1] + top * step_y[1])
            middle = _F((BLOCK - 1) / 2)
            clear = _clear(field, columns, rows, wrap, turn, x0 + middle * (ax + bx), y0 + middle * (ay + by))
            known = clear > inner + reach or clear < outer - reach
            for j in range(top, min(top + BLOCK, image.shape[0])):
                for i in range(left, min(left + BLOCK, image.shape[1])):
                    across, down = _F(i - left), _F(j - top)
                    x, y = x0 + across * ax + down * bx, y0 + across * ay + down * by
                    if not known:
                        clear = _clear(field, columns, rows, wrap, turn, x, y)
                    if clear > inner:
                        for c in range(3):
                            image[j, i, c] = np.uint8(colours[3, c])
                        continue
                    base = (_I(x) // _I(SQUARE) + _I(y) // _I(SQUARE)) & 1
                    if clear < outer:
                        for c in range(3):
                            image[j, i, c] = np.uint8(colours[base, c])
                        continue
                    edge = clear * scale  # pixels from the road's edge, positive on it
                    road = min(max(edge + half, zero), one)
                    verge = min(max(one + clear * _F(1.0 / VERGE_WIDTH), zero), one)
                    off = abs(edge - _F(EDGE_AT) * scale)
                    line = max(min(off + half, line_half) - max(off - half, -line_half), zero) * _F(0.85)
                    for c in range(3):
                        value = colours[base, c]
                        value += verge * (colours[2, c] - value)
                        value += road * (colours[3, c] - value)
                        value += line * (colours[4, c] - value)
                        image[j, i, c] = np.uint8(value + half)


def smoothed(road_map: Map) -> np.ndarray:
    """The map's clearance field without dips away from the edges, packed as in `Road`.

    The clearance dips where strips meet, in the middle of a junction even to 0, which would be drawn as an edge.
    """
    road = road_map.road
    nodes = (road.field & np.uint32(255)).astype(np.uint8).reshape(int(road.rows), int(road.columns))
    least = minimum_filter(nodes, 2 * round(DIP * CELLS_PER_M) + 1, mode="wrap")
    inside = least > round((-FIELD_FLOOR - 0.1) * FIELD_UNITS)
    shown = np.where(inside, np.maximum(nodes, round((DIP - FIELD_FLOOR) * FIELD_UNITS)), nodes).astype(np.uint32)
    right = np.roll(shown, -1, axis=1)
    low, high = shown | right << 8, np.roll(shown, -1, axis=0) | np.roll(right, -1, axis=0) << 8
    return freeze((low | high << 16).ravel())


@njit(nogil=True)
def draw_shapes(shapes, image):
    """Blend rounded boxes float32 [n, 11] in pixels, in this order, into image uint8 [h, w, 3]."""
    height, width = image.shape[0], image.shape[1]
    half, zero, one = _F(0.5), _F(0.0), _F(1.0)
    for k in range(shapes.shape[0]):
        x0, y0, dx, dy, length, across, radius = shapes[k, :7]
        opacity = shapes[k, 10]
        tall = abs(dy) * length + abs(dx) * across + one
        wide = abs(dx) * length + abs(dy) * across + one
        if not (tall < 32768.0 and wide < 32768.0 and abs(x0) < 32768.0 and abs(y0) < 32768.0):
            continue
        top, bottom = max(int(y0 - tall) - 1, 0), min(int(y0 + tall) + 2, height)
        for j in range(top, bottom):
            y = _F(j) - y0
            first, last = x0 - wide, x0 + wide
            if abs(dy) > _F(0.01):  # only the part of a slanted shape that crosses this row
                middle, reach = x0 + y * dx / dy, (across + one) / abs(dy)
                first, last = max(first, middle - reach), min(last, middle + reach)
            for i in range(max(int(first) - 1, 0), min(int(last) + 2, width)):
                x = _F(i) - x0
                u = abs(x * dx + y * dy) - length + radius
                v = abs(y * dx - x * dy) - across + radius
                outside = math.sqrt(max(u, zero) ** 2 + max(v, zero) ** 2) + min(max(u, v), zero) - radius
                cover = min(max(half - outside, zero), one) * opacity
                if cover > zero:
                    for c in range(3):
                        under = _F(image[j, i, c])
                        image[j, i, c] = np.uint8(under + cover * (shapes[k, 7 + c] - under) + half)


def car_parts(
    length: float, width: float, front_axle: float, rear_axle: float, steering: float, colour: Sequence[int]
) -> np.ndarray:
    """Shapes [k, 11] of a car at the origin heading along +x, in m."""
    a, b = length / 2, width / 2
    c, s = math.cos(steering), math.sin(steering)
    light = [min(255, v + (255 - v) // 4) for v in colour]
    dark = [v * 7 // 10 for v in colour]
    tyre = (0.19 * a, 0.12, 0.08, *TYRE, 1.0)
    return np.array(
        [
            (0.0, 0.0, 1, 0, a + 0.35, b + 0.35, 0.7, 0, 0, 0, 0.16),  # shadow
            *((front_axle, side * (b - 0.08), c, s, *tyre) for side in (-1, 1)),
            *((-rear_axle, side * (b - 0.08), 1, 0, *tyre) for side in (-1, 1)),
            (0.0, 0.0, 1, 0, a, b - 0.04, 0.42 * b, *dark, 1.0),
            (0.0, 0.0, 1, 0, a - 0.08, b - 0.13, 0.36 * b, *colour, 1.0),
            (0.30 * a, 0.0, 1, 0, 0.15 * a, 0.76 * b, 0.16, *GLASS, 1.0),
            (-0.66 * a, 0.0, 1, 0, 0.09 * a, 0.68 * b, 0.12, *GLASS, 1.0),
            (-0.20 * a, 0.0, 1, 0, 0.36 * a, 0.70 * b, 0.18, *light, 1.0),  # roof
            *((0.93 * a, side * 0.62 * b, 1, 0, 0.05 * a, 0.20 * b, 0.09, *LIGHT, 1.0) for side in (-1, 1)),
            *((-0.95 * a, side * 0.64 * b, 1, 0, 0.03 * a, 0.20 * b, 0.05, 196, 30, 42, 1.0) for side in (-1, 1)),
        ],
        dtype=np.float32,
    )
