"""Lanes from paths: equally spaced points, successors and crossings.

A path is a start pose and pieces of constant curvature, so that its points, its length and its sharpest bend are exact.
Successors and crossings are found from the geometry: a lane's successors begin where it ends, and its crossings are
the lanes that come too close to it, apart from neighbours, predecessors, successors and lanes with the same beginning.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from gridsim.config import CROSSING_GAP
from gridsim.jit import freeze, njit
from gridsim.maps.lights import no_lights
from gridsim.maps.network import Network
from gridsim.maps.roads import THICK_WALL, Strips

Plan = tuple[Strips, Network]  # a map's drivable area and its lanes


class Scenario(NamedTuple):
    """A kind of road: its layout and its driving limitations (the paper's term).

    Lengths and speeds are those for a `SimConfig.unit` of 1 m; `scenarios.build` scales them for small cars.
    """

    layout: Callable[[np.random.Generator], Plan]
    speed_interval: tuple[float, float]  # m/s, lowest and highest speed at which distance counts as `state.PACED`
    traffic: int = 0  # default number of other cars
    usual_traffic: int = 6  # the number that `usual` means, if the default is 0
    thinnest: float = THICK_WALL  # m, least thickness of its walls and parked cars
    # The layout with lights, for `traffic.city_lights`; None: it never has lights.
    lit: Callable[[np.random.Generator], Plan] | None = None


LANE_STEP = 1.0  # m between points of a lane, at most
FORKS = 3  # most successors of a lane on generated roads: straight on, left and right; real roads may have more
_SAME = 0.01  # m and rad within which one lane's end is another's beginning
_ROUNDED = 1e-3  # m, added to half the sides of lanes' bounding boxes: more than float32 rounds off


class Path(NamedTuple):
    """A directed curve: a start pose, and pieces of constant curvature."""

    x: float  # m
    y: float  # m
    heading: float  # rad
    pieces: tuple[tuple[float, float], ...]  # length (m, above 0) and curvature (1/m, left positive) of each


def _poses(path: Path) -> list[tuple[float, float, float]]:
    """Poses (m, m, rad) where each piece of a path begins, and where the last one ends."""
    return list(accumulate(path.pieces, lambda pose, piece: _pose_after(*pose, *piece), initial=path[:3]))


def beside(path: Path, offset: float) -> list[Path]:
    """The pieces of a path as separate paths, shifted `offset` m to the left."""
    result = []
    for (x, y, heading), (length, curvature) in zip(_poses(path), path.pieces, strict=False):
        scale = 1.0 - offset * curvature
        piece = (length * scale, curvature / scale)
        result.append(Path(x - offset * math.sin(heading), y + offset * math.cos(heading), heading, (piece,)))
    return result


def backwards(path: Path) -> Path:
    """The same curve in the opposite direction."""
    x, y, heading = _poses(path)[-1]
    return Path(x, y, heading + math.pi, tuple((length, -curvature) for length, curvature in reversed(path.pieces)))


def sample(path: Path, step: float) -> tuple[np.ndarray, float]:
    """Points float32 [n, 2] along a path, and their spacing in m, `step` at most."""
    length = sum(length for length, _ in path.pieces)
    intervals = math.ceil(length / step)
    points, _ = _sample([path], np.array([length / intervals]), np.array([0, intervals + 1], dtype=np.int32))
    return points, length / intervals


def strips_along(path: Path, half_width: float) -> Strips:
    """Drivable area along a path."""
    lines, arcs = [], []
    poses = _poses(path)
    for (x, y, heading), (end_x, end_y, _), (length, curvature) in zip(poses, poses[1:], path.pieces, strict=False):
        if curvature == 0.0:
            lines.append([x, y, end_x, end_y, half_width])
        else:
            r = 1.0 / curvature  # signed: positive if the centre is to the left
            first = heading - math.copysign(math.pi / 2, r)
            arcs.append(
                [x - r * math.sin(heading), y + r * math.cos(heading), abs(r), first, length * curvature, half_width]
            )
    return Strips.of(lines, arcs)


@njit
def _pose_after(x, y, heading, length, curvature):
    """Pose after an arc of this length (m) and curvature (1/m)."""
    half = 0.5 * length * curvature
    chord = length * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
    return x + chord * math.cos(heading + half), y + chord * math.sin(heading + half), heading + 2.0 * half


@njit
def _sample_pieces(starts, pieces, piece_offsets, steps, offsets):
    """Points float32 [n, 2] equally spaced along each path, and the end poses float64 [lanes, 3]."""
    points = np.empty((offsets[-1], 2), dtype=np.float32)
    ends = np.empty((len(starts), 3))
    for lane in range(len(starts)):
        x, y, heading = starts[lane]
        piece, last, passed = piece_offsets[lane], piece_offsets[lane + 1] - 1, 0.0
        for i in range(offsets[lane + 1] - offsets[lane]):
            s = i * steps[lane]
            while piece < last and s > passed + pieces[piece, 0]:
                x, y, heading = _pose_after(x, y, heading, pieces[piece, 0], pieces[piece, 1])
                passed += pieces[piece, 0]
                piece += 1
            # Element by element, because a slice assignment takes two seconds to compile.
            end_x, end_y, end_heading = _pose_after(x, y, heading, s - passed, pieces[piece, 1])
            ends[lane, 0], ends[lane, 1], ends[lane, 2] = end_x, end_y, end_heading
            points[offsets[lane] + i, 0], points[offsets[lane] + i, 1] = end_x, end_y
    return points, ends


def _sample(paths: Sequence[Path], steps: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and end poses of paths; see `_sample_pieces`."""
    starts = np.array([path[:3] for path in paths], dtype=np.float64).reshape(-1, 3)
    pieces = np.array([piece for path in paths for piece in path.pieces], dtype=np.float64).reshape(-1, 2)
    return _sample_pieces(starts, pieces, np.cumsum([0, *(len(path.pieces) for path in paths)]), steps, offsets)


@njit
def _apart(one, other, side):
    """How far apart two coordinates (m) are on the torus."""
    away = other - one
    return abs(away - round(away / side) * side)


@njit
def _pairs(starts, ends, boxes, group, width, height):
    """Whether lane j begins where lane i ends, and whether i and j may cross; both bool [lanes i, lanes j].

    Args: start and end poses float64 [lanes, 3]; middle and half sides (m) of boxes, float64 [lanes, 4]; `group`
    [lanes], the same for lanes side by side.
    """
    n = len(starts)
    follows, candidates = np.zeros((n, n), dtype=np.bool_), np.zeros((n, n), dtype=np.bool_)
    for i in range(n):
        for j in range(n):
            turn = starts[j, 2] - ends[i, 2]
            same_way = abs(turn - round(turn / (2 * math.pi)) * (2 * math.pi)) < _SAME
            away = max(_apart(ends[i, 0], starts[j, 0], width), _apart(ends[i, 1], starts[j, 1], height))
            follows[i, j] = same_way and away < _SAME
            fork = max(_apart(starts[i, 0], starts[j, 0], width), _apart(starts[i, 1], starts[j, 1], height)) < _SAME
            x, y, half_x, half_y = boxes[i]
            gap_x = _apart(x, boxes[j, 0], width) - half_x - boxes[j, 2]
            gap_y = _apart(y, boxes[j, 1], height) - half_y - boxes[j, 3]
            candidates[i, j] = group[i] != group[j] and not fork and max(gap_x, gap_y) < CROSSING_GAP
    return follows, candidates & ~(follows | follows.T)


@njit
def _near(one, other, width, height):
    """Whether a point of polyline `one` [n, 2] is within CROSSING_GAP of polyline `other` [m, 2], on the torus."""
    for i in range(len(one)):
        for j in range(len(other) - 1):
            ax, ay = other[j, 0] - one[i, 0], other[j, 1] - one[i, 1]
            ax, ay = ax - width * round(ax / width), ay - height * round(ay / height)
            dx, dy = other[j + 1, 0] - other[j, 0], other[j + 1, 1] - other[j, 1]
            t = min(max(-(ax * dx + ay * dy) / (dx * dx + dy * dy), 0.0), 1.0)
            if (ax + t * dx) ** 2 + (ay + t * dy) ** 2 < CROSSING_GAP**2:
                return True
    return False


@njit
def _crossings(points, offsets, candidates, width, height):
    """Which candidate pairs of lanes come within CROSSING_GAP of each other: bool [lanes, lanes], symmetric."""
    cross = np.zeros_like(candidates)
    for i in range(len(cross)):
        one = points[offsets[i] : offsets[i + 1]]
        for j in range(i + 1, len(cross)):
            if candidates[i, j] and _near(one, points[offsets[j] : offsets[j + 1]], width, height):
                cross[i, j] = cross[j, i] = True
    return cross


def lay_lanes(paths: Sequence[Path], width: float, height: float, abreast: int = 1) -> Network:
    """Lanes along paths, on a torus with these sides (m).

    Each group of `abreast` consecutive paths runs side by side, from left to right. Lanes of a group have the same
    number of points and are neighbours. `speeds`, `clear` and `room` are 0, and there are no lights.
    """
    n, sides = len(paths), np.array([width, height], dtype=np.float64)
    lengths = np.array([sum(length for length, _ in path.pieces) for path in paths])
    longest = lengths.reshape(-1, abreast).max(axis=1, initial=0.0)
    intervals = np.repeat(np.maximum(np.ceil(longest / LANE_STEP - 1e-9), 1), abreast).astype(np.int32)
    steps = lengths / intervals
    offsets = np.concatenate([[0], np.cumsum(intervals + 1)]).astype(np.int32)
    points, ends = _sample(paths, steps, offsets)
    starts = np.array([path[:3] for path in paths], dtype=np.float64).reshape(n, 3)
    low, high = (ufunc.reduceat(points.astype(np.float64), offsets[:-1]) for ufunc in (np.minimum, np.maximum))
    boxes = np.concatenate([(low + high) / 2, (high - low) / 2 + _ROUNDED], axis=1)
    index = np.arange(n, dtype=np.int32)
    follows, candidates = _pairs(starts, ends, boxes, index // abreast, *sides)
    if not follows.any(axis=1).all():
        raise ValueError("a lane must end where another begins")
    successors = np.full((n, FORKS), -1, dtype=np.int32)
    one, other = np.nonzero(follows)
    successors[one, np.arange(len(one)) - np.searchsorted(one, one)] = other
    cross = _crossings(points, offsets, candidates, *sides)
    arrays = {
        "points": points,
        "speeds": np.zeros(len(points), dtype=np.float32),
        "offsets": offsets,
        "steps": steps.astype(np.float32),
        "successors": successors,
        "left": np.where(index % abreast == 0, -1, index - 1).astype(np.int32),
        "right": np.where(index % abreast == abreast - 1, -1, index + 1).astype(np.int32),
        "crossing_offsets": np.concatenate([[0], np.cumsum(cross.sum(axis=1))]).astype(np.int32),
        "crossings": np.nonzero(cross)[1].astype(np.int32),
        "clear": np.zeros(cross.sum(), dtype=np.float32),
        "yields": np.zeros(0, dtype=np.uint8),
        "room": np.zeros(len(points), dtype=np.float32),
        "boxes": boxes.astype(np.float32),
        **no_lights(n),
    }
    frozen = {name: freeze(array) for name, array in arrays.items()}
    return Network(**frozen, width=np.float32(width), height=np.float32(height), hand=np.float32(1.0))
