"""Selects the lanes of a file that can be driven: in a crop, without tight turns, on one level, all connected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from gridsim.jit import njit
from gridsim.maps.real.description import Lane, RealRoad, groups_of, heading, predecessors, without_repeats

TIGHTEST = 3.5  # m, the least radius of a turn that traffic drives
TURN = 1.75  # rad (100 degrees), the most that a lane may turn within TURN * TIGHTEST m
NEARLY = 0.75  # components at least this share as long as the largest one are kept, too
APART = 2.5  # m of height between two ways, at least, if one passes above the other
JOINT = 0.01  # m by which a lane's line is extended into the lanes before and after it, to include the turns there
END = 11.0  # m; lanes that cross this close to an end of one of them are taken to meet there, on one level


def keep(lanes: dict[str, Lane], kept: set[str]) -> dict[str, Lane]:
    """Copies of the lanes `kept`, without references to others."""
    lanes = {key: replace(lane) for key, lane in lanes.items() if key in kept}
    for lane in lanes.values():
        lane.successors = [key for key in dict.fromkeys(lane.successors) if key in kept]
        lane.left_lane = lane.left_lane if lane.left_lane in kept else ""
        lane.right_lane = lane.right_lane if lane.right_lane in kept else ""
    for key, lane in lanes.items():  # neighbours stay so only if each names the other
        if lane.left_lane and lanes[lane.left_lane].right_lane != key:
            lane.left_lane = ""
        if lane.right_lane and lanes[lane.right_lane].left_lane != key:
            lane.right_lane = ""
    return lanes


def cropped(road: RealRoad, middle: np.ndarray, side: float) -> None:
    """Keep the lanes whose middle lines lie entirely in a square with this middle [2] and side (m)."""
    kept = {key for key, lane in road.lanes.items() if (abs(lane.centre[:, :2] - middle) <= side / 2).all()}
    road.lanes = keep(road.lanes, kept)


def without_tight_turns(road: RealRoad) -> None:
    """Leave out lanes that turn more tightly than cars can."""
    before = predecessors(road.lanes)
    kept = set()
    for key, lane in road.lanes.items():
        line = lane.centre[:, :2]
        if lane.junction:  # such a lane may be so short that it turns only where it joins others
            ahead = [heading(road.lanes[k], 0) for k in lane.successors[:1] if k in road.lanes]
            behind = [heading(road.lanes[k], -1) for k in before[key][:1]]
            line = np.array([line[0] - JOINT * d for d in behind] + [*line] + [line[-1] + JOINT * d for d in ahead])
        if not _is_tight(line):
            kept.add(key)
    if left_out := len(road.lanes) - len(kept):
        road.notes.append(f"{left_out} lanes that turn in less than {TIGHTEST:g} m are not ways of traffic")
    road.lanes = keep(road.lanes, kept)


def _is_tight(line: np.ndarray) -> bool:
    """Whether a polyline [n, 2] turns by more than TURN within TURN * TIGHTEST m."""
    step = np.diff(without_repeats(line, JOINT / 2), axis=0)
    angle = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*step.T))])
    # last[i] is the first point that is TURN * TIGHTEST m or more beyond the end of segment i.
    last = np.searchsorted(along, along[1:] + TURN * TIGHTEST)
    return any(np.ptp(angle[i : max(last[i] - 1, i + 1)]) > TURN for i in range(len(angle)) if along[-1] > 0.0)


@njit
def _crossing(one, other):
    """Indices i, j of the first segments at which two polylines [n, 2] cross; -1, -1 if they do not."""
    for i in range(len(one) - 1):
        ax, ay, bx, by = one[i, 0], one[i, 1], one[i + 1, 0] - one[i, 0], one[i + 1, 1] - one[i, 1]
        for j in range(len(other) - 1):
            cx, cy = other[j, 0] - ax, other[j, 1] - ay
            dx, dy = other[j + 1, 0] - other[j, 0], other[j + 1, 1] - other[j, 1]
            cross = bx * dy - by * dx
            if cross != 0.0:
                s, t = (cx * dy - cy * dx) / cross, (cx * by - cy * bx) / cross
                if 0.0 <= s <= 1.0 and 0.0 <= t <= 1.0:
                    return i, j
    return -1, -1


def on_one_level(road: RealRoad) -> None:
    """Of two roads that cross but do not meet, drop the lower one, or the slower one if heights do not tell.

    A map is flat: nobody can drive under a bridge.
    """
    keys = list(road.lanes)
    lines = [np.ascontiguousarray(road.lanes[key].centre) for key in keys]
    low, high = (np.array([ufunc(line[:, :2], axis=0) for line in lines]) for ufunc in (np.min, np.max))
    group = {key: number for number, members in enumerate(groups_of(road.lanes)) for key in members}
    members = groups_of(road.lanes)
    dropped: set[int] = set()
    for i, key in enumerate(keys):
        near = np.flatnonzero(((low[i] <= high) & (low <= high[i])).all(axis=1))
        for j in near[near > i]:
            other = keys[j]
            pair = group[key], group[other]
            if pair[0] == pair[1] or dropped & set(pair):
                continue
            lower = _lower(road, key, other, lines[i], lines[j])
            if lower:
                dropped.add(group[lower])
    if dropped:
        ways = sum(road.lanes[members[k][0]].junction in ("", None) for k in dropped)
        length = sum(road.lanes[key].length for k in dropped for key in members[k])
        road.notes.append(f"{max(ways, 1)} ways under bridges, {length:.0f} m of lanes, were left out: a map is flat")
    road.lanes = keep(road.lanes, {key for key in road.lanes if group[key] not in dropped})


def _lower(road: RealRoad, key: str, other: str, one_line: np.ndarray, other_line: np.ndarray) -> str:
    """Which of two lanes has to go, because it passes under the other; "" for none.

    If heights do not tell, it is the one with the lower speed limit, but only if the format tells junctions, and the
    lanes cross far from their ends (END) and not in one junction.
    """
    one, two = road.lanes[key], road.lanes[other]
    if other in one.successors or key in two.successors:
        return ""
    i, j = _crossing(one_line[:, :2], other_line[:, :2])
    if i < 0:
        return ""
    rise = one_line[i, 2] - other_line[j, 2]
    if abs(rise) >= APART:
        return other if rise > 0.0 else key
    known = one.junction is not None
    if not known or (one.junction == two.junction and one.junction):
        return ""
    at = one_line[i, :2]
    if min(np.hypot(*(line[end, :2] - at)) for line in (one_line, other_line) for end in (0, -1)) < END:
        return ""
    return min(key, other, key=lambda name: (road.lanes[name].speed, road.lanes[name].length))


def largest_connected(lanes: dict[str, Lane]) -> set[str]:
    """The largest connected part (by m of lanes), whatever the lanes' directions, and others nearly as large."""
    return _largest(lanes, "weak")


def largest_joined(lanes: dict[str, Lane]) -> dict[str, Lane]:
    """The largest part (by m of lanes) in which every lane can be reached from all, and others nearly as large."""
    while True:
        before = len(lanes)
        lanes = keep(lanes, {key for key, lane in lanes.items() if lane.successors})
        if len(lanes) == before:
            lanes = keep(lanes, _largest(lanes, "strong"))
            if len(lanes) == before:
                return lanes


def on_rings(onward: dict[str, list[str]]) -> set[str]:
    """The nodes of a graph whose strongly connected component is a single cycle. `onward`: each node's successors."""
    keys = list(onward)
    labels = _components(keys, [(key, other) for key in keys for other in onward[key]], "strong")
    label = dict(zip(keys, labels, strict=True))
    inside = {key: sum(label[other] == label[key] for other in onward[key]) for key in keys}
    branched = {label[key] for key in keys if inside[key] != 1}
    return {key for key in keys if label[key] not in branched}


def _components(keys: list[str], pairs: list[tuple[str, str]], connection: str) -> np.ndarray:
    """For each node (`keys`) of a graph with these edges (`pairs`), the number of its component: int [nodes]."""
    index = {key: k for k, key in enumerate(keys)}
    edges = np.array([(index[a], index[b]) for a, b in pairs if b in index], dtype=np.intp).reshape(-1, 2)
    graph = coo_matrix((np.ones(len(edges)), tuple(edges.T)), shape=(len(keys), len(keys)))
    return connected_components(graph, directed=True, connection=connection)[1]


def _largest(lanes: dict[str, Lane], connection: str) -> set[str]:
    """The lanes in the largest component (by m) of the graph of successors and lane changes, and in others nearly as
    large (NEARLY).

    `connection` is "weak" or "strong". On a ring road, for example, each direction is a strong component.
    """
    keys = list(lanes)
    if not keys:
        return set()
    onward = [(key, s) for key, lane in lanes.items() for s in (*lane.successors, lane.left_lane, lane.right_lane)]
    label = _components(keys, onward, connection)
    lengths = np.bincount(label, [lane.length for lane in lanes.values()])
    return {key for key, own in zip(keys, label, strict=True) if lengths[own] >= NEARLY * lengths.max()}
