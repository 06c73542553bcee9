"""A network from described lanes: whole stretches of road, junction lanes long enough for a car, and conflicts."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from gridsim.jit import freeze
from gridsim.maps.lanes import FORKS, LANE_STEP, find_crossings
from gridsim.maps.network import Network
from gridsim.maps.real.description import Lane, groups_of, joined, part_of

LEAST = 7.0  # m, of a lane where traffic waits or crosses: a car and its distance to the next one
WHOLE = 150.0  # m, of stretches that are joined to one lane, at most
NEAR_END = 25.0  # m from a road's end within which what crosses it is part of the junction there
_ROUNDED = 1e-3  # m, more than the rounding error of a box's sides in float32
_SAME = 0.5  # m within which two lanes begin at the same place


class Conflicts:
    """Which lanes may collide: they come closer than `gap` m, and are not one behind the other or side by side."""

    def __init__(self, lanes: dict[str, Lane], gap: float, size: np.ndarray):
        self.keys = list(lanes)
        self.lines = [resampled(lane, max(math.ceil(lane.length / LANE_STEP), 1))[0] for lane in lanes.values()]
        self.index = {key: k for k, key in enumerate(self.keys)}
        points = np.concatenate(self.lines).astype(np.float32)
        offsets = np.concatenate([[0], np.cumsum([len(line) for line in self.lines])]).astype(np.int32)
        middle, half = boxes_of(points, offsets)
        apart = abs(_short(middle[:, None] - middle[None], size)) - half[:, None] - half[None]
        candidates = (apart < gap).all(axis=2)
        for row in self._related(lanes):
            candidates[np.ix_(row, row)] = False
        self.cross = find_crossings(points, offsets, candidates, *size, gap)
        self.gap, self.size = gap, size

    def _related(self, lanes: dict[str, Lane]) -> Iterable[list[int]]:
        """Sets of lanes that do not conflict with each other."""
        for group in groups_of(lanes):
            yield [self.index[key] for key in group]
        for key, lane in lanes.items():
            here = self.index[key]
            begins = [self.index[s] for s in lane.successors]
            for other in begins:
                yield [here, other]
                onward = lanes[self.keys[other]]
                if onward.length < LEAST + 3.0:
                    for last in onward.successors:
                        yield [here, self.index[last]]
            starts = [self.lines[k][0] for k in begins]
            yield [k for k, at in zip(begins, starts, strict=True) if math.dist(at, starts[0]) < _SAME]

    def __contains__(self, key: str) -> bool:
        return bool(self.cross[self.index[key]].any())

    def zone(self, key: str) -> tuple[float, float]:
        """From where to where (m) on a lane others come too close to it."""
        line = self.lines[self.index[key]]
        others = np.concatenate([self.lines[k] for k in np.flatnonzero(self.cross[self.index[key]])])
        away = _short(line[:, None] - others[None], self.size)
        near = np.flatnonzero((np.hypot(away[..., 0], away[..., 1]) < self.gap + LANE_STEP).any(axis=1))
        step = np.hypot(*np.diff(line, axis=0).T).mean()
        return (float(near[0] * step), float(near[-1] * step)) if len(near) else (0.0, 0.0)


def _short(offsets: np.ndarray, size: np.ndarray) -> np.ndarray:
    return offsets - np.round(offsets / size) * size


def resampled(lane: Lane, intervals: int) -> tuple[np.ndarray, np.ndarray]:
    """Equally spaced points of a lane's middle line and half widths there: float64 [intervals + 1, 2], [...]."""
    line = lane.centre[:, :2]
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    half = np.hypot(*(lane.left - lane.right)[:, :2].T) / 2
    at = np.linspace(0.0, along[-1], intervals + 1)
    return np.column_stack([np.interp(at, along, column) for column in line.T]), np.interp(at, along, half)


def boxes_of(points: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middles and half sides (m) of lanes' bounding boxes: float64 [lanes, 2] each."""
    low, high = (ufunc.reduceat(points.astype(np.float64), offsets[:-1]) for ufunc in (np.minimum, np.maximum))
    return (low + high) / 2, (high - low) / 2 + _ROUNDED


def predecessors(lanes: dict[str, Lane]) -> dict[str, list[str]]:
    """The lanes that lead to each lane."""
    found = defaultdict(list)
    for key, lane in lanes.items():
        for other in lane.successors:
            found[other].append(key)
    return found


def _forward(lanes: dict[str, Lane], group: list[str], before: dict[str, list[str]]) -> list[str] | None:
    """The lanes that alone continue those of a group, in the same order side by side; None if there are none such."""
    onward = [lanes[key].successors for key in group]
    if any(len(keys) != 1 or len(before[keys[0]]) != 1 for keys in onward):
        return None
    found = [keys[0] for keys in onward]
    beside = pairwise(found)
    alone = not lanes[found[0]].left_lane and not lanes[found[-1]].right_lane
    fits = alone and all(lanes[a].right_lane == b for a, b in beside) and not set(found) & set(group)
    return found if fits else None


def _merge(lanes: dict[str, Lane], crossed: set[str]) -> None:
    """Join lanes to whole stretches of road; lanes that others cross only if they are short."""
    before = predecessors(lanes)
    for group in groups_of(lanes):
        while all(key in lanes for key in group):
            onward = _forward(lanes, group, before)
            if onward is None:
                break
            together = sum(max(lanes[key].length for key in keys) for keys in (group, onward))
            short = min(lanes[key].length for key in (*group, *onward)) < LEAST
            if not short and (together > WHOLE or crossed & {*group, *onward}):
                break
            for key, other in zip(group, onward, strict=True):
                lanes[key] = joined(lanes[key], lanes.pop(other))
                for last in lanes[key].successors:
                    before[last] = [key if k == other else k for k in before[last]]


def _group_of(lanes: dict[str, Lane], key: str) -> list[str]:
    return next(group for group in groups_of(lanes) if key in group)


def _is_alone(lane: Lane) -> bool:
    return not lane.left_lane and not lane.right_lane


def _give_tail(lanes: dict[str, Lane], before: dict[str, list[str]], group: list[str], length: float) -> bool:
    """Make the last `length` m of a road part of the lanes that go on from it, if it is theirs alone."""
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
    """Make the first `length` m of a road part of the lanes that lead to it, if they lead to it alone."""
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
    """Split the lanes of a group at a share of their length; returns the second part."""
    names = {key: f"{key}+" for key in group}
    for key in group:
        lane = lanes[key]
        at = share * lane.length
        onward = replace(part_of(lane, at, lane.length), successors=lane.successors)
        onward.left_lane, onward.right_lane = names.get(lane.left_lane, ""), names.get(lane.right_lane, "")
        lanes[names[key]] = onward
        lanes[key] = replace(part_of(lane, 0.0, at), successors=[names[key]])
    return list(names.values())


def _lengthen(lanes: dict[str, Lane]) -> None:
    """Give short lanes a piece of the road before or after them."""
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
    """Make what is crossed of a road part of the junctions at its ends, or a lane of its own."""
    before = predecessors(lanes)
    for group in groups_of(lanes):
        crossed = [key for key in group if key in conflicts]
        length = min(lanes[key].length for key in group)
        if not crossed or lanes[group[0]].junction or length < 3 * LEAST:
            continue
        zones = [conflicts.zone(key) for key in crossed]
        first, last = min(zone[0] for zone in zones) - 1.0, max(zone[1] for zone in zones) + 1.0
        if (
            last > length - NEAR_END
            and first > length - 2 * NEAR_END
            and _give_tail(lanes, before, group, length - first)
        ):
            continue
        if first < NEAR_END and last < 2 * NEAR_END and _give_head(lanes, before, group, last):
            continue
        if last < length - LEAST and last > LEAST:
            _split(lanes, group, last / length)
            length = last
        if first > LEAST and first < length - LEAST:
            _split(lanes, group, first / length)


def _apart_at_ends(lanes: dict[str, Lane], gap: float) -> None:
    """Take lanes that run into one another for no neighbours."""
    for group in groups_of(lanes):
        for left, right in pairwise(group):
            n = max(math.ceil(lanes[left].length / LANE_STEP), 1)
            away = resampled(lanes[left], n)[0] - resampled(lanes[right], n)[0]
            if np.hypot(*away.T).min() < gap:
                lanes[left].right_lane = lanes[right].left_lane = ""


def shaped(lanes: dict[str, Lane], gap: float, size: np.ndarray) -> tuple[dict[str, Lane], Conflicts]:
    """Lanes as traffic needs them, and which of them may collide; `gap` (m) between middle lines, size of the torus."""
    lanes = {key: replace(lane, successors=list(lane.successors)) for key, lane in lanes.items()}
    _apart_at_ends(lanes, gap)
    for _ in range(3):
        conflicts = Conflicts(lanes, gap, size)
        _merge(lanes, {key for key in lanes if key in conflicts})
        _lengthen(lanes)
        _clear_roads(lanes, Conflicts(lanes, gap, size))
    return lanes, Conflicts(lanes, gap, size)


def network_of(lanes: dict[str, Lane], conflicts: Conflicts, hand: float) -> Network:
    """The network of shaped lanes; without `speeds`, `clear` and `room`."""
    intervals = {}
    for group in groups_of(lanes):
        longest = max(lanes[key].length for key in group)
        intervals.update(dict.fromkeys(group, max(math.ceil(longest / LANE_STEP - 1e-9), 1)))
    lines = [resampled(lane, intervals[key])[0] for key, lane in lanes.items()]
    index = conflicts.index
    for key, lane in lanes.items():  # where a file leaves a gap, or its bounds do not quite meet
        for s in lane.successors:
            lines[index[s]][0] = lines[index[key]][-1]
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
        "room": np.zeros(len(points), dtype=np.float32),
        "boxes": np.concatenate(boxes_of(points, offsets), axis=1).astype(np.float32),
    }
    frozen = {name: freeze(array) for name, array in arrays.items()}
    width, height = (np.float32(side) for side in conflicts.size)
    return Network(**frozen, width=width, height=height, hand=np.float32(hand))
