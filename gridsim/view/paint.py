"""Painting into pictures: the ground from the clearance field, rounded boxes, the shapes of a car, and all colours.

Shapes are drawn in pixels, which `render` computes. Other lengths are in units (`SimConfig.unit`), because `render`
magnifies the maps of small cars, so that a unit is a metre on them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import minimum_filter

from gridsim.jit import F, njit
from gridsim.maps.roads import CELLS_PER_UNIT, FIELD_FLOOR, Road, clearance, node_clearance, pack_field

GROUND = (226, 231, 218)
GROUND_OTHER = (220, 226, 211)  # colour of every other square of the ground, so that motion is visible
VERGE = (190, 197, 178)
ASPHALT = (66, 70, 79)
EDGE_LINE = (236, 238, 240)
MARK, MARK_OPPOSITE = (214, 217, 222), (240, 205, 112)
EGO, OTHER, PARKED = (255, 92, 43), (96, 168, 232), (152, 160, 171)
GLASS, TYRE, LIGHT = (28, 32, 40), (24, 25, 29), (255, 246, 214)
RAY, PATH, ROUTE = (92, 225, 200), (233, 172, 86), (240, 120, 235)
HUD = (20, 22, 28)
SIGNALS = (64, 192, 87), (250, 190, 40), (240, 50, 50)  # of `lights.GO`, CLEARING and STOP

SQUARE = 16.0  # units (`SimConfig.unit`), side of the ground's squares
EDGE_AT, EDGE_HALF = 0.3, 0.08  # units from the road's edge to its white line, and half that line's width
VERGE_WIDTH = 0.7  # units
DIP = 1.0  # units from the road's edge beyond which dips of the clearance are removed

_COLOURS = np.array([GROUND, GROUND_OTHER, VERGE, ASPHALT, EDGE_LINE], dtype=np.float32)
SHAPE = 11  # numbers of a shape: centre, direction, half length, half width, corner radius, red, green, blue, opacity


@njit(nogil=True)
def draw_ground(road, repeats, origin, step_x, step_y, pixels_per_m, image):
    """Draw the ground and the road.

    Args: `road`, after `smoothed`; `repeats`, whether the map repeats beyond its sides (else there is wall);
    `origin`, the place of the first pixel's centre; `step_x` and `step_y`, the steps to the next pixel to the right and
    below. The last three are float64 [2] in units (`SimConfig.unit`).
    Writes: image uint8 [h, w, 3].
    """
    zero, half, one = F(0.0), F(0.5), F(1.0)
    scale = F(pixels_per_m)
    line_at, line_half = F(EDGE_AT) * scale, F(EDGE_HALF) * scale
    inner = F(EDGE_AT + EDGE_HALF) + one / scale  # units from the edge: further inside there is only asphalt
    outer = -max(F(VERGE_WIDTH), one / scale)  # units from the edge: further outside there is only ground
    for j in range(image.shape[0]):
        for i in range(image.shape[1]):
            x = F(origin[0] + i * step_x[0] + j * step_y[0])
            y = F(origin[1] + i * step_x[1] + j * step_y[1])
            inside = zero <= x and x < road.width and zero <= y and y < road.height
            clear = clearance(road, x, y) if repeats or inside else F(FIELD_FLOOR)
            ground = (np.int32(np.floor(x / F(SQUARE))) + np.int32(np.floor(y / F(SQUARE)))) & 1
            if clear > inner or clear < outer:
                for c in range(3):
                    image[j, i, c] = np.uint8(_COLOURS[3 if clear > inner else ground, c])
                continue
            edge = clear * scale  # pixels from the road's edge, positive on the road
            off = abs(edge - line_at)
            verge = min(max(one + clear * F(1.0 / VERGE_WIDTH), zero), one)
            asphalt = min(max(edge + half, zero), one)
            line = max(min(off + half, line_half) - max(off - half, -line_half), zero) * F(0.85)
            for c in range(3):
                value = _COLOURS[ground, c]
                value += verge * (_COLOURS[2, c] - value)
                value += asphalt * (_COLOURS[3, c] - value)
                value += line * (_COLOURS[4, c] - value)
                image[j, i, c] = np.uint8(value + half)


def smoothed(road: Road) -> Road:
    """A road without dips of the clearance away from the edges.

    The clearance dips where strips meet, in the middle of a junction even to 0, which would be drawn as an edge.
    """
    nodes = node_clearance(road)
    least = minimum_filter(nodes, 2 * round(DIP * CELLS_PER_UNIT) + 1, mode="wrap")
    return road._replace(field=pack_field(np.where(least > -0.09, np.maximum(nodes, DIP), nodes)))


@njit(nogil=True)
def draw_shapes(shapes, image):
    """Blend rounded boxes float32 [n, 11] (`SHAPE`), in pixels, into image uint8 [h, w, 3], one after the other."""
    height, width = image.shape[0], image.shape[1]
    half, zero, one = F(0.5), F(0.0), F(1.0)
    for k in range(shapes.shape[0]):
        x0, y0, dx, dy, length, across, radius = shapes[k, :7]
        opacity = shapes[k, 10]
        tall = abs(dy) * length + abs(dx) * across + one
        wide = abs(dx) * length + abs(dy) * across + one
        if not (tall < 32768.0 and wide < 32768.0 and abs(x0) < 32768.0 and abs(y0) < 32768.0):
            continue
        top, bottom = max(int(y0 - tall) - 1, 0), min(int(y0 + tall) + 2, height)
        for j in range(top, bottom):
            y = F(j) - y0
            first, last = x0 - wide, x0 + wide
            if abs(dy) > F(0.01):  # only the part of a slanted shape that crosses this row
                middle, reach = x0 + y * dx / dy, (across + one) / abs(dy)
                first, last = max(first, middle - reach), min(last, middle + reach)
            for i in range(max(int(first) - 1, 0), min(int(last) + 2, width)):
                x = F(i) - x0
                u = abs(x * dx + y * dy) - length + radius
                v = abs(y * dx - x * dy) - across + radius
                outside = math.sqrt(max(u, zero) ** 2 + max(v, zero) ** 2) + min(max(u, v), zero) - radius
                cover = min(max(half - outside, zero), one) * opacity
                if cover > zero:
                    for c in range(3):
                        under = F(image[j, i, c])
                        image[j, i, c] = np.uint8(under + cover * (shapes[k, 7 + c] - under) + half)


def car_parts(
    length: float, width: float, front_axle: float, rear_axle: float, steering: float, colour: Sequence[int]
) -> np.ndarray:
    """Shapes [k, 11] of a car at the origin, heading along +x; lengths in units (`SimConfig.unit`), steering in rad."""
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
