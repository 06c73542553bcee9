"""Lanes from paths: equally spaced points, successors and crossings.

A path is a start pose and pieces of constant curvature, so that its points, its length and its sharpest bend are exact.
Successors and crossings are found from the geometry: a lane's successors begin where it ends, and its crossings are
the lanes that come too close to it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gridsim.config import BEND_COMFORT, CROSSING_GAP, VehicleConfig
from gridsim.jit import njit
from gridsim.maps.roads import Lanes, Strips

LANE_STEP = 1.0  # m between points of a lane, at most
FORKS = 3  # most successors of a lane: straight on, left and right
_SAME = 0.01  # m and rad within which one lane's end is another's beginning


class Path(NamedTuple):
    """A directed curve: a start pose, and pieces of constant curvature."""

    x: float  # m
    y: float  # m
    heading: float  # rad
    pieces: tuple[tuple[float, float], ...]  # length (m, above 0) and curvature (1/m, left positive) of each


def end_of(path: Path) -> tuple[float, float, float]:
    """Pose (m, m, rad) where a path ends."""
    pose = path[:3]
    for length, curvature in path.pieces:
        pose = _pose_after(*pose, length, curvature)
    return pose


def beside(path: Path, offset: float) -> list[Path]:
    """The pieces of a path as separate paths, shifted `offset` m to the left."""
    pose, result = path[:3], []
    for length, curvature in path.pieces:
        x, y, heading = pose
        scale = 1.0 - offset * curvature
        piece = (length * scale, curvature / scale)
        result.append(Path(x - offset * math.sin(heading), y + offset * math.cos(heading), heading, (piece,)))
        pose = _pose_after(x, y, heading, length, curvature)
    return result


def backwards(path: Path) -> Path:
    """The same curve in the opposite direction."""
    x, y, heading = end_of(path)
    return Path(x, y, heading + math.pi, tuple((length, -curvature) for length, curvature in reversed(path.pieces)))


def sample(path: Path, step: float) -> tuple[np.ndarray, float]:
    """Points float32 [n, 2] along a path, and their spacing in m, `step` at most."""
    length = sum(length for length, _ in path.pieces)
    intervals = math.ceil(length / step)
    offsets = np.array([0, intervals + 1])
    pieces = np.array(path.pieces)
    points, _ = _sample(
        np.array([path[:3]]), pieces, np.array([0, len(pieces)]), np.array([length / intervals]), offsets
    )
    return points, length / intervals


def strips_along(path: Path, half_width: float) -> Strips:
    """Drivable area along a path."""
    pose = path[:3]
    lines, arcs = [], []
    for length, curvature in path.pieces:
        x, y, heading = pose
        pose = _pose_after(x, y, heading, length, curvature)
        if curvature == 0.0:
            lines.append([x, y, pose[0], pose[1], half_width])
        else:
            r = 1.0 / curvature  # signed: the centre is to the left or to the right
            first = heading - math.copysign(math.pi / 2, r)
            arcs.append(
                [x - r * math.sin(heading), y + r * math.cos(heading), abs(r), first, length * curvature, half_width]
            )
    return Strips(np.array(lines).reshape(-1, 5), np.array(arcs).reshape(-1, 6))


def through_square(turn: int, half: float, offset: float) -> tuple[tuple[float, float], ...]:
    """Pieces of a lane through a square of side 2 * half, `offset` m to the right of the road's middle.

    turn: sides from the one it enters by to the one it leaves by, counter-clockwise: 1 right, 2 straight, 3 left.
    """
    if turn == 2:
        return ((2.0 * half, 0.0),)
    radius = half + offset if turn == 3 else half - offset
    return ((math.pi / 2 * radius, (1.0 if turn == 3 else -1.0) / radius),)


@njit
def _pose_after(x, y, heading, length, curvature):
    """Pose after an arc of this length (m) and curvature (1/m)."""
    half = 0.5 * length * curvature
    chord = length * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
    return x + chord * math.cos(heading + half), y + chord * math.sin(heading + half), heading + 2.0 * half


@njit
def _sample(starts, pieces, piece_offsets, steps, offsets):
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


@njit
def _successors(starts, ends, width, height, successors):
    """Fill successors [lanes, k] with the lanes that begin where each lane ends; returns the smallest count of them."""
    least = len(starts)
    for i in range(len(starts)):
        count = 0
        for j in range(len(starts)):
            dx, dy, turn = starts[j, 0] - ends[i, 0], starts[j, 1] - ends[i, 1], starts[j, 2] - ends[i, 2]
            dx, dy = dx - width * round(dx / width), dy - height * round(dy / height)
            turn -= 2.0 * math.pi * round(turn / (2.0 * math.pi))
            if max(abs(dx), abs(dy), abs(turn)) < _SAME and count < successors.shape[1]:
                successors[i, count] = j
                count += 1
        least = min(least, count)
    return least


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
def _crossings(points, offsets, successors, abreast, width, height):
    """Whether cars on two lanes may collide in a junction: bool [lanes, lanes], symmetric."""
    n = len(offsets) - 1
    cross = np.zeros((n, n), dtype=np.bool_)
    middle, radius = np.empty((n, 2)), np.zeros(n)
    for i in range(n):
        centre = (offsets[i] + offsets[i + 1]) // 2
        middle[i, 0], middle[i, 1] = points[centre, 0], points[centre, 1]
        for k in range(offsets[i], offsets[i + 1]):
            radius[i] = max(radius[i], math.hypot(points[k, 0] - middle[i, 0], points[k, 1] - middle[i, 1]))
    for i in range(n):
        first = points[offsets[i]]
        for j in range(i + 1, n):
            dx, dy = middle[j, 0] - middle[i, 0], middle[j, 1] - middle[i, 1]
            dx, dy = dx - width * round(dx / width), dy - height * round(dy / height)
            if math.hypot(dx, dy) > radius[i] + radius[j] + CROSSING_GAP or i // abreast == j // abreast:
                continue
            fx, fy = points[offsets[j], 0] - first[0], points[offsets[j], 1] - first[1]
            fx, fy = fx - width * round(fx / width), fy - height * round(fy / height)
            related = max(abs(fx), abs(fy)) < _SAME
            for k in range(successors.shape[1]):
                related = related or successors[i, k] == j or successors[j, k] == i
            if not related:
                one, other = points[offsets[i] : offsets[i + 1]], points[offsets[j] : offsets[j + 1]]
                cross[i, j] = cross[j, i] = _near(one, other, width, height)
    return cross


def lay_lanes(paths: Sequence[Path], width: float, height: float, abreast: int = 1) -> Lanes:
    """Lanes along paths, on a torus with these sides (m).

    Each group of `abreast` consecutive paths runs side by side, from left to right. Lanes of a group have the same
    number of points and are neighbours.

    Raises: ValueError if a lane has no successor.
    """
    n = len(paths)
    lengths = np.array([sum(length for length, _ in path.pieces) for path in paths])
    longest = lengths.reshape(-1, abreast).max(axis=1, initial=0.0)
    intervals = np.repeat(np.maximum(np.ceil(longest / LANE_STEP - 1e-9), 1), abreast).astype(np.int32)
    steps = lengths / intervals
    offsets = np.concatenate([[0], np.cumsum(intervals + 1)]).astype(np.int32)
    starts = np.array([path[:3] for path in paths], dtype=np.float64).reshape(n, 3)
    pieces = np.array([piece for path in paths for piece in path.pieces], dtype=np.float64).reshape(-1, 2)
    piece_offsets = np.cumsum([0, *(len(path.pieces) for path in paths)])
    sharpest = np.array([max(abs(curvature) for _, curvature in path.pieces) for path in paths])
    points, ends = _sample(starts, pieces, piece_offsets, steps, offsets)
    successors = np.full((n, FORKS), -1, dtype=np.int32)
    if n and _successors(starts, ends, width, height, successors) == 0:
        raise ValueError("a lane must end where another begins")
    cross = _crossings(points, offsets, successors, abreast, width, height)
    index = np.arange(n, dtype=np.int32)
    fastest = VehicleConfig().speed_limit
    return Lanes(
        points=points,
        offsets=offsets,
        successors=successors,
        steps=steps.astype(np.float32),
        lengths=lengths.astype(np.float32),
        left=np.where(index % abreast == 0, -1, index - 1).astype(np.int32),
        right=np.where(index % abreast == abreast - 1, -1, index + 1).astype(np.int32),
        crossing_offsets=np.concatenate([[0], np.cumsum(cross.sum(axis=1))]).astype(np.int32),
        crossings=np.nonzero(cross)[1].astype(np.int32),
        junction=cross.any(axis=1).astype(np.uint8),
        limits=np.minimum(np.sqrt(BEND_COMFORT / np.maximum(sharpest, 1e-9)), fastest).astype(np.float32),
    )
