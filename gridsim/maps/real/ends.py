"""Roads that end get turning loops, or ways round the world: to where others begin, often across the torus's sides."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from gridsim.maps.generators.roundabout import HALF_RING, RADIUS
from gridsim.maps.lanes import Path, sample
from gridsim.maps.real.description import Lane, RealRoad, bounds_of, groups_of, heading, part_of

ROUND_RADIUS = 20.0  # m, radius of the bends of ways round the world


class Loop(NamedTuple):
    """A kind of turning loop."""

    radius: float  # m
    width: float  # m, least width of its lane
    room: float  # m between its middle line and those of other roads' lanes, at least


ROOM = 4.2  # m from the middle line of a narrow loop or a way round the world to those of other roads, at least
NARROWEST = 3.5  # m, least width of the lane of a narrow loop or a way round the world
# Tried in this order. The second is as large as a generated roundabout, in which drivers can turn; but on roads with a
# higher speed limit, they come faster and need the first, which is larger. The last is for where there is little room.
LOOPS = (Loop(RADIUS + 1.5, 2.0 * HALF_RING, 6.5), Loop(RADIUS, 2.0 * HALF_RING, 6.5), Loop(8.0, NARROWEST, ROOM))
PARTNER = 45.0  # m between the end of a road and the beginning of the opposite direction, at most
CUT_BACK = (0.0, 15.0, 30.0)  # m by which a road is shortened to make room for its loop, tried in this order
SPARE = 15.0  # m that are left of a shortened road, at least
LOOP_SPEED = 30 / 3.6  # m/s, in a loop, at most
WIDEST = 25.0  # m; lanes that end closer together than this end at the same end of a road
LONGEST = 500.0  # m; every way round the world is shorter than this

Pose = tuple[float, float, float]


def shortest_curve(start: Pose, end: Pose, radius: float) -> Path:
    """The shortest path between two poses that bends no more than a radius (m) allows (Dubins 1957; Shkel 2001)."""
    dx, dy = (end[0] - start[0]) / radius, (end[1] - start[1]) / radius
    d, toward, full = math.hypot(dx, dy), math.atan2(dy, dx), 2 * math.pi
    words: list[tuple[tuple[float, float, float], tuple[int, int, int]]] = []
    for side in (1, -1):  # Dubins's words (sequences of turns), and then their mirror images
        a, b = side * (start[2] - toward), side * (end[2] - toward)
        sa, sb, ca, cb, between = math.sin(a), math.sin(b), math.cos(a), math.cos(b), math.cos(a - b)
        square = 2.0 + d * d - 2.0 * between + 2.0 * d * (sa - sb)
        if square >= 0.0:
            straight = math.atan2(cb - ca, d + sa - sb)
            words.append((((straight - a) % full, math.sqrt(square), (b - straight) % full), (side, 0, side)))
        square = -2.0 + d * d + 2.0 * between + 2.0 * d * (sa + sb)
        if square >= 0.0:
            length = math.sqrt(square)
            straight = math.atan2(-ca - cb, d + sa + sb) - math.atan2(-2.0, length)
            words.append((((straight - a) % full, length, (straight - b) % full), (side, 0, -side)))
        cosine = (6.0 - d * d + 2.0 * between + 2.0 * d * (sa - sb)) / 8.0
        if abs(cosine) <= 1.0:
            middle = full - math.acos(cosine)
            first = (a - math.atan2(ca - cb, d - sa + sb) + middle / 2) % full
            words.append(((first, middle, (a - b - first + middle) % full), (-side, side, -side)))
    lengths, turns = min(words, key=lambda word: sum(word[0]))
    pieces = tuple((n * radius, k / radius) for n, k in zip(lengths, turns, strict=True) if n * radius > 1e-6)
    return Path(*start, pieces or ((1e-3, 0.0),))


class _Ground:
    """Where lanes are, on a torus with these sides (m) or in the plane."""

    def __init__(self, lanes: dict[str, Lane], sides: np.ndarray | None = None):
        self.sides, self.keys = sides, list(lanes)
        dense = [_dense(lane.centre[:, :2]) for lane in lanes.values()]
        self.owner = np.repeat(np.arange(len(dense)), [len(line) for line in dense])
        self.tree = cKDTree(self._within(np.concatenate(dense)), boxsize=sides)
        self.added: list[np.ndarray] = []  # lines of new lanes

    def add(self, lanes: list[Lane]) -> None:
        """Count new lanes among those that others must keep away from."""
        self.added += [self._within(_dense(lane.centre[:, :2])) for lane in lanes]

    def _within(self, points: np.ndarray) -> np.ndarray:
        return points if self.sides is None else np.mod(np.mod(points, self.sides), self.sides)

    def is_free(self, line: np.ndarray, but: set[str], room: float) -> bool:
        """Whether a line [n, 2] keeps `room` m from all lanes except those in `but`; added lanes always count."""
        line = self._within(line)
        near = self.tree.query_ball_point(line, room)
        if not all(self.keys[self.owner[k]] in but for found in near for k in found):
            return False
        return all(cKDTree(new, boxsize=self.sides).query(line)[0].min() > room for new in self.added)


def _dense(line: np.ndarray) -> np.ndarray:
    """Points of a polyline [n, 2], 1 m apart at most."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    at = np.linspace(0.0, along[-1], max(math.ceil(along[-1]), 1) + 1)
    return np.column_stack([np.interp(at, along, column) for column in line.T])


def _open_groups(lanes: dict[str, Lane]) -> tuple[list[list[str]], list[list[str]]]:
    """Groups of lanes side by side of which none has a successor, and those of which none has a predecessor.

    Groups with a lane of 1 m or less are left out.
    """
    followed = {key for lane in lanes.values() for key in lane.successors}
    groups = [group for group in groups_of(lanes) if min(lanes[key].length for key in group) > 1.0]
    out = [group for group in groups if not any(lanes[key].successors for key in group)]
    return out, [group for group in groups if not followed & set(group)]


def _pose(lane: Lane, at: int) -> Pose:
    x, y = lane.centre[at, :2]
    return float(x), float(y), math.atan2(*heading(lane, at)[::-1])


def add_turning_loops(road: RealRoad) -> None:
    """Join the two directions of each road that ends, where there is room for a loop."""
    lanes = road.lanes
    out, back = _open_groups(lanes)
    pairs = []
    for i, one in enumerate(out):
        end, away = lanes[one[0]].centre[-1, :2], heading(lanes[one[0]], -1)
        for j, other in enumerate(back):
            begin = lanes[other[0]].centre[0, :2]
            if (distance := math.dist(end, begin)) < PARTNER and away @ heading(lanes[other[0]], 0) < -0.5:
                pairs.append((distance, i, j))
    ground = _Ground(lanes)
    loops, failed, used_out, used_back = 0, 0, set(), set()
    for _, i, j in sorted(pairs):
        if i in used_out or j in used_back:
            continue
        used_out.add(i)
        used_back.add(j)
        if _add_loop(road, ground, out[i], back[j]):
            loops += 1
        else:
            failed += 1
    if loops:
        road.notes.append(f"{loops} roads that end got a turning loop")
    if failed:
        road.notes.append(f"{failed} roads that end have no room for a turning loop")


def _add_loop(road: RealRoad, ground: _Ground, one: list[str], other: list[str]) -> bool:
    """Add a loop from a road's end to the beginning of its opposite direction; returns whether there was room.

    The road may be shortened for it (CUT_BACK).
    """
    own = {*one, *other}
    for loop, cut in product(LOOPS, CUT_BACK):
        if cut and min(road.lanes[key].length for key in own) < cut + SPARE:
            continue
        cut_lanes = {key: road.lanes[key] for key in own}
        if cut:
            for key, lane in cut_lanes.items():
                first, last = (0.0, lane.length - cut) if key in one else (cut, lane.length)
                cut_lanes[key] = replace(part_of(lane, first, last), successors=lane.successors)
        new = _connections(cut_lanes, one, other, loop.radius, loop.width, np.zeros(2))
        for lane, _ in new:
            lane.speed = min(lane.speed, LOOP_SPEED)
        if all(ground.is_free(lane.centre[:, :2], own, loop.room) for lane, _ in new):
            road.lanes.update(cut_lanes)
            _add(road, new)
            ground.add([lane for lane, _ in new])
            return True
    return False


def _beside(one: Lane, other: Lane) -> bool:
    """Whether two lanes end at the same end of a road."""
    return math.dist(one.centre[-1, :2], other.centre[-1, :2]) < WIDEST


def _connections(
    lanes: dict[str, Lane], one: list[str], other: list[str], radius: float, narrowest: float, shift: np.ndarray
) -> list[tuple[Lane, str]]:
    """New lanes, at least `narrowest` m wide, from the ends of `one` to the beginnings of `other` moved by `shift` (m).

    Each comes with the name of its predecessor; none is added to a road yet.
    """

    def away(keys: list[str], at: int, to: np.ndarray) -> list[str]:
        return sorted(keys, key=lambda key: float(np.hypot(*(lanes[key].centre[at, :2] - to))))

    if heading(lanes[one[0]], -1) @ heading(lanes[other[0]], 0) < 0.0:  # they turn back: inner lanes come first
        one = away(one, -1, lanes[other[0]].centre[0, :2] + shift)
        other = away(other, 0, lanes[one[0]].centre[-1, :2] - shift)
    count = max(len(one), len(other))
    found = []
    for k in range(count):
        source, target = one[min(k, len(one) - 1)], other[min(k, len(other) - 1)]
        x, y, angle = _pose(lanes[target], 0)
        curve = shortest_curve(_pose(lanes[source], -1), (x + shift[0], y + shift[1], angle), radius)
        points, _ = sample(curve, 0.5)
        line = np.column_stack([points, np.zeros(len(points))])
        line[0, :2], line[-1, :2] = lanes[source].centre[-1, :2], lanes[target].centre[0, :2] + shift
        width = float(np.hypot(*(lanes[source].left - lanes[source].right)[-1, :2]))
        bounds = bounds_of(line, max(width, narrowest))
        lane = Lane(*bounds, lanes[source].speed, [target], junction=f"end {source}")
        found.append((lane, source))
    return found


def _add(road: RealRoad, new: list[tuple[Lane, str]]) -> None:
    for lane, source in new:
        name = f"{source}>{lane.successors[0]}#end"
        road.lanes[name] = lane
        road.lanes[source].successors.append(name)


def join_round_the_world(road: RealRoad, sides: np.ndarray) -> None:
    """Add roads from where roads still end to where others begin, also across the sides of the torus."""
    out, back = _open_groups(road.lanes)
    found = []
    for i, one in enumerate(out):
        for j, other in enumerate(back):
            start, (x, y, angle) = _pose(road.lanes[one[0]], -1), _pose(road.lanes[other[0]], 0)
            for shift in product((-1, 0, 1), repeat=2):
                moved = np.array(shift) * sides
                curve = shortest_curve(start, (x + moved[0], y + moved[1], angle), ROUND_RADIUS)
                if (length := sum(piece for piece, _ in curve.pieces)) < LONGEST:
                    found.append((-min(len(one), len(other)), length, i, j, moved))
    ground = _Ground(road.lanes, sides)
    used_out, used_back = set(), set()
    for _, length, i, j, moved in sorted(found, key=lambda way: way[:4]):
        if i in used_out or j in used_back:
            continue
        new = _connections(road.lanes, out[i], back[j], ROUND_RADIUS, NARROWEST, moved)
        own = {*back[j], *(key for group in out for key in group if _beside(road.lanes[key], road.lanes[out[i][0]]))}
        if all(ground.is_free(lane.centre[:, :2], own, ROOM) for lane, _ in new):
            _add(road, new)
            ground.add([lane for lane, _ in new])
            used_out.add(i)
            used_back.add(j)
            road.notes.append(f"a road that ends was joined with one that begins by {length:.0f} m of new road")
