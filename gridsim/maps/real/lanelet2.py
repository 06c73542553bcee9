"""Lanelet2: a lanelet is a relation of two bounds. It follows another one if its bounds begin where that one's end."""

from __future__ import annotations

import math
import re
from collections import defaultdict

import numpy as np

from gridsim.maps.real.content import Element
from gridsim.maps.real.description import Lane, RealRoad, paired, without_repeats

CAR_ROADS = {"road", "highway", "play_street", ""}
LIMITS = {"urban": 50 / 3.6, "nonurban": 100 / 3.6, "private": 30 / 3.6}  # m/s, where a lanelet has none (Germany's)
RADIUS = 6_378_137.0  # m, semi-major axis of WGS84
FLATTENING_SQUARED = 0.00669438  # first eccentricity squared of WGS84


def read_lanelet2(root: Element) -> RealRoad:
    """The lanelets for cars of a Lanelet2 file."""
    places, degrees = _places(root)
    ways = {way.get("id", ""): [nd.get("ref", "") for nd in way.iterfind("nd")] for way in root.iterfind("way")}
    dashed = {way.get("id", "") for way in root.iterfind("way") if _may_cross(_tags(way))}
    lanes: dict[str, Lane] = {}
    ends: dict[str, tuple[str, str, str, str]] = {}  # nodes: left first, right first, left last, right last
    sides: dict[str, tuple[str, str]] = {}  # the first way of the left and of the right bound
    others = broken = 0
    for relation in root.iterfind("relation"):
        tags = _tags(relation)
        if tags.get("type") != "lanelet":
            continue
        if not _for_cars(tags):
            others += 1
            continue
        key = relation.get("id", "")
        members = [(member.get("role"), member.get("ref", "")) for member in relation.iterfind("member")]
        chosen = [[ref for role, ref in members if role == side] for side in ("left", "right")]
        nodes = [[n for n in _joined([ways.get(ref, []) for ref in refs]) if n in places] for refs in chosen]
        if min(map(len, nodes)) < 2:
            broken += 1
            continue
        nodes = _aligned(nodes, places)
        left, right = (without_repeats(np.array([places[n] for n in bound])) for bound in nodes)
        if min(len(left), len(right)) < 2:
            broken += 1
            continue
        lanes[key] = Lane(*paired(left, right), _limit(tags))
        ends[key] = nodes[0][0], nodes[1][0], nodes[0][-1], nodes[1][-1]
        sides[key] = chosen[0][0], chosen[1][0]
    _connect(lanes, ends, sides, dashed)
    road = RealRoad("Lanelet2", lanes)
    road.degrees = degrees
    if degrees:
        road.middle = f"{degrees[1]:.5f},{degrees[0]:.5f}"
        road.notes.append("latitude and longitude were projected to metres around the middle of the file")
    if others:
        road.notes.append(f"{others} lanelets that are not for cars were left out")
    if broken:
        road.notes.append(f"{broken} lanelets without two bounds were left out")
    return road


def _connect(
    lanes: dict[str, Lane],
    ends: dict[str, tuple[str, str, str, str]],
    sides: dict[str, tuple[str, str]],
    dashed: set[str],
) -> None:
    """Set the successors of lanes, and their neighbours across lines that may be crossed."""
    begins, right_of = defaultdict(list), defaultdict(list)
    for key, (left_first, right_first, _, _) in ends.items():
        begins[left_first, right_first].append(key)
        right_of[sides[key][1]].append(key)
    for key, lane in lanes.items():
        lane.successors = [other for other in begins[ends[key][2:]] if other != key]
        for other in right_of[sides[key][0]] if sides[key][0] in dashed else []:
            if other != key and ends[other][1] == ends[key][0]:  # both run the same way along the line they share
                lane.left_lane, lanes[other].right_lane = other, key


def _places(root: Element) -> tuple[dict[str, tuple[float, float, float]], tuple[float, ...]]:
    """x, y, z (m) of nodes, and `RealRoad.degrees`."""
    own, degrees = {}, {}
    for node in root.iterfind("node"):
        tags, key = _tags(node), node.get("id", "")
        z = _float(tags.get("ele"))
        z = 0.0 if math.isnan(z) else z
        x, y = _float(tags.get("local_x")), _float(tags.get("local_y"))
        lat, lon = _float(node.get("lat")), _float(node.get("lon"))
        if math.isfinite(x + y):
            own[key] = (x, y, z)
        if abs(lat) <= 90.0 and abs(lon) <= 180.0:
            degrees[key] = (lat, lon, z)
    if len(own) >= len(degrees):
        return own, ()
    lat, lon = (float(np.median([place[k] for place in degrees.values()])) for k in (0, 1))
    bent = 1.0 - FLATTENING_SQUARED * math.sin(math.radians(lat)) ** 2
    north = math.radians(RADIUS * (1.0 - FLATTENING_SQUARED) / bent**1.5)
    east = math.radians(RADIUS / math.sqrt(bent) * math.cos(math.radians(lat)))
    return {key: ((b - lon) * east, (a - lat) * north, z) for key, (a, b, z) in degrees.items()}, (
        lon,
        lat,
        east,
        north,
    )


def _aligned(nodes: list[list[str]], places: dict[str, tuple[float, float, float]]) -> list[list[str]]:
    """The nodes of a left and a right bound, each reversed if it runs against the driving direction."""
    left, right = nodes

    def apart(one: str, other: str) -> float:
        return math.dist(places[one][:2], places[other][:2])

    if apart(left[0], right[0]) + apart(left[-1], right[-1]) > apart(left[0], right[-1]) + apart(left[-1], right[0]):
        right = right[::-1]
    outline = np.array([places[n][:2] for n in left + right[::-1]])
    outline -= outline[0]
    x, y = outline.T
    if (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() > 0.0:  # counter-clockwise: the right bound is on the left
        left, right = left[::-1], right[::-1]
    return [left, right]


def _joined(ways: list[list[str]]) -> list[str]:
    """The nodes of a bound that consists of several ways, one after the other; each may run in either direction."""
    line, *others = [list(way) for way in ways if way] or [[]]
    for way in others:
        if way[0] != line[-1]:
            if way[-1] == line[-1]:
                way = way[::-1]
            elif line[0] in (way[0], way[-1]):
                line = line[::-1]
                way = way if way[0] == line[-1] else way[::-1]
        line += way[1:]
    return line


def _for_cars(tags: dict[str, str]) -> bool:
    users = {key[12:]: value for key, value in tags.items() if key.startswith("participant:")}
    if users:
        return "yes" in (users.get("vehicle"), users.get("vehicle:car"), users.get("car"))
    return tags.get("subtype", "") in CAR_ROADS


def _may_cross(tags: dict[str, str]) -> bool:
    return tags.get("lane_change", "yes" if "dashed" in tags.get("subtype", "") else "no") == "yes"


def _limit(tags: dict[str, str]) -> float:
    """Speed limit (m/s) from a lanelet's tag, in km/h unless it says mph or m/s; without one, by location (LIMITS)."""
    found = re.match(r"\s*([\d.]+)\s*(mph|mps|m/s)?", tags.get("speed_limit", ""))
    if not found:
        return LIMITS.get(tags.get("location", ""), math.nan)
    return _float(found[1]) * {"mph": 0.44704, "mps": 1.0, "m/s": 1.0}.get(found[2] or "", 1 / 3.6)


def _tags(element: Element) -> dict[str, str]:
    return {tag.get("k", ""): tag.get("v", "") for tag in element.iterfind("tag")}


def _float(text: str | None) -> float:
    try:
        return float(text or "nan")
    except ValueError:
        return math.nan
