"""A network from described lanes: whole stretches of road, junction lanes long enough for a car, and conflicts."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.sparse.csgraph import connected_components

from gridsim.jit import freeze, njit
from gridsim.maps.lanes import FORKS, LANE_STEP
from gridsim.maps.lights import no_lights
from gridsim.maps.network import ALWAYS, MOVING, NEVER, Network
from gridsim.maps.real.description import Lane, groups_of, joined, part_of, predecessors
from gridsim.maps.real.select import on_rings

APPROACH = 15.0  # m; in a lane longer than this, a car can stop before the next junction
LEAST = 7.0  # m, least length of a lane where traffic waits or crosses: a car and its gap to the next one
DIVIDED = 0.5  # m between the sides of two lanes, beyond which cars do not change from one to the other
ACROSS = 75.0  # m, greatest length of a way across a junction that is made one lane
ROUNDABOUT = 5  # most lanes that conflict with a lane of a roundabout: they join it or leave it
WHOLE = 150.0  # m, greatest length of a lane that `_merge` makes of several, unless one is shorter than LEAST
NEAR_END = 25.0  # m from a road's end; lanes that cross the road within it are part of the junction at that end
_ROUNDED = 1e-3  # m, added to half the sides of lanes' bounding boxes: more than float32 rounds off
ASKEW = 1.0  # m by which a car at right angles to a lane reaches closer than a parallel one: (length - width) / 2
_SAME = 0.5  # m within which two lanes begin at the same place


@njit
def _near(one, other, width, height, gap):
    """Whether cars on two polylines [n, 2] may touch; `width` and `height` (m) are the torus's sides.

    They may touch where the lines are less than `gap` m apart, or up to ASKEW more if the lines are at an angle there.
    """
    for i in range(len(one) - 1):
        ux, uy = one[i + 1, 0] - one[i, 0], one[i + 1, 1] - one[i, 1]
        x, y = one[i, 0] + 0.5 * ux, one[i, 1] + 0.5 * uy
        for j in range(len(other) - 1):
            vx, vy = other[j + 1, 0] - other[j, 0], other[j + 1, 1] - other[j, 1]
            dx, dy = other[j, 0] + 0.5 * vx - x, other[j, 1] + 0.5 * vy - y
            dx, dy = dx - width * round(dx / width), dy - height * round(dy / height)
            if abs(dx) < gap + 1.0 and abs(dy) < gap + 1.0:
                sine = abs(ux * vy - uy * vx) / math.sqrt((ux * ux + uy * uy) * (vx * vx + vy * vy) + 1e-12)
                if math.sqrt(dx * dx + dy * dy) < gap + sine * ASKEW:
                    return True
    return False


@njit
def _find_conflicts(points, offsets, candidates, width, height, gap):
    """Which of the candidates, pairs of lanes, conflict: bool [lanes, lanes], symmetric."""
    cross = np.zeros_like(candidates)
    for i in range(len(cross)):
        one = points[offsets[i] : offsets[i + 1]]
        for j in range(i + 1, len(cross)):
            if not candidates[i, j]:
                continue
            other, k = points[offsets[j] : offsets[j + 1]], 0
            # Of lanes that begin at the same place, only the parts from where they are 2 * gap apart count.
            if math.hypot(one[0, 0] - other[0, 0], one[0, 1] - other[0, 1]) < _SAME:
                while (
                    k < min(len(one), len(other))
                    and math.hypot(one[k, 0] - other[k, 0], one[k, 1] - other[k, 1]) < 2.0 * gap
                ):
                    k += 1
            if _near(one[k:], other[k:], width, height, gap):
                cross[i, j] = cross[j, i] = True
    return cross


def _line(lane: Lane) -> np.ndarray:
    """A lane's middle line, float64 [n, 2], in steps of LANE_STEP at most."""
    return resampled(lane, max(math.ceil(lane.length / LANE_STEP), 1))[0]


def _beyond_joints(line: np.ndarray, first: bool, last: bool, gap: float) -> np.ndarray:
    """A lane's line without what is within 2 * `gap` m of its first point (if `first`) and its last one (if `last`)."""
    for end, joins in ((0, first), (-1, last)):
        if joins and len(line):
            far = np.flatnonzero(np.hypot(*(line - line[end]).T) >= 2.0 * gap)
            line = line[:0] if not len(far) else line[: far[-1] + 1] if end else line[far[0] :]
    return line


class Conflicts:
    """Pairs of lanes whose cars may collide: they come closer than `gap` m (`_near`), and are not side by side.

    Parts close to the point where one lane follows the other, or where both begin, do not count.
    """

    def __init__(self, lanes: dict[str, Lane], gap: float, size: np.ndarray):
        self.keys = list(lanes)
        self.lines = [_line(lane) for lane in lanes.values()]
        self.index = {key: k for k, key in enumerate(self.keys)}
        points = np.concatenate(self.lines).astype(np.float32)
        offsets = np.concatenate([[0], np.cumsum([len(line) for line in self.lines])]).astype(np.int32)
        middle, half = boxes_of(points, offsets)
        apart = abs(_short(middle[:, None] - middle[None], size)) - half[:, None] - half[None]
        candidates = (apart < gap + ASKEW).all(axis=2)
        self.gap, self.size = gap, size
        self.follows = np.zeros_like(candidates)
        for key, other in self._following(lanes):
            self.follows[self.index[key], self.index[other]] = True
        related = self.follows | self.follows.T
        for group in groups_of(lanes):
            row = [self.index[key] for key in group]
            related[np.ix_(row, row)] = True
        self.cross = _find_conflicts(points, offsets, candidates & ~related, *size, gap)
        self._add_loops()

    def _following(self, lanes: dict[str, Lane]) -> Iterable[tuple[str, str]]:
        """Pairs of a lane and one that follows it, at once or after a short lane."""
        for key, lane in lanes.items():
            for other in lane.successors:
                yield key, other
                if lanes[other].length < LEAST + 3.0:
                    for last in lanes[other].successors:
                        yield key, last

    def _add_loops(self) -> None:
        """Add the conflicts of each lane with lanes that follow it and come back over it or beside it."""
        for one, other in np.argwhere(self.follows).tolist():
            lines = self._seen_from(other, one), self._seen_from(one, other)
            if one != other and _near(*lines, *self.size, self.gap):
                self.cross[one, other] = self.cross[other, one] = True

    def _seen_from(self, here: int, other: int) -> np.ndarray:
        """The line of lane `other`, without what is close to where it joins lane `here`."""
        return _beyond_joints(self.lines[other], self.follows[here, other], self.follows[other, here], self.gap)

    def is_loop(self, lanes: dict[str, Lane], key: str, other: str) -> bool:
        """Whether lane `other`, which follows `key`, comes back to it: a lane joined of both would cross itself."""
        ring = key in lanes[other].successors
        one = _beyond_joints(_line(lanes[key]), ring, True, self.gap)
        return bool(_near(one, _beyond_joints(_line(lanes[other]), True, ring, self.gap), *self.size, self.gap))

    def in_loop(self, key: str) -> bool:
        """Whether a lane conflicts with one that it follows or leads to."""
        here = self.index[key]
        return bool((self.cross[here] & (self.follows[here] | self.follows[:, here])).any())

    def __contains__(self, key: str) -> bool:
        return bool(self.cross[self.index[key]].any())

    def zone(self, key: str) -> tuple[float, float]:
        """First and last arc length (m) of a lane at which lanes in conflict with it are too close; (0, 0): nowhere."""
        here = self.index[key]
        line = self.lines[here]
        others = np.concatenate([self._seen_from(here, k) for k in np.flatnonzero(self.cross[here]).tolist()])
        away = _short(line[:, None] - others[None], self.size)
        near = np.flatnonzero((np.hypot(away[..., 0], away[..., 1]) < self.gap + ASKEW).any(axis=1))
        step = np.hypot(*np.diff(line, axis=0).T).mean()
        return (float(near[0] * step), float(near[-1] * step)) if len(near) else (0.0, 0.0)


def _short(offsets: np.ndarray, size: np.ndarray) -> np.ndarray:
    return offsets - np.round(offsets / size) * size


def resampled(lane: Lane, intervals: int) -> tuple[np.ndarray, np.ndarray]:
    """Equally spaced points float64 [intervals + 1, 2] of a lane's middle line, and half widths [intervals + 1]."""
    line = lane.centre[:, :2]
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    half = np.hypot(*(lane.left - lane.right)[:, :2].T) / 2
    at = np.linspace(0.0, along[-1], intervals + 1)
    return np.column_stack([np.interp(at, along, column) for column in line.T]), np.interp(at, along, half)


def boxes_of(points: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middles and half sides (m) of lanes' bounding boxes: float64 [lanes, 2] each."""
    low, high = (ufunc.reduceat(points.astype(np.float64), offsets[:-1]) for ufunc in (np.minimum, np.maximum))
    return (low + high) / 2, (high - low) / 2 + _ROUNDED


def _forward(lanes: dict[str, Lane], group: list[str], before: dict[str, list[str]]) -> list[str] | None:
    """The lanes that follow a group, if they are a group in the same order; otherwise None.

    Each must be the only successor of the lane before it and have no other predecessor. No further lane may be beside
    them.
    """
    onward = [lanes[key].successors for key in group]
    if any(len(keys) != 1 or len(before[keys[0]]) != 1 for keys in onward):
        return None
    found = [keys[0] for keys in onward]
    beside = pairwise(found)
    alone = not lanes[found[0]].left_lane and not lanes[found[-1]].right_lane
    fits = alone and all(lanes[a].right_lane == b for a, b in beside) and not set(found) & set(group)
    return found if fits else None


def _merge(lanes: dict[str, Lane], conflicts: Conflicts) -> None:
    """Join groups that follow each other (`_forward`), if they are WHOLE m long together at most and have no conflicts.

    If one of their lanes is shorter than LEAST, these two conditions do not matter. Groups are not joined if the second
    one has a light, or if a joined lane would cross itself.
    """
    crossed = {key for key in lanes if key in conflicts}
    before = predecessors(lanes)
    for group in groups_of(lanes):
        while all(key in lanes for key in group):
            onward = _forward(lanes, group, before)
            if onward is None or any(lanes[key].light for key in onward):
                break
            pairs = list(zip(group, onward, strict=True))
            if any(conflicts.is_loop(lanes, *pair) for pair in pairs):
                break
            together = sum(max(lanes[key].length for key in keys) for keys in (group, onward))
            short = min(lanes[key].length for key in (*group, *onward)) < LEAST
            if not short and (together > WHOLE or crossed & {*group, *onward}):
                break
            for key, other in pairs:
                lanes[key] = joined(lanes[key], lanes.pop(other))
                for last in lanes[key].successors:
                    before[last] = [key if k == other else k for k in before[last]]


def _absorb(lanes: dict[str, Lane], conflicts: Conflicts) -> None:
    """Make short lanes part of all lanes that lead to them, or else of all lanes that follow them.

    The former must lead nowhere else; nothing else may lead to the latter. Lanes up to LEAST / 2 m are short, and those
    up to APPROACH m if the lanes around them allow it. Lanes with a light stay.
    """
    before = predecessors(lanes)
    for key in sorted(lanes, key=lambda name: lanes[name].length):
        lane, first = lanes[key], before[key]
        if lane.length > APPROACH or key in lane.successors or not first or lane.light:
            continue
        limit = LEAST / 2 if not all(_is_alone(lanes[k]) for k in (*first, *lane.successors)) else LEAST
        if lane.length <= APPROACH and all(lanes[p].successors == [key] and _is_alone(lanes[p]) for p in first):
            limit = APPROACH
        if lane.length > limit:
            continue
        pairs = [(p, key) for p in first] + [(key, s) for s in lane.successors]
        if any(conflicts.is_loop(lanes, *pair) for pair in pairs):
            continue
        if all(lanes[p].successors == [key] for p in first):
            for p in first:
                lanes[p] = joined(lanes[p], lane)
            for s in lane.successors:
                before[s] = [p for p in before[s] if p != key] + first
        elif all(before[s] == [key] for s in lane.successors):
            for s in lane.successors:
                lanes[s] = replace(joined(lane, lanes[s]), left_lane=lanes[s].left_lane, right_lane=lanes[s].right_lane)
                before[s] = list(first)
            for p in first:
                lanes[p].successors = [s for s in lanes[p].successors if s != key] + lane.successors
        else:
            continue
        for beside in (lane.left_lane, lane.right_lane):
            if beside in lanes:
                other = lanes[beside]
                other.left_lane = "" if other.left_lane == key else other.left_lane
                other.right_lane = "" if other.right_lane == key else other.right_lane
        del lanes[key]


def _contract(lanes: dict[str, Lane], conflicts: Conflicts) -> None:
    """Join lanes that follow each other inside a junction to one lane across it, so that no car has to wait inside.

    A lane that forks becomes one lane for each branch. Roundabouts stay as they are: cars may wait inside them.
    """
    before = predecessors(lanes)
    crossed = {key for key in lanes if key in conflicts}
    few = {key for key in crossed if conflicts.cross[conflicts.index[key]].sum() <= ROUNDABOUT}
    crossed -= on_rings({key: [s for s in lanes[key].successors if s in few] for key in few})
    for key in sorted(crossed, key=lambda name: (lanes[name].length, name)):
        lane = lanes[key]
        onward = [s for s in lane.successors if s in crossed and s != key]
        if not before[key] or not onward or any(s in lane.successors for s in before[key]):
            continue
        if set(onward) != set(lane.successors) or not _is_alone(lane):
            continue
        if lane.length + max(lanes[s].length for s in onward) > ACROSS:
            continue
        if any(conflicts.is_loop(lanes, key, s) for s in onward):
            continue
        names = {s: f"{key}>{s}" for s in onward}
        for s, name in names.items():
            lanes[name] = replace(joined(lane, lanes[s]), left_lane="", right_lane="")
            crossed.add(name)
            before[name] = list(before[key])
            before[s] = [p for p in before[s] if p != key]
            for last in lanes[s].successors:
                before[last].append(name)
        for p in before[key]:
            lanes[p].successors = [k for k in lanes[p].successors if k != key] + list(names.values())
        del lanes[key]
    for key in [key for key in lanes if not before[key]]:  # nothing leads to them any more
        for s in lanes.pop(key).successors:
            before[s] = [p for p in before[s] if p != key]


def _group_of(lanes: dict[str, Lane], key: str) -> list[str]:
    return next(group for group in groups_of(lanes) if key in group)


def _is_alone(lane: Lane) -> bool:
    return not lane.left_lane and not lane.right_lane


def _give_tail(lanes: dict[str, Lane], before: dict[str, list[str]], group: list[str], length: float) -> bool:
    """Make the last `length` m of a group of lanes part of their successors; returns whether that was possible."""
    onward = [(key, s) for key in group for s in lanes[key].successors]
    if min(lanes[key].length for key in group) < length + LEAST or any(
        before[s] != [key] or s in group or not _is_alone(lanes[s]) for key, s in onward
    ):
        return False
    for key in group:
        lane = lanes[key]
        tail = part_of(lane, lane.length - length, lane.length)
        for s in lane.successors:
            lanes[s] = replace(joined(tail, lanes[s]), left_lane="", right_lane="", junction=lanes[s].junction)
        lanes[key] = replace(part_of(lane, 0.0, lane.length - length), successors=lane.successors)
    return True


def _give_head(lanes: dict[str, Lane], before: dict[str, list[str]], group: list[str], length: float) -> bool:
    """Make the first `length` m of a group of lanes part of their predecessors; returns whether that was possible."""
    if min(lanes[key].length for key in group) < length + LEAST or any(
        lanes[p].successors != [key] or p in group or not _is_alone(lanes[p]) for key in group for p in before[key]
    ):
        return False
    for key in group:
        lane = lanes[key]
        head = part_of(lane, 0.0, length)
        for p in before[key]:
            lanes[p] = replace(joined(lanes[p], head), successors=[key], junction=lanes[p].junction)
        lanes[key] = replace(part_of(lane, length, lane.length), successors=lane.successors)
    return True


def _split(lanes: dict[str, Lane], group: list[str], share: float) -> list[str]:
    """Split the lanes of a group at a share of their length; returns the names of the second parts."""
    mark = "+"
    while any(key + mark in lanes for key in group):  # a group may be split twice
        mark += "+"
    names = {key: key + mark for key in group}
    for key in group:
        lane = lanes[key]
        at = share * lane.length
        onward = replace(part_of(lane, at, lane.length), successors=lane.successors)
        onward.left_lane, onward.right_lane = names.get(lane.left_lane, ""), names.get(lane.right_lane, "")
        lanes[names[key]] = onward
        lanes[key] = replace(part_of(lane, 0.0, at), successors=[names[key]])
    return list(names.values())


def _lengthen(lanes: dict[str, Lane]) -> None:
    """Lengthen lanes shorter than LEAST to that length, where possible, by a piece of the lane before or after."""
    before = predecessors(lanes)
    for key in list(lanes):
        lane = lanes[key]
        need = LEAST - lane.length
        if (
            need > 0.0
            and not (len(before[key]) == 1 and _give_tail(lanes, before, _group_of(lanes, before[key][0]), need))
            and len(lane.successors) == 1
        ):
            _give_head(lanes, before, _group_of(lanes, lane.successors[0]), need)


def _clear_roads(lanes: dict[str, Lane], conflicts: Conflicts) -> None:
    """Make the stretch of a road that other lanes cross part of the junction at an end of it, or separate lanes."""
    before = predecessors(lanes)
    for group in groups_of(lanes):
        crossed = [key for key in group if key in conflicts]
        length = min(lanes[key].length for key in group)
        if not crossed or lanes[group[0]].junction or length < 3 * LEAST:
            continue
        zones = [conflicts.zone(key) for key in crossed]
        first, last = min(zone[0] for zone in zones) - 1.0, max(zone[1] for zone in zones) + 1.0
        loops = any(conflicts.in_loop(key) for key in crossed)  # a lane made longer would cross itself
        if (
            not loops
            and last > length - NEAR_END
            and first > length - 2 * NEAR_END
            and _give_tail(lanes, before, group, length - first)
        ):
            continue
        if not loops and first < NEAR_END and last < 2 * NEAR_END and _give_head(lanes, before, group, last):
            continue
        if last < length - LEAST and last > LEAST:
            _split(lanes, group, last / length)
            length = last
        if first > LEAST and first < length - LEAST:
            _split(lanes, group, first / length)


def _unlink(lanes: dict[str, Lane], gap: float) -> None:
    """Unlink neighbouring lanes that come closer than `gap` m, or whose sides are over DIVIDED m apart somewhere."""
    for group in groups_of(lanes):
        for left, right in pairwise(group):
            n = max(math.ceil(lanes[left].length / LANE_STEP), 1)
            (one, half), (other, other_half) = (resampled(lanes[key], n) for key in (left, right))
            away = np.hypot(*(one - other).T)
            if away.min() < gap or (away - half - other_half).max() > DIVIDED:
                lanes[left].right_lane = lanes[right].left_lane = ""


def shaped(lanes: dict[str, Lane], gap: float, size: np.ndarray) -> tuple[dict[str, Lane], Conflicts]:
    """Lanes as traffic needs them, and which of them may collide.

    `gap`: the distance (m) between middle lines below which lanes conflict; `size` [2]: sides (m) of the torus.
    """
    lanes = {key: replace(lane, successors=list(lane.successors)) for key, lane in lanes.items()}
    _unlink(lanes, gap)
    conflicts = Conflicts(lanes, gap, size)
    for key, lane in lanes.items():
        lane.light = lane.light if key in conflicts else ""  # where nobody crosses, nobody waits
    for _ in range(3):
        _absorb(lanes, conflicts)
        conflicts = Conflicts(lanes, gap, size)
        _merge(lanes, conflicts)
        conflicts = Conflicts(lanes, gap, size)
        _contract(lanes, conflicts)
        _lengthen(lanes)
        _clear_roads(lanes, Conflicts(lanes, gap, size))
    return lanes, Conflicts(lanes, gap, size)


def _yields(lanes: list[Lane], cross: np.ndarray) -> np.ndarray:
    """`Network.yields` of the pairs of lanes that conflict (`cross`, bool [lanes, lanes]).

    If two would give way to each other, as lanes across several junctions may, neither does.
    """
    gives_way = np.zeros_like(cross)
    for k, j in np.argwhere(cross):
        gives_way[k, j] = not lanes[k].yields.isdisjoint(lanes[j].links)
    gives_way &= ~gives_way.T
    _, circle = connected_components(gives_way, connection="strong")
    in_order = gives_way & (circle[:, None] != circle)
    kinds = np.where(in_order, ALWAYS, np.where(gives_way, MOVING, NEVER))[cross]
    return kinds.astype(np.uint8) if kinds.any() else np.zeros(0, dtype=np.uint8)


def network_of(lanes: dict[str, Lane], conflicts: Conflicts, hand: float) -> Network:
    """The network of shaped lanes. `speeds`, `clear` and `room` are zeros: `make_network` computes them."""
    intervals = {}
    for group in groups_of(lanes):
        longest = max(lanes[key].length for key in group)
        intervals.update(dict.fromkeys(group, max(math.ceil(longest / LANE_STEP - 1e-9), 1)))
    lines = [resampled(lane, intervals[key])[0] for key, lane in lanes.items()]
    index = conflicts.index
    for key, lane in lanes.items():  # close gaps, where a file's bounds do not quite meet
        for s in lane.successors:
            away = lines[index[key]][-1] - lines[index[s]][0]
            lines[index[s]][0] += _short(away, conflicts.size)
    points = np.concatenate(lines).astype(np.float32)
    offsets = np.concatenate([[0], np.cumsum([len(line) for line in lines])]).astype(np.int32)
    lengths = np.array([np.hypot(*np.diff(line, axis=0).T).sum() for line in lines])
    successors = np.full((len(lanes), max(FORKS, max(len(lane.successors) for lane in lanes.values()))), -1, np.int32)
    for key, lane in lanes.items():
        successors[index[key], : len(lane.successors)] = [index[s] for s in lane.successors]
    cross = conflicts.cross
    arrays = {
        "points": points,
        "speeds": np.zeros(len(points), dtype=np.float32),
        "offsets": offsets,
        "steps": (lengths / (np.diff(offsets) - 1)).astype(np.float32),
        "successors": successors,
        "left": np.array([index.get(lane.left_lane, -1) for lane in lanes.values()], dtype=np.int32),
        "right": np.array([index.get(lane.right_lane, -1) for lane in lanes.values()], dtype=np.int32),
        "crossing_offsets": np.concatenate([[0], np.cumsum(cross.sum(axis=1))]).astype(np.int32),
        "crossings": np.nonzero(cross)[1].astype(np.int32),
        "clear": np.zeros(cross.sum(), dtype=np.float32),
        "yields": _yields([*lanes.values()], cross),
        "room": np.zeros(len(points), dtype=np.float32),
        "boxes": np.concatenate(boxes_of(points, offsets), axis=1).astype(np.float32),
        **no_lights(len(lanes)),
    }
    frozen = {name: freeze(array) for name, array in arrays.items()}
    width, height = (np.float32(side) for side in conflicts.size)
    return Network(**frozen, width=width, height=height, hand=np.float32(hand))
