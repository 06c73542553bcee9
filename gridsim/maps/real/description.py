"""What every format of real roads is read into: lanes with bounds, and the areas of junctions."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, field, replace

import numpy as np

# m; where lanes are joined, the line may run backwards, if a file's nodes are closer together than junctions are wide.
# A point where it turns back is removed if the segment before or after it is at most this long.
RETURN = 4.0
MOST_APART = 60.0  # m between the end of a lane and the next one's begin; half the shortest side of a torus is more
RETURN_COSINE = -0.2  # a line runs backwards where the cosine of its turn at a point is at most this


@dataclass
class Lane:
    """A lane for cars; z is 0 where a file knows no heights."""

    left: np.ndarray  # float64 [n, 3], m: its bounds in driving direction, point i of one beside point i of the other
    right: np.ndarray
    speed: float = math.nan  # m/s, the limit; nan: unknown
    successors: list[str] = field(default_factory=list)
    left_lane: str = ""  # the lane to which a car may change, of the same direction; "": none
    right_lane: str = ""
    # name of the junction it is in ("end ..." if `ends` made the lane); "": none; None: the format does not tell
    junction: str | None = None
    links: frozenset[str] = frozenset()  # names of those of the file's connections that this lane contains
    yields: frozenset[str] = frozenset()  # names of connections to which cars on this lane give way, as the file says
    light: str = ""  # cycle of the traffic light at its beginning: g, y or r for each second; "": no light

    @property
    def centre(self) -> np.ndarray:
        """Middle line float64 [n, 3]."""
        return (self.left + self.right) / 2

    @property
    def length(self) -> float:
        """Length (m) of the middle line."""
        return float(np.hypot(*np.diff(self.centre[:, :2], axis=0).T).sum())


@dataclass
class RealRoad:
    """The roads of a file, in m: in its x and y, or in a local plane if it has longitude and latitude."""

    format: str  # the format's name for users, such as OpenStreetMap
    lanes: dict[str, Lane]
    junctions: dict[str, np.ndarray] = field(default_factory=dict)  # outlines float64 [n, 2]
    degrees: tuple[float, ...] = ()  # longitude, latitude of x = y = 0; m per degree of each; (): not Lanelet2, or in m
    middle: str = ""  # LAT,LON amid the file, as a crop has it; "": the file's places are x and y in m
    hand: float = 0.0  # the side on which traffic drives: 1 right, -1 left; 0: unknown, `load.hand_of` finds it
    notes: list[str] = field(default_factory=list)  # what was changed, left out or assumed, a sentence each

    @property
    def length(self) -> float:
        """Length (m) of all lanes."""
        return sum(lane.length for lane in self.lanes.values())


def paired(left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two bounds resampled to equally many points, so that point i of one is beside point i of the other.

    Both get a point at each relative arc length (0 to 1) at which one of them has a point.
    """
    shares = [_shares(bound) for bound in (left, right)]
    both = np.unique(np.round(np.concatenate(shares), 9))
    return tuple(
        np.column_stack([np.interp(both, at, column) for column in bound.T])
        for at, bound in zip(shares, (left, right), strict=True)
    )  # type: ignore[return-value]


def _shares(line: np.ndarray) -> np.ndarray:
    """Arc length at each point of a polyline, as a share of the whole."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))])
    return along / max(along[-1], 1e-9)


def without_repeats(line: np.ndarray, least: float = 0.01) -> np.ndarray:
    """A polyline without points that are less than `least` m from the point kept before them.

    The first and the last point are kept; but if all are that close to the first, only the first is.
    """
    kept = [0]
    for k in range(1, len(line)):
        if np.hypot(*(line[k, :2] - line[kept[-1], :2])) >= least:
            kept.append(k)
    if kept[-1] != len(line) - 1 and len(kept) > 1:
        kept[-1] = len(line) - 1
    return line[kept]


def bounds_of(centre: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Left and right bounds of a lane with this middle line [n, 3] and width (m)."""
    step = np.diff(centre[:, :2], axis=0)
    step /= np.maximum(np.hypot(*step.T), 1e-9)[:, None]
    before, after = np.vstack([step[:1], step]), np.vstack([step, step[-1:]])
    along = before + after
    # At a bend, a bound is farther from the middle line by a factor of 1 / cos(half the turn), here 3**0.5 at most.
    along /= np.maximum((along * before).sum(axis=1), 2.0 / 1.5 * 0.5)[:, None]
    aside = np.column_stack([-along[:, 1], along[:, 0], np.zeros(len(along))]) * (width / 2)
    return centre + aside, centre - aside


def part_of(lane: Lane, first: float, last: float) -> Lane:
    """The part of a lane between two arc lengths (m) along its middle line, without successors.

    The part has the lane's light only if it begins where the lane begins.
    """
    shares, length = _shares(lane.centre), lane.length
    a, b = max(first / length, 0.0), min(last / length, 1.0)
    at = np.concatenate([[a], shares[(shares > a + 1e-6) & (shares < b - 1e-6)], [b]])
    left, right = (
        np.column_stack([np.interp(at, shares, column) for column in bound.T]) for bound in (lane.left, lane.right)
    )
    return replace(lane, left=left, right=right, successors=[], light="" if first > 0.0 else lane.light)


def joined(one: Lane, other: Lane) -> Lane:
    """One lane made of `one` and of `other`, which follows it.

    It has the successors of `other`, the neighbours of `one`, and the limit (if known) and the junction of the longer.
    If `one` goes round the world, `other` begins a side of the torus away.
    """
    away = (one.centre[-1] - other.centre[0]) * np.array([1.0, 1.0, 0.0])
    if np.hypot(*away[:2]) > MOST_APART:
        other = replace(other, left=other.left + away, right=other.right + away)
    left, right = (np.concatenate([a, b[1:]]) for a, b in ((one.left, other.left), (one.right, other.right)))
    kept = _without_returns((left + right)[:, :2] / 2)
    limited = [lane for lane in (other, one) if not math.isnan(lane.speed)]
    junction = one.junction if one.length > other.length else other.junction
    speed = max(limited, key=lambda lane: lane.length).speed if limited else math.nan
    successors = list(other.successors)
    return replace(
        one,
        left=left[kept],
        right=right[kept],
        speed=speed,
        successors=successors,
        junction=junction,
        links=one.links | other.links,
        yields=one.yields | other.yields,
        light=one.light or other.light,
    )


def _without_returns(line: np.ndarray) -> list[int]:
    """Indices of the points of a polyline [n, 2] to keep, so that it does not run backwards (see RETURN)."""
    kept: list[int] = []
    for k in range(len(line)):
        kept.append(k)
        while len(kept) > 2:
            before, after = line[kept[-2]] - line[kept[-3]], line[kept[-1]] - line[kept[-2]]
            lengths = np.hypot(*before), np.hypot(*after)
            if min(lengths) > RETURN or before @ after > RETURN_COSINE * lengths[0] * lengths[1]:
                break
            del kept[-2]
    return kept


def groups_of(lanes: dict[str, Lane]) -> list[list[str]]:
    """Groups of lanes side by side, each from left to right; a lane without neighbours is a group of its own."""
    found, done = [], set()
    for key in lanes:
        first = key
        seen = {key}
        while (left := lanes[first].left_lane) in lanes and left not in seen:
            first = left
            seen.add(first)
        if first in done:
            continue
        group = [first]
        while (right := lanes[group[-1]].right_lane) in lanes and right not in group:
            group.append(right)
        done.update(group)
        found.append(group)
    return found


def predecessors(lanes: dict[str, Lane]) -> dict[str, list[str]]:
    """The lanes that lead to each lane."""
    found = defaultdict(list)
    for key, lane in lanes.items():
        for other in lane.successors:
            found[other].append(key)
    return found


def heading(lane: Lane, at: int) -> np.ndarray:
    """Direction [2] of a lane's middle line at its first (0) or last (-1) point."""
    line = lane.centre[:, :2]
    step = line[-1] - line[-2] if at else line[1] - line[0]
    return step / max(np.hypot(*step), 1e-9)
